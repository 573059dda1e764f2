"""Is there anything in a window to identify?"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from pydantic import Field

from monitor.core import Array, LagSums, Settings, Skipped


class QualitySettings(Settings):
    """What keeps a window out."""

    max_spectral_flatness: float = Field(default=0.95, gt=0, le=1)
    """Geometric over arithmetic mean of the spectrum: 1 for white noise alone, about 0.1 for a vibrating frame."""


def check(
    sums: LagSums, rate_hz: float, cutoff_hz: float, channels: tuple[str, ...], settings: QualitySettings
) -> Skipped | None:
    """Why this window cannot be identified, or None.

    The spectrum is the lag window estimate (Bartlett) of the summed channels, from 1 Hz to 0.9 of the cutoff.
    """
    from monitor.signals.kernels import flatness  # compiled code takes a while to load

    variance = (sums.total[0].diagonal() / sums.counts.sum()).tolist()
    # A sensor that gives a constant leaves rounding errors only.
    least = max(1e-20, 1e-10 * max(variance))
    dead = [name for name, v in zip(channels, variance, strict=True) if not v > least]
    if dead:
        return Skipped(f"channel {', '.join(dead)} does not move")
    flat = flatness(sums.total, _bartlett(len(sums.total), rate_hz, cutoff_hz))
    if flat > settings.max_spectral_flatness:
        return Skipped(f"response too close to the noise (spectral flatness {flat:.2f})")
    return None


@lru_cache(maxsize=8)
def _bartlett(n: int, rate_hz: float, cutoff_hz: float) -> Array:
    """What every lag and its negative add at every frequency of the spectrum."""
    frequency, lag = np.arange(1.0, 0.9 * cutoff_hz, 0.5), np.arange(n)
    cosines = np.cos(2.0 * np.pi * frequency[:, None] * lag / rate_hz)
    return np.asarray(np.where(lag, 2.0, 1.0) * (1.0 - lag / n) * cosines)
