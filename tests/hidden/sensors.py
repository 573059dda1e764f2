"""What sensors make of the motion, in either simulator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

Fault = Callable[[np.ndarray, float], np.ndarray]
"""Changes samples (n_samples, n_channels), which come at a rate in Hz."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Sensors:
    """The sensors of one recording, one value a channel; three ideal ones unless said otherwise."""

    noise: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """RMS of each channel's own noise."""
    noise_share: float = 0.0
    """Of a channel's RMS, noise besides."""
    delay_s: np.ndarray = field(default_factory=lambda: np.zeros(3))
    gain: np.ndarray = field(default_factory=lambda: np.ones(3))
    gain_swing: np.ndarray = field(default_factory=lambda: np.zeros(3))
    order: tuple[int, ...] = (0, 1, 2)
    limit: np.ndarray = field(default_factory=lambda: np.full(3, np.inf))
    dropouts: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """Mean number a minute."""
    fault: Fault | None = None
    """What the logger makes of all samples at last."""


def ideal(channels: int) -> Sensors:
    """Sensors without a fault and without noise."""
    none = np.zeros(channels)
    return Sensors(
        noise=none, delay_s=none, gain=none + 1.0, gain_swing=none, order=tuple(range(channels)),
        limit=none + np.inf, dropouts=none,
    )  # fmt: skip


def sensed(sensors: Sensors, clean: np.ndarray, rate_hz: float, rng: np.random.Generator) -> np.ndarray:
    """Samples as recorded, shape (n_samples, n_channels), of the sensors' true motion `clean`, which is overwritten."""
    for j in np.flatnonzero(sensors.delay_s):
        clean[:, j] = _delayed(clean[:, j], sensors.delay_s[j], rate_hz)
    swing = np.sin(2.0 * np.pi * np.arange(len(clean))[:, None] / rate_hz / 240.0) * sensors.gain_swing
    noise = np.hypot(sensors.noise, sensors.noise_share * clean.std(axis=0))
    samples = (clean + noise * rng.standard_normal(clean.shape)) * sensors.gain * (1.0 + swing)
    samples = np.clip(samples[:, sensors.order], -sensors.limit, sensors.limit)
    for j in np.flatnonzero(sensors.dropouts):
        for _ in range(rng.poisson(sensors.dropouts[j] * len(samples) / rate_hz / 60.0)):
            at = rng.integers(len(samples))
            samples[at : at + round(rate_hz * rng.uniform(0.1, 1.0)), j] = 0.0
    return samples if sensors.fault is None else sensors.fault(samples, rate_hz)


def _delayed(x: np.ndarray, seconds: float, rate_hz: float) -> np.ndarray:
    """`x` later by a fraction of a sample and more, as a band-limited signal."""
    spectrum = np.fft.rfft(x)
    return np.fft.irfft(spectrum * np.exp(-2j * np.pi * np.fft.rfftfreq(x.size, 1.0 / rate_hz) * seconds), x.size)
