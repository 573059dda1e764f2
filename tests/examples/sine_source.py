"""A driver: a source of its own kind, here a test tone.  Another distribution registers it by an entry point:

[project.entry-points."shm_monitor.sources"]
sine = "sine_source:SineSource"
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from drivers.base import ACCELERATION, EndOfStream, SampleBlock, SourceContext, SourceHealth


class SineSettings(BaseModel):
    """``[source]`` with ``kind = "sine"``."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["sine"]
    frequency_hz: float = Field(gt=0)
    duration_s: float = Field(default=60.0, gt=0)
    sample_rate_hz: float = Field(default=200.0, gt=0)


class SineSource:
    """Gives every channel the same tone, a second a block."""

    Settings = SineSettings

    def __init__(self, settings: SineSettings, context: SourceContext) -> None:
        self._settings, self._channels, self._seconds = settings, context.channels, 0

    def open(self) -> None:
        """Nothing to connect to."""

    def read(self, timeout_s: float) -> SampleBlock | None:
        """The next second."""
        if self._seconds >= self._settings.duration_s:
            raise EndOfStream("the tone has ended")
        rate = self._settings.sample_rate_hz
        first = round(self._seconds * rate)
        t_s = np.arange(first, round((self._seconds + 1) * rate)) / rate
        tone = np.sin(2 * np.pi * self._settings.frequency_hz * t_s)
        samples = np.repeat(tone[:, None], len(self._channels), axis=1).astype(np.float32)
        t_ns = 1_767_225_600_000_000_000 + self._seconds * 1_000_000_000
        self._seconds += 1
        return SampleBlock(ACCELERATION, t_ns, first, rate, self._channels, "m/s^2", samples)

    def health(self) -> SourceHealth:
        """Always well."""
        return SourceHealth(connected=True, counts={"blocks": self._seconds})

    def close(self) -> None:
        """Nothing to release."""
