"""Higher moments, which averaged spectra do not contain: the skewness of drifts, and the kurtosis of modes.

A one-sided law makes a drift skewed; no linear cause and no symmetric law does.  Under friction large motion is damped less than
small motion, so that a mode's level has heavier tails than that of a normal process; under drag it has lighter tails.  Skewness
and kurtosis identify such laws at one level of the forces, where averaged spectra cannot distinguish them from a damper.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy.fft import ifft, irfft, next_fast_len
from scipy.linalg import eigh

from monitor.core import Array, ComplexArray
from monitor.inference.arrays import Transforms
from monitor.inference.map_estimate import MapEstimate
from monitor.inference.observed_spectra import relative_level
from monitor.inference.posterior import Posterior
from monitor.inference.trial import require_finite
from monitor.model import Line
from monitor.signals import MAIN_LOBE_BINS, overlap_correlation, taper

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
    """Moments of the third and the fourth order, in excess of those of a normal process."""

    skewness: Annotated[Array, "stories"]
    """Skewness of every story's drift in the band."""
    kurtosis: Annotated[Array, "n"]
    """Excess kurtosis of every mode in a narrow band: 0 for a normal process, -1.5 for a tone."""

    def __add__(self, other: Moments) -> Moments:
        return Moments(self.skewness + other.skewness, self.kurtosis + other.kurtosis)

    def __sub__(self, other: Moments) -> Moments:
        return Moments(self.skewness - other.skewness, self.kurtosis - other.kurtosis)

    def __truediv__(self, n: float) -> Moments:
        return Moments(self.skewness / n, self.kurtosis / n)

    def mirrored(self, about: Moments) -> Moments:
        """Reverse the sign of the skewness relative to that of other moments."""
        return Moments(2.0 * about.skewness - self.skewness, self.kurtosis)


def normal_moments(posterior: Posterior) -> Moments:
    """Return the moments of a normal process, which are zero."""
    structure = posterior.context.structure
    return Moments(np.zeros(structure.n_stories), np.zeros(structure.n_dofs))


@dataclass(frozen=True, eq=False, slots=True)
class MeasuredMoments:
    """Moments of a recording with their standard deviations."""

    mean: Moments
    std: Moments
    uneven: float
    """Excess kurtosis between the modes, where motion follows the forces at once: that of gusts within a segment."""

    def log_likelihood(self, expected: Moments, spread: float) -> float:
        """Compute the log likelihood of expected moments, nats.

        `spread` is the variance of the difference over that of the measured moments; the variance of the expected moments, such
        as simulated ones, is `spread - 1` times that of the measured ones.
        """
        away = self.mean - expected
        skew = (away.skewness / self.std.skewness) ** 2 / spread + np.log(spread)
        known = self.std.kurtosis < np.inf
        variance = np.diag(spread * self.std.kurtosis[known] ** 2) + np.hypot(_MIN_KURTOSIS_STD, self.uneven) ** 2
        square = away.kurtosis[known] @ np.linalg.solve(variance, away.kurtosis[known])
        tails = (_STUDENT_FREEDOM + known.sum()) * np.log1p(square / _STUDENT_FREEDOM) + np.linalg.slogdet(variance)[1]
        return float(-0.5 * (skew.sum() + tails))


def measure_moments(transforms: Transforms, posterior: Posterior, at: MapEstimate) -> MeasuredMoments:
    """Measure the moments of a recording's segments, with their standard deviations, about the modes of the fit `at`."""
    context, hz, level = posterior.context, posterior.observed.band.hz, relative_level(transforms)
    floors = transforms[:, :, : len(context.channels)] @ np.linalg.pinv(context.sensors).T
    model = posterior.model(at.x, (*posterior.prior.effects(at.x), *at.effects))
    modes, n = model.modes(), context.structure.n_dofs
    pick = modes.shapes[:n, :n].T @ model.structural_matrices()[0][:n, :n]
    near = np.abs(hz - modes.frequencies_hz[:n, None]) < _MODE_BAND * modes.frequencies_hz[:n, None]
    tails = [_kurtosis(floors[:, about] @ own, level) for about, own in zip(near, pick, strict=True)]
    skew = drift_skewness(floors, posterior)
    mean, std = (Moments(skew[i], np.array([t[i] for t in tails])) for i in (0, 1))
    between = np.flatnonzero(~near.any(axis=0))
    return MeasuredMoments(mean, std, _kurtosis_between_modes(floors, level, between, hz))


def tone_log_odds(posterior: Posterior, at: MapEstimate, line: Line) -> float:
    """Compute the log odds of a tone of steady amplitude against a random motion of the same spectrum, nats.

    The kurtosis at the line's frequency is -1.5 for a tone and 0 for a random motion, however narrow its band.  The fit with the
    line, `at`, gives the share of the power that is the line's.
    """
    band = posterior.observed.band
    near = np.flatnonzero(np.abs(band.hz - line.frequency_hz) <= MAIN_LOBE_BINS * band.bin_hz)
    if not near.size:
        return 0.0
    others = tuple(e for e in at.effects if line not in e.lines())
    counts = posterior.observed.counts / posterior.observed.counts.sum()
    total, rest = (
        np.einsum("k,kfab->ab", counts, posterior.scatter(x, effects)[:, near])
        for x, effects in ((at.x, at.effects), (at.x[: posterior.layout.n_nuisance], others))
    )
    # Of all combinations of channels, the one in which the line stands out most.
    require_finite(total, rest)
    share, direction = (a[..., -1] for a in eigh(total - rest, total))
    c = total.shape[0]
    transforms = posterior.observed.segments.values[:, :, :c]
    kurtosis, std = _kurtosis(transforms[:, near] @ direction.conj(), relative_level(transforms))
    std = float(np.hypot(std, _MIN_KURTOSIS_STD))

    def log_likelihood(expected: float) -> float:
        square = ((kurtosis - expected) / std) ** 2
        return -0.5 * (_STUDENT_FREEDOM + 1.0) * float(np.log1p(square / _STUDENT_FREEDOM))

    return log_likelihood(-1.5 * float(share) ** 2) - log_likelihood(0.0)


def _kurtosis_between_modes(
    floors: Annotated[ComplexArray, "segments bins n"], level: Array, between: NDArray[np.intp], hz: Array
) -> float:
    """Average the excess kurtosis of the floors over all sufficiently wide bands between modes; 0 where there is none."""
    found, weight = [0.0], [0.0]
    for run in np.split(between, np.flatnonzero(np.diff(between) > 1) + 1):
        if run.size and hz[run[-1]] - hz[run[0]] > _MIN_BAND_WIDTH * hz[run[0]]:
            found += [_kurtosis(floor[:, run], level)[0] for floor in np.moveaxis(floors, 2, 0)]
            weight += [float(run.size)] * floors.shape[2]
    return max(0.0, float(np.dot(found, weight)) / max(sum(weight), 1.0))


def drift_skewness(floors: Annotated[ComplexArray, "segments bins n"], posterior: Posterior) -> tuple[Array, Array]:
    """Compute the mean skewness of every drift over segments, and its standard deviation.

    A drift that no sensor moves with has the skewness 0 with an infinite standard deviation.

    Accelerations are integrated to drifts in the frequency domain.  The taper does not change the sign of the third moment.
    """
    band = posterior.observed.band
    drift = floors @ posterior.context.structure.drift_matrix().T / (-((2.0 * np.pi * band.hz) ** 2))[:, None]
    length = next_fast_len(4 * (band.first + band.n_bins), real=True)  # room for the third power
    full = np.zeros((drift.shape[0], drift.shape[2], length // 2 + 1), dtype=complex)
    full[:, :, band.first : band.first + band.n_bins] = drift.swapaxes(1, 2)
    d = irfft(full, n=length)
    second = np.einsum("sjt,sjt->sj", d, d) / length
    seen = (second > 0.0).all(axis=0)  # no sensor moves with the others' drifts
    third = np.einsum("sjt,sjt,sjt->sj", d, d, d) / length / np.where(seen, second, 1.0) ** 1.5
    std = third.std(axis=0, ddof=1) / np.sqrt(third.shape[0])
    return np.where(seen, third.mean(axis=0), 0.0), np.where(seen, std, np.inf)


def _kurtosis(narrow: Annotated[ComplexArray, "segments bins"], level: Array) -> tuple[float, float]:
    """Compute the excess kurtosis in a narrow band, and its standard deviation; 0 and infinity in an empty one."""
    if not narrow.shape[1]:
        return 0.0, np.inf
    length = next_fast_len(4 * narrow.shape[1])  # room for the fourth power
    power = np.abs(ifft(narrow, n=length, axis=1)) ** 2 / level[:, None]
    second, fourth, shape = power.mean(axis=1), (power**2).mean(axis=1), taper(length) ** 2
    # Mean fourth power of a normal process's envelope, over the square of its mean square, under the taper.
    normal = float(2.0 * (shape**2).mean() / shape.mean() ** 2)
    ratio = fourth.mean() / second.mean() ** 2 / normal
    by_segment = ratio * (fourth / fourth.mean() - 2.0 * second / second.mean())
    std = by_segment.std(ddof=1) * np.sqrt((1.0 + 2.0 * overlap_correlation()) / len(second))
    return 3.0 * (float(ratio) - 1.0), 3.0 * float(std)
