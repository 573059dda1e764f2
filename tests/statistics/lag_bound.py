"""How well two hours of the hidden trials' weather can tell a lag, whatever the method: the Cramer-Rao bound.

`python -m tests.statistics.lag_bound` prints the least standard deviations, everything else known.
"""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from monitor.core import Array

MODES_HZ, DAMPING, DURATION_S = (5.2, 16.3, 23.0), 0.01, 7200
"""The paper's frame, lightly damped, and a record of two hours."""


def lagged(excess: Array, lag_s: float) -> Array:
    """The temperature behind a first-order lag, a sample a second."""
    keep = np.exp(-1.0 / lag_s)
    return np.asarray(lfilter([1.0 - keep], [1.0, -keep], excess, zi=[keep * excess[0]])[0])


def bound(per_degc: float, lag_s: float, swing: float) -> tuple[float, float]:
    """Least relative standard deviations of coefficient and lag.

    A lightly damped mode under white forces tells ln k, which is twice ln f, with information pi f / (2 zeta) a second
    (S.-K. Au, Uncertainty law in ambient modal identification, Mech. Syst. Signal Process. 48 (2014) 15-33:
    var(f) / f^2 = zeta / (2 pi f T)).
    """
    information = sum(2.0 * np.pi * f / (4.0 * DAMPING) for f in MODES_HZ)
    t = np.arange(DURATION_S + 1)
    excess = swing * 0.5 * (1.0 - np.cos(np.pi * t / DURATION_S)) + np.sin(2.0 * np.pi * t / 2400.0)
    slopes = np.array(
        [lagged(excess, lag_s), per_degc * (lagged(excess, lag_s + 1.0) - lagged(excess, lag_s - 1.0)) / 2.0]
    )
    std = np.sqrt(np.diag(np.linalg.inv(information * slopes @ slopes.T)))
    return float(std[0] / per_degc), float(std[1] / lag_s)


if __name__ == "__main__":
    for per_degc, lag_s in ((7.3e-4, 374.0), (8.2e-4, 1067.0), (1e-3, 600.0), (2e-3, 600.0), (2e-3, 1067.0)):
        for swing in (10.0, 16.0):
            coefficient, lag = bound(per_degc, lag_s, swing)
            print(f"{per_degc:g} per K, lag {lag_s:.0f} s, {swing:.0f} K: {coefficient:.0%} and {lag:.0%}")
