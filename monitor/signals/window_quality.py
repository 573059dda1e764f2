"""Quality check of a window: which channels move, and whether the response stands out from white noise."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Annotated

import numpy as np
from pydantic import Field

from monitor.core import Array, LagSums, Settings, Skipped


class QualitySettings(Settings):
    """Limits beyond which a window is skipped."""

    max_spectral_flatness: float = Field(default=0.95, gt=0, le=1)
    """Geometric over arithmetic mean of the spectrum: 1 for white noise alone, about 0.1 for a vibrating frame."""


def still_channels(sums: LagSums) -> tuple[int, ...]:
    """List the channels (0 = first) that do not move in a window."""
    return still((sums.total[0].diagonal() / sums.counts.sum()).tolist())


def still(variance: Sequence[float]) -> tuple[int, ...]:
    """List the channels (0 = first) whose variance, (m/s^2)^2, is that of rounding errors only, as a constant channel's."""
    least = max(1e-20, 1e-10 * max(variance))
    return tuple(channel for channel, v in enumerate(variance) if not v > least)


def check(sums: LagSums, rate_hz: float, cutoff_hz: float, settings: QualitySettings) -> Skipped | None:
    """Tell why a window, of channels that move, holds no response from which modes can be identified; None if it does.

    The spectral flatness is that of the lag window estimate (Bartlett) of the summed channels, from 1 Hz to 0.9 of the cutoff.
    """
    from monitor.signals.kernels import flatness  # compiled code takes a while to load

    flat = flatness(sums.total, _bartlett(len(sums.total), rate_hz, cutoff_hz))
    if flat > settings.max_spectral_flatness:
        return Skipped(f"response too close to the noise (spectral flatness {flat:.2f})")
    return None


@lru_cache(maxsize=8)
def _bartlett(n: int, rate_hz: float, cutoff_hz: float) -> Annotated[Array, "frequencies n"]:
    """Compute the weights of the lags in the Bartlett spectrum; each includes the negative lag."""
    frequency, lag = np.arange(1.0, 0.9 * cutoff_hz, 0.5), np.arange(n)
    cosines = np.cos(2.0 * np.pi * frequency[:, None] * lag / rate_hz)
    return np.asarray(np.where(lag, 2.0, 1.0) * (1.0 - lag / n) * cosines)
