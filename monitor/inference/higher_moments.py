"""What averaged spectra do not say and laws show: the skewness of drifts, and the kurtosis of modes.

A one-sided law leaves a drift skewed; no linear cause and no symmetric law does.  Under friction large motion is damped less
than small motion, so that a mode's level has heavier tails than that of a normal process; under drag lighter ones.  Both are
told at one level of the forces, where averaged spectra cannot tell such a law from a damper.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import ifft, irfft, next_fast_len

from monitor.core import Array, ComplexArray
from monitor.inference.map_estimate import MapEstimate
from monitor.inference.observed_spectra import relative_level
from monitor.inference.posterior import Posterior
from monitor.signals import overlap_correlation, taper

_MODE_BAND = 0.15
"""Half-width of a mode's band, over its frequency. [ratio; judgement]"""
_MIN_KURTOSIS_STD = 0.03
"""Least standard deviation of the kurtosis that forces of changing level give all modes. [1; judgement]"""
_MIN_BAND_WIDTH = 0.1
"""Least width of a band between modes, over its frequency. [ratio; judgement]"""
_STUDENT_FREEDOM = 10.0
"""Of Student's distribution for the kurtosis. [degrees of freedom; judgement: blows and tones, which no law here makes,
must not decide]"""


@dataclass(frozen=True, eq=False, slots=True)
class Moments:
    """Of the third order and of the fourth, beyond those of a normal process."""

    skewness: Array
    """Of every story's drift in the band, shape (n_stories,)."""
    kurtosis: Array
    """Excess of every mode's in a narrow band, shape (n,): of a normal process 0, of a tone -1.5."""

    def __add__(self, other: Moments) -> Moments:
        return Moments(self.skewness + other.skewness, self.kurtosis + other.kurtosis)

    def __sub__(self, other: Moments) -> Moments:
        return Moments(self.skewness - other.skewness, self.kurtosis - other.kurtosis)

    def __truediv__(self, n: float) -> Moments:
        return Moments(self.skewness / n, self.kurtosis / n)

    def mirrored(self, about: Moments) -> Moments:
        """With what is added to the skewness of others turned round."""
        return Moments(2.0 * about.skewness - self.skewness, self.kurtosis)


def normal_moments(posterior: Posterior) -> Moments:
    """Those of a normal process."""
    structure = posterior.context.structure
    return Moments(np.zeros(structure.n_stories), np.zeros(structure.n_dofs))


@dataclass(frozen=True, eq=False, slots=True)
class MeasuredMoments:
    """A recording's moments with their chance."""

    mean: Moments
    std: Moments
    uneven: float
    """Excess kurtosis between the modes, where motion follows the forces at once: what gusts within a segment make of it."""

    def log_likelihood(self, expected: Moments, spread: float) -> float:
        """Of expected ones that have `spread - 1` times the recording's chance in them, nats."""
        away = self.mean - expected
        skew = (away.skewness / self.std.skewness) ** 2 / spread + np.log(spread)
        known = self.std.kurtosis < np.inf
        variance = np.diag(spread * self.std.kurtosis[known] ** 2) + np.hypot(_MIN_KURTOSIS_STD, self.uneven) ** 2
        square = away.kurtosis[known] @ np.linalg.solve(variance, away.kurtosis[known])
        tails = (_STUDENT_FREEDOM + known.sum()) * np.log1p(square / _STUDENT_FREEDOM) + np.linalg.slogdet(variance)[1]
        return float(-0.5 * (skew.sum() + tails))


def measure_moments(transforms: ComplexArray, posterior: Posterior, at: MapEstimate) -> MeasuredMoments:
    """Moments of a recording's segments, shape (n_segments, n_bins, c); the modes are those of a fit."""
    split = _split(transforms, posterior, at)
    skew, tails = _skewness(split.floors, posterior), [_kurtosis(narrow, split.level) for narrow in split.modes]
    mean, std = (Moments(skew[i], np.array([t[i] for t in tails])) for i in (0, 1))
    return MeasuredMoments(mean, std, _uneven(split, posterior.observed.band.hz))


def simulate_moments(transforms: ComplexArray, posterior: Posterior, at: MapEstimate) -> Moments:
    """As `measure_moments`, without their chance."""
    split = _split(transforms, posterior, at)
    tails = np.array([_kurtosis(narrow, split.level)[0] for narrow in split.modes])
    return Moments(_skewness(split.floors, posterior)[0], tails)


@dataclass(frozen=True, eq=False, slots=True)
class _Split:
    """Segments by mode."""

    floors: ComplexArray
    """Shape (n_segments, n_bins, n)."""
    level: Array
    """Shape (n_segments,): every one counts by its own, which wanders."""
    modes: tuple[ComplexArray, ...]
    """Each of shape (n_segments, bins about the mode)."""
    between: NDArray[np.intp]
    """Bins that are about none."""


def _split(transforms: ComplexArray, posterior: Posterior, at: MapEstimate) -> _Split:
    context, hz = posterior.context, posterior.observed.band.hz
    floors = transforms[:, :, : len(context.channels)] @ np.linalg.pinv(context.sensors).T
    model = posterior.model(at.x, (*posterior.prior.effects(at.x), *at.effects))
    modes, n = model.modes(), context.structure.n_dofs
    pick = modes.shapes[:n, :n].T @ model.structural_matrices()[0][:n, :n]
    near = np.abs(hz - modes.frequencies_hz[:n, None]) < _MODE_BAND * modes.frequencies_hz[:n, None]
    narrow = tuple(floors[:, about] @ own for about, own in zip(near, pick, strict=True))
    return _Split(floors, relative_level(transforms), narrow, np.flatnonzero(~near.any(axis=0)))


def _uneven(split: _Split, hz: Array) -> float:
    """Excess kurtosis of floors between the modes, of all that there is room for; 0 where there is none."""
    found, weight, free = [0.0], [0.0], split.between
    for run in np.split(free, np.flatnonzero(np.diff(free) > 1) + 1):
        if run.size and hz[run[-1]] - hz[run[0]] > _MIN_BAND_WIDTH * hz[run[0]]:
            found += [_kurtosis(floor[:, run], split.level)[0] for floor in np.moveaxis(split.floors, 2, 0)]
            weight += [float(run.size)] * split.floors.shape[2]
    return max(0.0, float(np.dot(found, weight)) / max(sum(weight), 1.0))


def _skewness(floors: ComplexArray, posterior: Posterior) -> tuple[Array, Array]:
    """Mean over segments, and its standard deviation.

    Accelerations become drifts in the frequency domain; tapered segments keep the sign of the third moment.
    """
    band = posterior.observed.band
    drift = floors @ posterior.context.structure.drift_matrix().T / (-((2.0 * np.pi * band.hz) ** 2))[:, None]
    length = next_fast_len(4 * (band.first + band.n_bins), real=True)  # room for the third power
    full = np.zeros((drift.shape[0], drift.shape[2], length // 2 + 1), dtype=complex)
    full[:, :, band.first : band.first + band.n_bins] = drift.swapaxes(1, 2)
    d = irfft(full, n=length)
    second = np.einsum("sjt,sjt->sj", d, d) / length
    third = np.einsum("sjt,sjt,sjt->sj", d, d, d) / length / second**1.5
    return third.mean(axis=0), third.std(axis=0, ddof=1) / np.sqrt(third.shape[0])


def _kurtosis(narrow: ComplexArray, level: Array) -> tuple[float, float]:
    """Excess over all segments of transforms in a narrow band, shape (n_segments, n_bins), and its standard deviation: 0 and
    infinite where the band is empty."""
    if not narrow.shape[1]:
        return 0.0, np.inf
    length = next_fast_len(4 * narrow.shape[1])  # room for the fourth power
    power = np.abs(ifft(narrow, n=length, axis=1)) ** 2 / level[:, None]
    second, fourth = power.mean(axis=1), (power**2).mean(axis=1)
    ratio = fourth.mean() / second.mean() ** 2 / _normal(length)
    by_segment = ratio * (fourth / fourth.mean() - 2.0 * second / second.mean())
    std = by_segment.std(ddof=1) * np.sqrt((1.0 + 2.0 * overlap_correlation()) / len(second))
    return 3.0 * (float(ratio) - 1.0), 3.0 * float(std)


def _normal(length: int) -> float:
    """Mean fourth power of a normal process's envelope over its mean square squared, under the taper."""
    shape = taper(length) ** 2
    return float(2.0 * (shape**2).mean() / shape.mean() ** 2)
