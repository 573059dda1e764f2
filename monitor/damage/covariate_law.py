"""Dependence of healthy quantities on covariates: temperature, level of motion, wind, any named channel.

The relative change of each quantity (the stiffness of a story, or a feature) is a sum of piecewise linear functions, one for
each covariate.  The slope of each stretch is a common slope plus the stretch's own deviation, so kinks (frost) and saturation
are possible.  All slopes have Gaussian priors.  Learning, confounding, and the uncertainty beyond the range seen follow from
the one posterior: where nothing was seen, the slopes keep their priors, and the variance grows with the distance.

The slopes of the quantities have the prior covariance ``std^2 B``, where B correlates the quantities, and the noise of the
quantities the covariance N.  With ``N = A A^T`` and ``B = A diag(ratio) A^T`` the regression separates into one for each column
of A.

References
----------
C. M. Bishop, Pattern recognition and machine learning (2006), section 3.3 (Bayesian linear regression); E. V. Bonilla, K. M. A.
Chai, C. K. I. Williams, Multi-task Gaussian process prediction, NIPS 20 (2008) (quantities correlated by B).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations
from typing import Annotated

import numpy as np

from monitor.core import Array
from monitor.damage.common_change import CommonChange, Expected

_NO_INFORMATION = 1e3
"""Standard deviation of a change in a direction that no sensor observes. [relative change; rounding: any value far above 1]"""
_LAG_GAIN = 2.0
"""Gain in ln evidence from which a lag is preferred to none. [nats; convention: two standard deviations]"""
_CONFOUNDED = 0.8
"""Correlation of the effects of two covariates from which they are not told apart. [1; judgement: the data then leave less
than 36 percent of the variance of one to be decided without the other]"""


@dataclass(frozen=True, eq=False, slots=True)
class Axis:
    """One covariate, and how the quantities may depend on it."""

    name: str
    unit: str
    knots: Annotated[Array, "j"]
    """Increasing: where the slope may change."""
    slope_std: Annotated[Array, "j+2"]
    """Prior standard deviation of the common slope, then of the own slope of each stretch, per unit."""
    lag: int = 0
    """Column of the covariate's lagged values."""
    lag_s: float = 0.0
    """First-order lag of that column, s."""
    reference: float = 0.0
    """Value from which the stretches are counted."""
    range: tuple[float, float] = (0.0, 0.0)
    """Lowest and highest value learned from."""

    def basis(self, value: Annotated[Array, "w"]) -> Annotated[Array, "w j+2"]:
        """Compute the basis at values of the covariate: distance, then its stretches."""
        edges = np.concatenate([[-np.inf], self.knots, [np.inf]])
        low, high = edges[:-1], edges[1:]
        basis = np.empty((len(value), edges.size))
        np.subtract(value, self.reference, out=basis[:, 0])
        reference = np.minimum(np.maximum(self.reference, low), high)
        np.subtract(np.minimum(np.maximum(value[:, None], low), high), reference, out=basis[:, 1:])
        return basis

    def beyond(self, value: float) -> str:
        """State on which side of the learned range a value lies: ``below``, ``above`` or nothing."""
        low, high = self.range
        return "below" if value < low else "above" if value > high else ""


@dataclass(frozen=True, eq=False, slots=True)
class Effect:
    """What the law predicts at a window's covariates."""

    relative: Annotated[Array, "n"]
    """Relative change of each quantity since the reference."""
    covariance: Annotated[Array, "n n"]
    parts: Mapping[str, Annotated[Array, "n"]]
    """Share of each known covariate of ln(1 + relative)."""


@dataclass(frozen=True, eq=False, slots=True)
class CovariateLaw:
    """Posterior of the slopes of n quantities, with k basis functions of all covariates together."""

    axes: tuple[Axis, ...]
    centre: Annotated[Array, "k"]
    """Mean basis of the healthy windows, where the law predicts no change."""
    spread: Annotated[Array, "k k"]
    """Covariance of the basis over the healthy windows, for covariates that are missing later."""
    slopes: Annotated[Array, "n k"]
    """Mean of the slopes."""
    posterior: Annotated[Array, "n k k"]
    """Covariance of the slopes for each column of `mixing`."""
    mixing: Annotated[Array, "n n"]
    """The matrix A."""
    scatter: float = 1.0
    """Variance of the healthy windows about the law, over the variance that they state."""
    common: CommonChange | None = None
    """What the quantities did together without a known cause; None where that is not learned."""

    def columns(self) -> dict[str, slice]:
        """Return the columns of each covariate in the basis."""
        ends = np.cumsum([a.slope_std.size for a in self.axes])
        return {a.name: slice(int(e) - a.slope_std.size, int(e)) for a, e in zip(self.axes, ends, strict=True)}

    def expected(self, covariates: Mapping[str, Array]) -> Effect:
        """Predict the change of each quantity at a window's covariates, each with its lagged values.

        A covariate that is missing is taken as distributed as it was when the law was learned.
        """
        away, known = self._away(covariates)
        covariance = np.zeros((len(self.slopes),) * 2)
        if len(known) < len(self.axes):
            for name, columns in self.columns().items():
                if name not in known:
                    slopes = self.slopes[:, columns]
                    covariance += slopes @ self.spread[columns, columns] @ slopes.T
        ln = self.slopes @ away
        scale = np.exp(ln)
        covariance = (covariance + self._covariance(away)) * np.outer(scale, scale)
        parts = {name: self.slopes[:, c] @ away[c] for name, c in known.items()}
        return Effect(np.expm1(ln), covariance, parts)

    def variances(self, covariates: Mapping[str, Array]) -> dict[str, float]:
        """Compute the largest variance over the quantities that each known covariate of a window alone brings."""
        away, known = self._away(covariates)
        return {name: float(self._covariance(away, c).diagonal().max()) for name, c in known.items()}

    def _away(self, covariates: Mapping[str, Array]) -> tuple[Annotated[Array, "k"], dict[str, slice]]:
        """Compute the distance in the basis, and the columns of the covariates that are known."""
        away, known = np.zeros(self.centre.size), {}
        for axis, (name, columns) in zip(self.axes, self.columns().items(), strict=True):
            values = covariates.get(name)
            if values is not None and np.isfinite(values[axis.lag]):
                away[columns] = axis.basis(values[axis.lag : axis.lag + 1])[0] - self.centre[columns]
                known[name] = columns
        return away, known

    def at(self, values: Annotated[Array, "w axes"]) -> Annotated[Array, "w n"]:
        """Evaluate the law at known covariates, each at its lag, as changes of the logarithm."""
        basis = [a.basis(v) for a, v in zip(self.axes, values.T, strict=True)]
        return np.asarray((np.column_stack(basis) - self.centre) @ self.slopes.T)

    def together(self, unevenness: float) -> Expected | None:
        """Return how far the quantities change together without a known cause; None where that is not learned.

        `unevenness` is the scatter of their shares beyond what was learned, about a common one, relative to its size.
        """
        return _together(self, unevenness)

    def _covariance(self, away: Annotated[Array, "k"], columns: slice = slice(None)) -> Annotated[Array, "n n"]:
        """Compute the covariance of the change by a distance in the basis, along some of its columns."""
        part = away[columns]
        variance = np.einsum("k,ikl,l->i", part, self.posterior[:, columns, columns], part)
        return np.asarray((self.mixing * variance) @ self.mixing.T)

    def confounded(self) -> tuple[tuple[str, str, float], ...]:
        """List the pairs of covariates whose effects over the learned ranges are not told apart, with their correlation."""
        over = np.zeros((len(self.axes), self.centre.size))
        for row, axis, columns in zip(over, self.axes, self.columns().values(), strict=True):
            row[columns] = np.diff(axis.basis(np.array(axis.range)), axis=0)[0]
        together = np.einsum("ak,ikl,bl->ab", over, self.posterior, over)
        std = np.sqrt(np.maximum(together.diagonal(), 1e-300))
        found = []
        for a, b in combinations(range(len(self.axes)), 2):
            r = float(together[a, b] / std[a] / std[b])
            if abs(r) > _CONFOUNDED:
                found.append((self.axes[a].name, self.axes[b].name, r))
        return tuple(found)

    def over_range(self, name: str) -> tuple[Annotated[Array, "n"], Annotated[Array, "n"]]:
        """Compute the change between the ends of a covariate's learned range, and its standard deviation."""
        axis = next(a for a in self.axes if a.name == name)
        columns, away = self.columns()[name], np.zeros(self.centre.size)
        away[columns] = np.diff(axis.basis(np.array(axis.range)), axis=0)[0]
        return np.expm1(self.slopes @ away), np.sqrt(self._covariance(away).diagonal())


@lru_cache(maxsize=16)
def _together(law: CovariateLaw, unevenness: float) -> Expected | None:
    """Compute `CovariateLaw.together`, cached: one law serves all windows of an hour."""
    return None if law.common is None else law.common.learned(law.mixing, unevenness)


def stories_prior(n: int, unevenness: float) -> Annotated[Array, "n n"]:
    """Return B of n quantities that scatter about an unknown common one by `unevenness` times its size."""
    return np.asarray((np.ones((n, n)) + unevenness**2 * np.eye(n)) / (1.0 + unevenness**2))


def learn(
    changes: Annotated[Array, "w n"],
    noise: Annotated[Array, "n n"],
    prior: Annotated[Array, "n n"],
    axes: Sequence[Axis],
    values: Sequence[Annotated[Array, "w lags"]],
    overlap: float,
    lags_s: Sequence[float] = (0.0,),
) -> CovariateLaw:
    """Learn the slopes from healthy windows, each covariate at the lag of greatest evidence.

    `changes` are relative, `noise` is the covariance of one window's change, `prior` the correlation of the quantities' slopes
    (`stories_prior`).  `values` are the lagged values of each covariate, NaN where it is missing; of `lags_s`, a covariate with
    one column tries none.  `overlap` is the variance of the windows' mean over that of as many independent windows: overlapping
    windows do not count as many.
    """
    mixing, ratio = _separate(noise, prior)
    unseen = len(noise) - int(np.linalg.matrix_rank(noise, rtol=1e-9, hermitian=True))
    y = (changes - changes.mean(axis=0)) @ np.linalg.inv(mixing).T
    axes = list(axes)
    for i, axis in enumerate(axes):
        tried = {}
        for lag, lag_s in enumerate(lags_s[: values[i].shape[1]]):
            axes[i] = _placed(axis, lag, lag_s, values[i][:, lag])
            tried[lag] = _fit(y, ratio, axes, values, overlap)[0], axes[i]
        best = max(tried, key=lambda lag: tried[lag][0])
        axes[i] = tried[best if tried[best][0] - tried[0][0] > _LAG_GAIN else 0][1]
    scatter = 1.0
    for _ in range(3):  # the scatter about the law changes how closely the law follows the windows
        _, slopes, posterior, basis, left, freedom = _fit(y, ratio, axes, values, overlap, scatter)
        freedom -= unseen * (len(y) - overlap)
        scatter = max(1.0, float((left**2).sum()) / freedom) if freedom > 0.0 else 1.0
    return CovariateLaw(
        tuple(axes),
        np.nanmean(basis, axis=0),
        np.cov(_filled(basis).T, bias=True).reshape((basis.shape[1],) * 2),
        mixing @ slopes,
        posterior,
        mixing,
        scatter,
    )


def _placed(axis: Axis, lag: int, lag_s: float, values: Array) -> Axis:
    """Set the lag of an axis, and its reference and range to those of the values."""
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    return replace(axis, lag=lag, lag_s=lag_s, reference=float(np.nanmean(values)), range=(low, high))


def _separate(noise: Array, prior: Array) -> tuple[Array, Array]:
    """Find A and the ratios such that ``noise = A A^T`` and ``prior = A diag(ratio) A^T``.

    In directions without noise, which no sensor observes, a change of 0 was not measured: the noise is taken as infinite.
    """
    size, directions = np.linalg.eigh(noise)
    unseen = size <= 1e-9 * size[-1]
    root = directions * np.where(unseen, _NO_INFORMATION, np.sqrt(np.where(unseen, 1.0, size)))
    inverse = np.linalg.inv(root)
    ratio, turn = np.linalg.eigh(inverse @ prior @ inverse.T)
    return root @ turn, np.maximum(ratio, 0.0)


def _filled(basis: Array) -> Array:
    """Return the basis less its mean; 0 where a covariate is missing."""
    return np.asarray(np.nan_to_num(basis - np.nanmean(basis, axis=0)))


def _fit(
    y: Array, ratio: Array, axes: Sequence[Axis], values: Sequence[Array], overlap: float, scatter: float = 1.0
) -> tuple[float, Array, Array, Array, Array, float]:
    """Fit the separated quantities, shape (w, n), whose noise has the variance `scatter`.

    Returned are the ln evidence (less a constant), mean (n, k) and covariance (n, k, k) of the slopes, the basis (w, k), what is
    left (w, n), and its degrees of freedom.
    """
    basis = np.column_stack([a.basis(v[:, a.lag]) for a, v in zip(axes, values, strict=True)])
    x, std = _filled(basis), np.concatenate([a.slope_std for a in axes])
    scaled = x * std
    information, seen = scaled.T @ scaled / (overlap * scatter), scaled.T @ y / (overlap * scatter)
    evidence, freedom, w = 0.0, 0.0, len(y)
    slopes, posterior = np.zeros((ratio.size, std.size)), np.zeros((ratio.size, std.size, std.size))
    # Rounding leaves eigenvalues below 0, and quantities without noise, as of two equal channels, have a ratio without bound.
    size, turn = np.linalg.eigh(information)
    size = np.maximum(size, 0.0)
    for i, r in enumerate(ratio):
        covariance = (turn * (r / (1.0 + r * size))) @ turn.T
        slope = covariance @ seen[:, i]
        evidence += 0.5 * float(seen[:, i] @ slope - np.log1p(r * size).sum())
        freedom += w - overlap * (1.0 + float((r * size / (1.0 + r * size)).sum()))
        slopes[i], posterior[i] = std * slope, covariance * np.outer(std, std)
    return evidence, slopes, posterior, basis, y - x @ slopes.T, freedom
