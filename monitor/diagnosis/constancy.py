"""Do parts of a recording say the same of a coordinate of a fit?  Its interval, and the chance that there is nothing.

A model that lacks something spends its freedom on whatever bends that way: ranges of frequency then want different sizes, where a
law of another form is missing ranges of vibration level, and where a channel is at fault the other channels, which the fit's own
covariance does not know.  Here every range may deviate from a common size, and each channel is left out in turn
(docs/decisions/0101, 0104).

References
----------
C. R. Rao, Proc. Cambridge Phil. Soc. 44 (1948) 50 (score test); C. R. Henderson, Biometrics 31 (1975) 423 (mixed equations);
A. Gelman, Bayesian Analysis 1 (2006) 515 (uniform prior of a standard deviation); J. A. Hausman, Econometrica 46 (1978) 1251.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import chdtrc, ndtr

from monitor.core import Array, ComplexArray
from monitor.diagnosis.parameter_uncertainty import is_far
from monitor.inference import MapEstimate, Posterior, unpacked

_RANGES = 6
"""Ranges of frequency, or of level, that are compared. [count; judgement: twelve are no better, docs/decisions/0100]"""
_DISAGREE = 0.05
"""Chance of the scatter between parts that say the same, from which an interval holds it. [chance; convention: 5 %]"""
_LEAST_RANK = 3
"""Fewest independent differences between ranges that tell a spread. [count; Gelman 2006: three groups leave it open]"""
_NO_SPREAD = 1e-6
"""Share of the most information below which a direction, or the other channels, have none. [ratio; numerical]"""


@dataclass(frozen=True, eq=False, slots=True)
class CommonSize:
    """Size of a coordinate that is common to parts of a recording, as a mixture of normal densities."""

    weight: Annotated[Array, "n"]
    """Probability of each density, which has a standard deviation between ranges of its own."""
    change: Annotated[Array, "n"]
    """Mean of the common size, less the fitted one."""
    deviation: Annotated[Array, "n"]
    """Standard deviation of the common size."""
    statistic: float = 0.0
    """Chi-squared with `rank` degrees of freedom where all parts say the same."""
    rank: int = 0
    """Zero where parts cannot differ."""

    @classmethod
    def normal(cls, variance: float, change: float = 0.0, statistic: float = 0.0, rank: int = 0) -> Self:
        """Make a single normal density."""
        return cls(np.ones(1), np.array([change]), np.sqrt([max(variance, 0.0)]), statistic, rank)

    @property
    def std(self) -> float:
        """Compute half the half width of the interval about the fitted size that holds the common one in 95.4 % of cases."""

        def beyond(half_width: float) -> float:
            ends = (np.array([[-half_width], [half_width]]) - self.change) / self.deviation
            return float(self.weight @ (ndtr(ends[0]) + ndtr(-ends[1]))) - 2.0 * float(ndtr(-2.0))

        most = float((np.abs(self.change) + 3.0 * self.deviation).max())
        return 0.5 * float(brentq(beyond, 0.0, most, xtol=1e-9 * most)) if most > 0.0 else 0.0

    def chance_of_none(self, size: float) -> float:
        """Compute the probability that a size, fitted as a distance from no effect, is none or of the other sign."""
        towards = np.copysign(1.0, size) * (size + self.change)
        return float(self.weight @ ndtr(-towards / self.deviation))

    def is_doubtful(self, size: float, chance: float) -> bool:
        """Decide if a size may be none, where parts agree on it or disagree on it, but for a `chance`."""
        if self.chance_of_none(size) <= chance and is_far(size, self.std):
            return False
        scatter = float(chdtrc(self.rank, self.statistic)) if self.rank else 1.0
        return not chance <= scatter <= _DISAGREE


@dataclass(frozen=True, eq=False, slots=True)
class LinearFit:
    """Fit near its end, and what parts of the recording say of it.

    What a part says are the products of its whitened slopes and, last, of its whitened residual, summed over its rows.
    """

    covariance: Annotated[Array, "p p"]
    prior: Annotated[Array, "p"]
    """Precision of every coordinate by its own prior."""
    pull: Annotated[Array, "p"]
    """Mean of the prior, less the fitted coordinate."""
    frequencies: Annotated[Array, "bins p+1 p+1"]
    levels: Annotated[Array, "levels p+1 p+1"]
    """Classes of level, or segments in the order of their level where inputs were measured."""
    alone: Annotated[Array, "c p+1 p+1"]
    """What is lost without each channel."""

    @classmethod
    def of(cls, posterior: Posterior, fit: MapEstimate) -> Self:
        """Linearize the end of a fit."""
        prediction = posterior.predict(fit.x, fit.effects)
        slopes, residual, of_means = posterior.slope_rows(fit.x, fit.effects, prediction)
        k, n, c = prediction.spectra.shape[:3]
        rows = np.column_stack([slopes, np.r_[residual, of_means]])
        spectra = rows[: residual.size].reshape(k, n, c * c, -1)
        means = rows[residual.size :].reshape(2, -1, n, c, rows.shape[1])  # real and imaginary parts of every segment
        observed = posterior.observed
        levels = means[:, np.argsort(observed.level, kind="stable")].swapaxes(0, 1) if of_means.size else spectra
        mean, precision = posterior.normal_prior(fit.x, fit.effects)
        return cls(
            covariance=fit.covariance,
            prior=np.diag(precision),
            pull=mean - fit.x,
            frequencies=products(spectra.swapaxes(0, 1)) + products(np.moveaxis(means, 2, 0)),
            levels=products(levels),
            alone=products_of_channels(prediction.spectra, spectra, means[0] + 1j * means[1], observed.label),
        )

    def common_sizes(self, j: int) -> tuple[CommonSize, ...]:
        """Compute the sizes of coordinate j common to ranges of frequency, to ranges of level, and without each channel."""
        ranges = (common_size(parts, j, self.covariance) for parts in (self.frequencies, self.levels))
        return (*ranges, *(self._without(lost, j) for lost in self.alone))

    def _without(self, lost: Annotated[Array, "p+1 p+1"], j: int) -> CommonSize:
        """Estimate coordinate j without a channel and without its own prior, to first order (Hausman 1978).

        A fault of the channel that the model lacks is not in what the others measure.  What they cannot see is left as it was.
        """
        refitted = np.linalg.solve(np.eye(len(self.covariance)) - self.covariance @ lost[:-1, :-1], self.covariance)
        precision = np.array([1.0 / refitted[j, j], 1.0 / self.covariance[j, j]]) - self.prior[j]
        if _NO_SPREAD * precision[1] < precision[0] < precision[1]:
            change = (-(refitted[j] @ lost[:-1, -1]) / refitted[j, j] - self.prior[j] * self.pull[j]) / precision[0]
            statistic = float(change**2 / (1.0 / precision[0] - 1.0 / precision[1]))
            if chdtrc(1, statistic) < _DISAGREE / len(self.alone):
                return CommonSize.normal(1.0 / precision[0], change, statistic, 1)
        return CommonSize.normal(self.covariance[j, j])


def products(rows: Annotated[Array, "parts ... p"]) -> Annotated[Array, "parts p p"]:
    """Sum the products of the last axis over all axes but the first."""
    flat = rows.reshape(len(rows), -1, rows.shape[-1])
    return np.asarray(flat.swapaxes(1, 2) @ flat)


def common_size(parts: Annotated[Array, "parts p+1 p+1"], j: int, covariance: Annotated[Array, "p p"]) -> CommonSize:
    """Fit a deviation of coordinate j in every range of parts, normal with a standard deviation that is averaged over.

    Where the ranges agree there is none: from six of them a deviation of zero would be told from a small one by nothing else.
    `covariance` is that of all coordinates, the inverse of all parts' information and the prior's precision.
    """
    ranges = np.add.reduceat(parts[:, j], _first_of_ranges(parts[:, :-1, :-1], covariance[:, j]))
    own, score = ranges[:, :-1], ranges[:, -1]
    spread = np.diag(own[:, j]) - own @ covariance @ own.T
    values, vectors = np.linalg.eigh(spread)
    z, variance = vectors.T @ score, covariance[j, j]
    known = values > _NO_SPREAD * np.diag(spread).max()  # a deviation of all ranges alike is none
    statistic, rank = float((z[known] ** 2 / values[known]).sum()), int(known.sum())
    if rank < _LEAST_RANK:
        return CommonSize.normal(variance)
    if chdtrc(rank, statistic) > _DISAGREE:
        return CommonSize.normal(variance, statistic=statistic, rank=rank)
    along = vectors.T @ own @ covariance[:, j]
    taus = np.sqrt(variance) * np.geomspace(1e-3, 1e4, 281)
    precision = np.maximum(values, 0.0) + taus[:, None] ** -2
    change, variances = -(along * z / precision).sum(axis=1), variance + (along**2 / precision).sum(axis=1)
    values, z = values[known], z[known]
    total = values + (taus[:, None] * values) ** 2
    log_weight = -0.5 * (np.log(total) + z**2 / total).sum(axis=1) + np.log(taus)  # steps of the logarithm
    weight = np.exp(log_weight - log_weight.max())
    return CommonSize(weight / weight.sum(), change, np.sqrt(variances), statistic, rank)


def _first_of_ranges(information: Annotated[Array, "parts p p"], refitted: Annotated[Array, "p"]) -> NDArray[np.intp]:
    """Divide parts into ranges of equal information about a coordinate with all else refitted; return the first part of each.

    `refitted` says how all coordinates follow it: its column of the covariance.
    """
    share = np.cumsum(np.einsum("i,cij,j->c", refitted, information, refitted))
    if not share[-1] > 0.0:  # the prior alone determines it
        return np.zeros(1, dtype=np.intp)
    middle = share - 0.5 * np.diff(share, prepend=0.0)
    numbers = np.minimum(_RANGES * middle / share[-1], _RANGES - 1).astype(int)
    return np.flatnonzero(np.diff(numbers, prepend=-1))


def products_of_channels(
    predicted: Annotated[ComplexArray, "classes bins c c"],
    spectra: Annotated[Array, "classes bins c*c q"],
    means: Annotated[ComplexArray, "segments bins c q"],
    label: NDArray[np.intp],
) -> Annotated[Array, "c q q"]:
    """Compute what is lost of the sums of products without each channel.

    With S = L L^H the others' whitened spectra are P Y P, where Y = L^-1 dS L^-H and P takes out the direction of L^-1 e of the
    channel's unit vector e; their whitened means are P y.
    """
    c, q = predicted.shape[-1], spectra.shape[-1]
    if c < 2:
        return np.zeros((0, q, q))
    directions = np.linalg.inv(np.linalg.cholesky(predicted))
    directions /= np.linalg.norm(directions, axis=-2, keepdims=True)
    scale = np.full(c * c, np.sqrt(0.5))
    scale[np.arange(1, c + 1) ** 2 - 1] = 1.0  # on the diagonal
    out = np.zeros((c, q, q))
    for rows, of_class in zip(spectra, directions, strict=True):
        matrices = unpacked((scale[:, None] * rows).transpose(2, 1, 0))
        for a, direction in enumerate(np.moveaxis(of_class, -1, 0)):
            along = np.einsum("qnij,nj->qni", matrices, direction)
            twice = np.einsum("qni,ni->qn", along, direction.conj()).real
            flat = along.reshape(q, -1)
            out[a] += 2.0 * (flat @ flat.conj().T).real - twice @ twice.T
    for a, direction in enumerate(np.moveaxis(directions[label[: len(means)]], -1, 0)):
        flat = np.einsum("sniq,sni->qsn", means, direction.conj()).reshape(q, -1)
        out[a] += (flat @ flat.conj().T).real
    return out
