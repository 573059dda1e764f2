"""Three modes under forces whose level doubles half way."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.signal import lfilter

from drivers.base import ACCELERATION, GROUND, SampleBlock
from monitor.inference import Segments, gather
from tests.support.frames import shear_frame

RATE_HZ = 100.0
SHAPES = np.array([[1.0, 0.8, 0.4], [-0.6, 0.5, 1.0], [0.5, -1.0, 0.9]])
MODES_HZ = (3.0, 9.0, 14.0)
CONFIG = shear_frame([1.0] * 3, [2000.0] * 3)


@lru_cache
def vibration(seed: int, duration_s: float = 200.0) -> np.ndarray:
    """Three modes under forces whose level doubles half way, and 5 % noise, shape (n, 3)."""
    rng, n = np.random.default_rng(seed), round(duration_s * RATE_HZ)
    out = np.zeros((n, 3))
    for hz, shape in zip(MODES_HZ, SHAPES, strict=True):
        r, angle = np.exp(-0.01 * 2.0 * np.pi * hz / RATE_HZ), 2.0 * np.pi * hz / RATE_HZ
        mode = lfilter([1.0, -1.0], [1.0, -2.0 * r * np.cos(angle), r**2], rng.standard_normal(n))
        out += np.outer(mode / mode.std(), shape)
    out *= np.where(np.arange(n) < n // 2, 1.0, 2.0)[:, None]
    return np.asarray(out + 0.05 * out.std(axis=0) * rng.standard_normal(out.shape))


def segments(samples: np.ndarray, ground: np.ndarray | None = None) -> Segments:
    """Segments of a recording on one time base, as the reader sees it."""
    blocks = [SampleBlock(ACCELERATION, 0, 0, RATE_HZ, ("a1", "a2", "a3"), "m/s^2", samples.astype(np.float32))]
    if ground is not None:
        blocks.insert(0, SampleBlock(GROUND, 0, 0, RATE_HZ, ("g",), "m/s^2", ground.astype(np.float32)))
    return gather(blocks, CONFIG.front_end())
