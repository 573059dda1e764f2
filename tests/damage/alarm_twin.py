"""A twin of the window readings of an intact frame, thirty years of which take a minute.

A window's reading errs by the mean of 39 segment influences on the 10 s grid (20 s segments, half overlapped, as the likelihood
has them), so that windows that overlap are correlated as they should be; its standard deviation is estimated from the same
influences, blended with the exact one to the scatter that raw records show; a baseline of T seconds errs by T / 400 windows'
worth, once for all windows, and its stated deviation is estimated as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from monitor.core import Array
from monitor.damage import AlarmSettings, limits, sequential_test
from monitor.signals import overlap_correlation

HOP_S, WINDOW_S = 10.0, 400.0
WINDOW, SEGMENTS = 40, 39
"""Hops in a window's length; segments in it."""
YEAR = 3_155_760
"""Hops."""
MONTH = YEAR // 12
SURE_STDS = sequential_test.SURE_STDS
MEMORY_S, EXCESS, FREEDOM = 8 * 3600.0, 1.2, 30.0
"""Of the alarm's smoothed standard deviations, for which `test_the_twin_judges_as_the_alarm_does` vouches."""


@dataclass(frozen=True)
class Twin:
    """What raw records of the paper's frame with 10 % noise show (`raw_readings`)."""

    std: tuple[float, ...] = (0.00108, 0.00137, 0.00152)
    """Of one window's reading."""
    stated: tuple[float, ...] = (0.99, 1.01, 0.97)
    """Root mean square of the stated standard deviation over the actual one."""
    scatter: tuple[float, ...] = (0.13, 0.13, 0.13)
    """Relative standard deviation of the stated standard deviation."""
    correlation: tuple[float, ...] = (0.07, 0.03, -0.12)
    """Between the stories 1-2, 1-3, ... 2-3, ..."""
    skewness: float = 0.0
    """Of one window's reading."""

    def readings(self, hops: int, baseline_s: float, rng: np.random.Generator) -> tuple[Array, Array, Array]:
        """Errors of windows of an intact frame, variances stated for them, and for the baseline.

        Returns
        -------
        ndarray, shape (hops, n), twice; ndarray, shape (n,)
        """
        n = len(self.std)
        matrix = np.zeros((n, n))
        matrix[np.triu_indices(n, 1)] = self.correlation
        factor = np.linalg.cholesky(matrix + matrix.T + np.eye(n)) * np.array(self.std)[:, None]
        influence = rng.standard_normal((hops + SEGMENTS, n))
        if self.skewness:
            bend = self.skewness * np.sqrt(SEGMENTS) / 6.0
            influence = (influence + bend * (influence**2 - 1.0)) / np.sqrt(1.0 + 2.0 * bend**2)
        influence = influence @ factor.T
        rho = overlap_correlation()
        tap = np.sqrt((1 + np.sqrt(1 - 4 * rho**2)) / 2)
        influence = tap * influence[1:] + rho / tap * influence[:-1]
        mean = _boxcar(influence, SEGMENTS)
        square = _boxcar(influence**2, SEGMENTS) - mean**2
        full = 1.0 + 2.0 * rho * (SEGMENTS - 1) / SEGMENTS
        exact = np.array(self.std) ** 2
        # The scatter that 39 Gaussian segments alone would give their deviation, and what is left of it by blending.
        share = np.array(self.scatter) / np.sqrt(0.5 / (SEGMENTS - 1) * (1.0 + 2.0 * rho**2))
        variance = exact + share * (square * SEGMENTS / (SEGMENTS - 1.0) - exact)
        variance = np.maximum(variance, 0.05 * exact) * np.array(self.stated) ** 2
        common = exact * WINDOW_S / baseline_s
        off = rng.standard_normal(n) @ factor.T * np.sqrt(WINDOW_S / baseline_s)
        dof = 0.5 / np.array(self.scatter) ** 2 * baseline_s / WINDOW_S
        stated = common * rng.chisquare(dof) / dof * np.array(self.stated) ** 2
        return mean * np.sqrt(SEGMENTS / full) + off, variance, stated


TWIN = Twin()


def ideal(n: int) -> Twin:
    """A twin of n parts that err independently, as large as they are stated."""
    return Twin((0.001,) * n, (1.0,) * n, (0.13,) * n, (0.0,) * (n * (n - 1) // 2))


def limit(per_year: float, parts: int = 3, *, either_side: bool = False) -> float:
    """The limit for so many false announcements a year."""
    tests = limits.Scores(parts, 0, 2 if either_side else 1)
    return AlarmSettings(false_announcements_per_year=per_year).limit(tests, WINDOW_S, HOP_S)


def _boxcar(values: Array, n: int) -> Array:
    total = np.cumsum(values, axis=0)
    return (total[n - 1 :] - np.vstack([np.zeros((1, values.shape[1])), total[:-n]])) / n


def evidence(
    ddi: Array, variance: Array, common: Array, floor: float, *, either_side: bool = False
) -> tuple[Array, Array]:
    """`sequential.look` over a series of windows without holes: its `z` and `lasting`, right wherever they exceed `floor`.

    Returns
    -------
    ndarray, shape (hops, n), twice
    """
    n_hops, n = ddi.shape
    memory = round(MEMORY_S / HOP_S)
    log = np.log(variance)
    smooth = np.cumsum(log[: memory + 1], axis=0) / np.arange(1, min(memory + 1, n_hops) + 1)[:, None]
    if n_hops > memory + 1:
        share = 1.0 / (memory + 1)
        rest, _ = lfilter([share], [1.0, share - 1.0], log[memory + 1 :], axis=0, zi=(1.0 - share) * smooth[-1:])
        smooth = np.vstack([smooth, rest])
    variance = np.maximum(variance / EXCESS**2, np.exp(smooth)) * np.exp(1.0 / FREEDOM)
    best, lasting = np.full((2, n_hops, n), -np.inf)
    for stretch in sequential_test.STRETCHES:
        sums, spreads, counts = np.zeros_like(ddi), np.zeros_like(ddi), np.zeros((n_hops, 1))
        for back in range(0, stretch * WINDOW, WINDOW):
            sums[back:] += ddi[: n_hops - back]
            spreads[back:] += variance[: n_hops - back]
            counts[back:] += 1.0
        mean, spread = sums / counts, spreads / counts**2
        away = np.abs(mean) if either_side else mean
        at = np.flatnonzero((away > floor * np.sqrt(spread + common)).any(axis=1))
        if not at.size:
            continue
        covariance = (spread[at] + common)[:, :, None] * np.eye(n)
        z, _ = sequential_test.statistic(mean[at], covariance, AlarmSettings().model_form)
        if either_side:
            z = np.maximum(z, sequential_test.statistic(-mean[at], covariance, AlarmSettings().model_form)[0])
        own = FREEDOM * (1.0 + np.minimum(at, memory) * HOP_S / WINDOW_S)[:, None]
        freedom = limits.freedom_of_sum((spread[at], np.broadcast_to(common, spread[at].shape)), (own, np.inf))
        z = limits.as_normal(z, freedom)
        limit = sequential_test.CHANCE_STDS * np.sqrt(variance[at] * (1.0 - 2.0 / counts[at]) + spread[at])
        agrees = (np.abs(ddi[at] - mean[at]) <= limit) | (stretch == 1)
        z = np.where(agrees, z, -np.inf)
        best[at] = np.maximum(best[at], z)
        lasting[at] = np.maximum(lasting[at], np.where(counts[at] > 1, z, -np.inf))
    return best, lasting


def episodes(z: Array, threshold: float, apart: int = 360) -> int:
    """How often any story's evidence exceeds the threshold, an hour's quiet between."""
    at = np.flatnonzero((z >= threshold).any(axis=1))
    return int(at.size > 0) + int(np.count_nonzero(np.diff(at) > apart))
