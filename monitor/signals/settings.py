"""Settings of the way from the source's samples to windows."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from monitor.core import Settings

Positive = Annotated[float, Field(gt=0)]


class ProcessingSettings(Settings):
    """``[processing]``: from the source's samples to windows."""

    rate_hz: Positive = 100.0
    """After resampling; slower sources keep their own rate."""
    cutoff_hz: Positive = 40.0
    """Of the lowpass; modes beyond it are not looked for."""
    window_s: Positive = 400.0
    """Length of the data that one result rests on."""
    hop_s: Positive = 10.0
    """From one window to the next."""

    @model_validator(mode="after")
    def _consistent(self) -> ProcessingSettings:
        if self.hop_s > self.window_s:
            raise ValueError("hop_s is longer than window_s")
        if self.cutoff_hz >= 0.5 * self.rate_hz:
            raise ValueError("cutoff_hz must lie below half of rate_hz")
        return self
