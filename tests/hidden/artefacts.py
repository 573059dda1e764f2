"""Faults of the electronics that a recording has and no effect describes: sizes refer to the channels' RMS."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.ndimage import gaussian_filter1d

from tests.hidden.truth import log_uniform

Artefact = Callable[[np.ndarray, float, np.random.Generator], tuple[np.ndarray, str]]
"""From samples, their rate and a generator to the samples with the fault, and its size in words."""
_HARMONICS = ((1, 1.0), (3, 0.3), (5, 0.15))
"""Of the mains, with their amplitudes over the first one's."""


def _smooth(n: int, rng: np.random.Generator, width: float) -> np.ndarray:
    """Noise of RMS 1 that is smooth over `width` samples."""
    grid = gaussian_filter1d(rng.standard_normal(round(10.0 * n / width) + 200), 10.0)[100:-100]
    return np.interp(np.arange(n), np.arange(grid.size) * width / 10.0, grid) / grid.std()


def _channel(samples: np.ndarray, rng: np.random.Generator) -> tuple[int, float]:
    j = int(rng.integers(samples.shape[1]))
    return j, float(samples[:, j].std())


def _moments(n: int, rate_hz: float, a_minute: float, rng: np.random.Generator) -> np.ndarray:
    return rng.integers(n, size=max(1, rng.poisson(a_minute * n / rate_hz / 60.0)))


def quantization(samples: np.ndarray, rate_hz: float, rng: np.random.Generator) -> tuple[np.ndarray, str]:
    """One coarse converter for all channels."""
    bit = log_uniform(rng, 0.02, 0.3)
    step = bit * float(samples.std(axis=0).mean())
    return step * np.round(samples / step), f"LSB {bit:.2g} RMS"


def hum(samples: np.ndarray, rate_hz: float, rng: np.random.Generator) -> tuple[np.ndarray, str]:
    """The mains on every channel with its harmonics; what lies above half the rate folds, for nothing filters it."""
    mains, size = float(rng.choice([50.0, 60.0])), log_uniform(rng, 0.03, 0.5)
    hz = mains + 0.02 * _smooth(len(samples), rng, 20.0 * rate_hz)
    phase = 2.0 * np.pi * np.cumsum(hz) / rate_hz
    tone = sum(a * np.sin(k * phase + rng.uniform(0.0, 2.0 * np.pi)) for k, a in _HARMONICS)
    reach = size * np.sqrt(2.0) * samples.std(axis=0) * rng.uniform(0.3, 1.0, samples.shape[1])
    folded = sorted({round(abs(k * mains - rate_hz * round(k * mains / rate_hz)), 1) for k, _ in _HARMONICS})
    return samples + np.asarray(tone)[:, None] * reach, f"{mains:g} Hz {size:.2g} RMS at {folded} Hz"


def drift(samples: np.ndarray, rate_hz: float, rng: np.random.Generator) -> tuple[np.ndarray, str]:
    """Every offset wanders by itself, over one to ten minutes."""
    size, width_s = log_uniform(rng, 0.5, 20.0), log_uniform(rng, 60.0, 600.0)
    wandering = [_smooth(len(samples), rng, width_s * rate_hz) for _ in range(samples.shape[1])]
    return samples + size * samples.std(axis=0) * np.stack(wandering, axis=1), f"{size:.2g} RMS over {width_s:.0f} s"


def steps(samples: np.ndarray, rate_hz: float, rng: np.random.Generator) -> tuple[np.ndarray, str]:
    """One channel's offset jumps, one to ten times in the record."""
    (j, rms), size, out = _channel(samples, rng), log_uniform(rng, 0.5, 10.0), samples.copy()
    at = rng.integers(len(samples), size=int(rng.integers(1, 11)))
    for k in at:
        out[k:, j] += size * rms * rng.standard_normal()
    return out, f"{at.size} of {size:.2g} RMS on a{j + 1}"


def spikes(samples: np.ndarray, rate_hz: float, rng: np.random.Generator) -> tuple[np.ndarray, str]:
    """Single wrong samples on one channel."""
    (j, rms), size, a_minute, out = (
        _channel(samples, rng),
        log_uniform(rng, 3.0, 50.0),
        log_uniform(rng, 0.2, 10.0),
        samples.copy(),
    )
    at = _moments(len(samples), rate_hz, a_minute, rng)
    out[at, j] += size * rms * rng.choice([-1.0, 1.0], at.size) * rng.uniform(0.5, 1.0, at.size)
    return out, f"{at.size} of {size:.2g} RMS on a{j + 1}"


def contact(samples: np.ndarray, rate_hz: float, rng: np.random.Generator) -> tuple[np.ndarray, str]:
    """A loose plug: for moments one channel is zero, or noise."""
    (j, rms), a_minute, out = _channel(samples, rng), log_uniform(rng, 0.2, 6.0), samples.copy()
    noise = 0.0 if rng.random() < 0.5 else log_uniform(rng, 0.5, 5.0)
    at = _moments(len(samples), rate_hz, a_minute, rng)
    for k in at:
        part = out[k : k + round(rate_hz * rng.uniform(0.05, 2.0)), j]
        part[:] = noise * rms * rng.standard_normal(part.size)
    return out, f"{at.size} with noise of {noise:.2g} RMS on a{j + 1}"


ARTEFACTS: dict[str, Artefact] = {a.__name__: a for a in (quantization, hum, drift, steps, spikes, contact)}
