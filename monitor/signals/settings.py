"""Settings of resampling and windows."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from monitor.core import Settings

Positive = Annotated[float, Field(gt=0)]


class ProcessingSettings(Settings):
    """``[processing]``: resampling and windows."""

    rate_hz: Positive = 100.0
    """Sampling rate after resampling; slower sources keep their own rate."""
    cutoff_hz: Positive = 40.0
    """Cutoff of the lowpass; modes beyond it are not identified."""
    window_s: Positive = 400.0
    """Length of a window: the data of one result."""
    hop_s: Positive = 10.0
    """Time from one window to the next."""

    @model_validator(mode="after")
    def _consistent(self) -> ProcessingSettings:
        """Refuse a hop longer than the window, and a cutoff beyond the Nyquist frequency."""
        if self.hop_s > self.window_s:
            raise ValueError("hop_s is longer than window_s")
        if self.cutoff_hz >= 0.5 * self.rate_hz:
            raise ValueError("cutoff_hz must lie below half of rate_hz")
        return self
