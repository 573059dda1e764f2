"""Two and a half minutes with one quake."""

from __future__ import annotations

from functools import cache

import numpy as np

from monitor.events import Event
from tests.events.shaken import RATE, T0_NS, Array, Shaken, kanai_tajimi, shake


def ground(duration_s: float, *quakes: tuple[float, float, int]) -> Array:
    """Ground motion of which each quake has a begin, s, a peak, m/s^2, and a seed."""
    out = np.zeros(round(duration_s * RATE))
    for at_s, peak, seed in quakes:
        rng = np.random.default_rng(seed)
        wave = kanai_tajimi(20.0, peak, 2.5, rng)
        out[round(at_s * RATE) :][: wave.size] += wave
    return out


@cache
def shaken() -> Shaken:
    """150 s with one quake at 80 s."""
    return shake(ground(150.0, (80.0, 1.0, 3)), np.random.default_rng(4))[0]


def true_drifts(motion: Shaken, event: Event) -> Array:
    begin, end = (round((t - T0_NS) * 1e-9 * RATE) for t in (event.begin_ns, event.end_ns))
    return np.asarray(np.abs(motion.drifts[begin:end]).max(axis=0))
