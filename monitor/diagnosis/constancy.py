"""Do disjoint ranges of frequency say the same of a coordinate of a fit?  Its interval, and the chance that there is nothing.

A model that lacks something spends its freedom on whatever bends that way: ranges of frequency then want different sizes, which
the fit's own covariance does not know.  Here every range may deviate from a common size (docs/decisions/0101).

References
----------
C. R. Rao, Proc. Cambridge Phil. Soc. 44 (1948) 50 (score test); C. R. Henderson, Biometrics 31 (1975) 423 (mixed equations);
A. Gelman, Bayesian Analysis 1 (2006) 515 (uniform prior of a standard deviation).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, ndtr

from monitor.core import Array
from monitor.inference import MapEstimate, Posterior

_RANGES = 6
"""Ranges of frequency that are compared. [count; judgement: twelve are no better, docs/decisions/0100]"""
_DISAGREE = 0.05
"""Chance of the scatter between ranges, where they say the same, from which they disagree. [chance; convention: 5 %]"""
_NO_SPREAD = 1e-6
"""Share of the largest eigenvalue below which a direction has no information. [ratio; numerical]"""


@dataclass(frozen=True, eq=False, slots=True)
class CommonSize:
    """Common size of a coordinate over ranges of frequency, as a mixture of normal densities."""

    weight: Annotated[Array, "n"]
    """Probability of each standard deviation between ranges."""
    change: Annotated[Array, "n"]
    """Mean of the common size, less the fitted one."""
    deviation: Annotated[Array, "n"]
    """Standard deviation of the common size."""
    statistic: float
    """Chi-squared with `rank` degrees of freedom where all ranges say the same."""
    rank: int

    @property
    def std(self) -> float:
        """Compute the root mean square distance of the common size from the fitted one."""
        return float(np.sqrt(self.weight @ (self.deviation**2 + self.change**2)))

    def chance_of_none(self, size: float) -> float:
        """Compute the probability that a size, fitted as a distance from no effect, is none or of the other sign."""
        towards = np.copysign(1.0, size) * (size + self.change)
        return float(self.weight @ ndtr(-towards / self.deviation))


@dataclass(frozen=True, eq=False, slots=True)
class LinearFit:
    """Fit near its end: whitened slopes and residual, and the covariance of all coordinates."""

    slopes: Annotated[Array, "rows p"]
    residual: Annotated[Array, "rows"]
    covariance: Annotated[Array, "p p"]
    """Inverse of the slopes' information and the prior's precision."""
    bins: Annotated[NDArray[np.intp], "rows"]
    """Index of every row's frequency, ascending."""

    @classmethod
    def of(cls, posterior: Posterior, fit: MapEstimate) -> Self:
        """Linearize the end of a fit."""
        prediction = posterior.predict(fit.x, fit.effects)
        slopes, residual, of_means = posterior.slope_rows(fit.x, fit.effects, prediction)
        k, n, c = prediction.spectra.shape[:3]
        bins = np.repeat(np.tile(np.arange(n), k), c * c)
        if of_means.size:  # real and imaginary parts of every segment
            bins = np.r_[bins, np.tile(np.repeat(np.arange(n), c), of_means.size // (n * c))]
        order = np.argsort(bins, kind="stable")
        return cls(slopes[order], np.r_[residual, of_means][order], fit.covariance, bins[order])

    def ranges(self, j: int) -> list[slice]:
        """Divide the rows into ranges of frequency that hold equal information about j, with all else refitted."""
        information = (self.slopes @ self.covariance[:, j]) ** 2
        share = np.cumsum(np.bincount(self.bins, information))
        if not share[-1] > 0.0:  # the prior alone determines it
            return [slice(None)]
        middle = share - 0.5 * np.diff(share, prepend=0.0)
        numbers = np.minimum(_RANGES * middle / share[-1], _RANGES - 1).astype(int)
        ends = [0, *(np.flatnonzero(np.diff(numbers[self.bins])) + 1), self.bins.size]
        return [slice(*pair) for pair in pairwise(ends)]

    def common_size(self, j: int) -> CommonSize:
        """Fit a deviation of coordinate j in every range, normal with a standard deviation that is averaged over.

        Where the ranges agree there is none: from six of them a deviation of zero would be told from a small one by nothing else.
        """
        column, ranges = self.slopes[:, j], self.ranges(j)
        own = np.array([column[rows] @ self.slopes[rows] for rows in ranges])
        score = np.array([column[rows] @ self.residual[rows] for rows in ranges])
        spread = np.diag(own[:, j]) - own @ self.covariance @ own.T
        values, vectors = np.linalg.eigh(spread)
        z, variance = vectors.T @ score, max(self.covariance[j, j], 0.0)
        known = values > _NO_SPREAD * np.diag(spread).max()  # a deviation of all ranges alike is none
        statistic, rank = float((z[known] ** 2 / values[known]).sum()), int(known.sum())
        if not rank or chdtrc(rank, statistic) > _DISAGREE:
            return CommonSize(np.ones(1), np.zeros(1), np.sqrt([variance]), statistic, rank)
        along = vectors.T @ own @ self.covariance[:, j]
        taus = np.sqrt(variance) * np.geomspace(1e-3, 1e4, 281)
        precision = np.maximum(values, 0.0) + taus[:, None] ** -2
        change, variances = -(along * z / precision).sum(axis=1), variance + (along**2 / precision).sum(axis=1)
        values, z = values[known], z[known]
        total = values + (taus[:, None] * values) ** 2
        log_weight = -0.5 * (np.log(total) + z**2 / total).sum(axis=1) + np.log(taus)  # steps of the logarithm
        weight = np.exp(log_weight - log_weight.max())
        return CommonSize(weight / weight.sum(), change, np.sqrt(variances), statistic, rank)
