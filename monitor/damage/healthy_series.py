"""Law and scatter of a healthy series of readings, by the covariates that were measured with it.

The law is a sum of one function of each covariate, straight with bends, and of products of pairs.  Each straight part, the bends
of one covariate, and the products have a prior variance of their own, found by marginal likelihood: where a series shows no
bends there are none, and beyond the learned range the law is as uncertain as the bends that were learned make it.  The lag of a
covariate is that of greatest evidence.  The logarithm of the scatter has a law of the same kind.  Readings count by the tails
that the series has (Student's t) and, since they are correlated in time, as fewer independent ones.

What the law leaves of each part of the healthy time, learned from the rest, holds the error of the law as well.

References
----------
D. J. C. MacKay, Bayesian interpolation, Neural Computation 4 (1992) 415-447 (prior variances by marginal likelihood); K. Lange,
R. Little, J. Taylor, J. Am. Stat. Assoc. 84 (1989) 881-896 (t distribution); A. C. Harvey, Econometrica 44 (1976) 461-465
(regression of the logarithm of squared residuals); C. J. Geyer, Statist. Sci. 7 (1992) 473-483 (sum of a correlation).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtrit
from scipy.stats import t as student

from monitor.core import Array, BadInputError
from monitor.signals import NORMAL_MAD

LAGS_H = (0.0, 3.0, 6.0, 12.0, 24.0, 48.0)
"""First-order lags that are tried. [h; judgement: air to steel deck, and to thick concrete]"""
FOLDS = 8
"""Parts of the healthy time that are left out of the learning in turn. [1; convention: cross-validation by 5 to 10 folds]"""
_LEAST_READINGS = 10
"""Fewest healthy readings from which a feature is learned. [readings; judgement: one or two of each fold]"""
_BEND_STEPS = 8
"""Steps between bends over the learned range of a covariate, and as many beyond it. [1; judgement: finer steps of as much prior
variance give the same law]"""
_FROST_PER_K = 0.01
"""Prior relative change a kelvin in frost, where too little frost was learned from. [1/K; Z24 bridge: some 1 percent]"""
_FROST_SEEN = 0.02
"""Share of readings in frost from which the readings say how large the change is. [1; judgement]"""
_PASSES = 4
"""Passes of law, scatter, tails and correlation, each by the others. [1; simulation: the fifth changes nothing]"""
_LOG_SQUARE = (-(np.euler_gamma + np.log(2.0)), 0.5 * np.pi**2)
"""Mean and variance of the logarithm of the square of a normal number. [1; definition]"""
TAILS = (2.5, 3.0, 4.0, 5.0, 7.0, 10.0, 15.0, 30.0, 100.0)
"""Degrees of freedom that are tried for the tails. [1; convention: from the least with a variance to nearly normal]"""
_PRIORS = (1e-12, 1e4)
"""Range of a prior variance over the variance of the readings. [ratio; rounding]"""


@dataclass(frozen=True, slots=True)
class Covariate:
    """How a covariate, at its lag, enters a law."""

    name: str
    lag: int
    """Column of the lagged values."""
    mean: float
    std: float
    range: tuple[float, float]
    """Lowest and highest value learned from."""
    frost: float
    """Share of the readings that were learned below 0; NaN for what is no temperature in degC and never changes its sign."""

    def parts(self, values: Annotated[Array, "w"]) -> tuple[Array, ...]:
        """Compute the straight part (w, 1), the bends (w, b), and, where there may be frost, the bend at 0 (w, 1)."""
        low, high = self.range
        step = (high - low) / _BEND_STEPS
        knots = low + step * np.arange(-_BEND_STEPS // 2, _BEND_STEPS + _BEND_STEPS // 2 + 1)
        rising, falling = knots[knots >= self.mean], knots[knots < self.mean]
        column = values[:, None]
        bends = np.hstack([np.maximum(column - rising, 0.0), np.maximum(falling - column, 0.0)])
        straight = (column - self.mean) / self.std, bends * np.sqrt(step / self.std) / self.std
        return straight if np.isnan(self.frost) else (*straight, np.minimum(column, 0.0) / self.std)

    def beyond(self, value: float) -> str:
        """State on which side of the learned range a value lies: ``below``, ``above`` or nothing."""
        low, high = self.range
        return "below" if value < low else "above" if value > high else ""


@dataclass(frozen=True, eq=False, slots=True)
class Basis:
    """Functions of all covariates together, k of them, and the groups that have a prior variance in common."""

    covariates: tuple[Covariate, ...]
    groups: Annotated[NDArray[np.intp], "k"]
    fixed: Mapping[int, float]
    """Prior variances of groups that the readings cannot tell."""
    centre: Annotated[Array, "k"]
    spread: Annotated[Array, "k k"]
    """Mean and covariance over the healthy readings, for covariates that are missing later."""

    def at(self, lagged: Mapping[str, Annotated[Array, "w lags"]], w: int) -> Annotated[Array, "w k"]:
        """Compute the functions at lagged covariates, less their healthy means; NaN where a covariate is missing."""
        return _functions(self.covariates, lagged, w)[0] - self.centre

    def columns(self, covariate: int) -> NDArray[np.bool_]:
        """Select the functions of one covariate alone."""
        of = np.repeat(np.arange(len(self.covariates)), [2 + (not np.isnan(c.frost)) for c in self.covariates])
        return np.isin(self.groups, 1 + np.flatnonzero(of == covariate))


class _Fit(NamedTuple):
    """Posterior of coefficients."""

    mean: Annotated[Array, "k"]
    covariance: Annotated[Array, "k k"]
    prior: Annotated[Array, "k"]
    """Prior variances."""
    evidence: float
    """Logarithm of the marginal likelihood, less what the functions do not change."""

    def predict(self, x: Annotated[Array, "w k"], spread: Annotated[Array, "k k"]) -> tuple[Array, Array]:
        """Predict values and their variances, shape (w,), at functions that are NaN where a covariate is missing."""
        known = np.nan_to_num(x)
        variance = ((known @ self.covariance) * known).sum(axis=1)
        for missing in np.unique(np.isnan(x), axis=0):
            if missing.any():
                at = np.where(missing, self.mean, 0.0)
                variance[(np.isnan(x) == missing).all(axis=1)] += float(at @ spread @ at)
        return known @ self.mean, variance


@dataclass(frozen=True, eq=False, slots=True)
class FeatureModel:
    """Law and healthy scatter of one feature."""

    name: str
    log: bool
    """True if relative changes are judged: the feature is positive."""
    readings: int
    basis: Basis
    law: _Fit
    scatter: _Fit
    """Law of the logarithm of the variance about the law."""
    scatter_range: tuple[float, float]
    """Least and greatest logarithm of the variance that was learned."""
    std: float
    """Typical scatter of a healthy reading about its prediction."""
    explained: float
    """Share of the healthy variance that the covariates explain, by predictions of what was left out."""
    tails: float
    """Degrees of freedom of the readings' distribution."""

    def left(self, values: Annotated[Array, "w"], lagged: Mapping[str, Array]) -> Left:
        """Compute what the law leaves of readings, NaN where one is missing."""
        x = self.basis.at(lagged, values.size)
        expected, law = self.law.predict(x, self.basis.spread)
        return Left(_scaled(values, log=self.log) - expected, self.variance(x), law)

    def variance(self, x: Annotated[Array, "w k"]) -> Annotated[Array, "w"]:
        """Compute the variance of a reading about the law at values of the functions, larger where its own law is less known."""
        ln, error = self.scatter.predict(x, self.basis.spread)
        return np.asarray(np.exp(np.clip(ln, *self.scatter_range) + 0.5 * error))

    def confounded(self, limit: float = 0.8) -> list[tuple[str, str, float]]:
        """List the pairs of covariates whose changes over the learned ranges are correlated beyond a limit, with it."""
        over = np.zeros((len(self.basis.covariates), self.law.mean.size))
        for row, covariate in enumerate(self.basis.covariates):
            ends = np.hstack(covariate.parts(np.array(covariate.range)))
            over[row, self.basis.columns(row)] = ends[1] - ends[0]
        together = over @ self.law.covariance @ over.T
        std = np.sqrt(np.maximum(together.diagonal(), 1e-300))
        names = [covariate.name for covariate in self.basis.covariates]
        pairs = ((a, b, float(together[a, b] / std[a] / std[b])) for a, b in combinations(range(len(names)), 2))
        return [(names[a], names[b], r) for a, b, r in pairs if abs(r) > limit]


class Left(NamedTuple):
    """What a law leaves of the readings of a feature, or of k features."""

    residual: Array
    """NaN where a reading is missing."""
    variance: Array
    """Of a healthy reading about the law."""
    law: Array
    """Variance of the law itself."""


def lagged(t_ns: NDArray[np.int64], values: Annotated[Array, "w"]) -> Annotated[Array, "w lags"]:
    """Apply the first-order lags to a covariate; missing values stay missing."""
    out = np.full((values.size, len(LAGS_H)), np.nan)
    lags_ns = np.maximum(np.array(LAGS_H) * 3.6e12, 1.0)
    state, before = None, int(t_ns[0]) if t_ns.size else 0
    for k in np.flatnonzero(np.isfinite(values)):
        decay = np.exp(-(int(t_ns[k]) - before) / lags_ns)
        state = np.full(lags_ns.size, values[k]) if state is None else values[k] + (state - values[k]) * decay
        out[k], before = state, int(t_ns[k])
    return out


def learn(
    name: str, values: Annotated[Array, "w"], covariates: Mapping[str, Annotated[Array, "w lags"]]
) -> tuple[FeatureModel, Left]:
    """Learn a feature from its healthy readings, NaN where one is missing.

    Beside the model is what it leaves of each part of the time, learned from the rest.

    Raises BadInputError if there are too few readings, or most are the same number.
    """
    rows = np.flatnonzero(np.isfinite(values))
    if rows.size < _LEAST_READINGS:
        raise BadInputError(f"feature {name!r}: {rows.size} healthy readings, at least {_LEAST_READINGS} are needed")
    log = bool((values[rows] > 0.0).all())
    y = _scaled(values[rows], log=log)
    size = NORMAL_MAD * float(np.median(np.abs(y - np.median(y))))
    if size == 0.0:
        raise BadInputError(f"feature {name!r}: more than half of its healthy readings are the same number")
    known = {of: column[rows] for of, column in covariates.items() if _moves(column[rows])}
    basis = _basis(known, dict.fromkeys(known, 0), rows.size, size if log else None)
    x = np.nan_to_num(basis.at(known, rows.size))
    parts = np.array_split(np.arange(rows.size), FOLDS)
    variance, weights, times = np.full(rows.size, size**2), np.ones(rows.size), 1.0
    for k in range(_PASSES):
        certainty = weights / (variance * times)
        if k == 1 and known:
            basis = _with_lags(basis, known, y, certainty, size if log else None)
            x = np.nan_to_num(basis.at(known, rows.size))
        law = _fit(x, y, certainty, basis)
        left, of_law = _left_out(x, y, certainty, law, parts)
        square = np.maximum(left**2, 1e-3 * np.median(left**2))
        even = np.full(rows.size, 1.0 / (_LOG_SQUARE[1] * times))
        scatter = _fit(x, np.log(square) - _LOG_SQUARE[0], even, basis) if known else None
        variance = np.ones(rows.size) if scatter is None else np.exp(x @ scatter.mean)
        scale = NORMAL_MAD**2 * float(np.median(square / variance))
        variance *= scale
        heavy, weights = tails(left / np.sqrt(variance))
        times = correlation_time(left / np.sqrt(variance) * weights)
    flat = _Fit(np.zeros(x.shape[1]), np.zeros((x.shape[1],) * 2), np.zeros(x.shape[1]), 0.0)
    scatter = flat if scatter is None else scatter
    shifted = scatter._replace(mean=scatter.mean + np.eye(x.shape[1])[0] * np.log(scale))
    bounded = np.clip(left, -4.0 * np.sqrt(variance), 4.0 * np.sqrt(variance))
    model = FeatureModel(
        name,
        log,
        int(rows.size),
        basis,
        law,
        shifted,
        (float(np.log(variance.min())), float(np.log(variance.max()))),
        float(np.sqrt(np.median(variance))),
        1.0 - float(np.var(bounded) / np.var(np.clip(y, np.median(y) - 4.0 * size, np.median(y) + 4.0 * size))),
        heavy,
    )
    whole = Left(*(np.full(values.size, np.nan) for _ in range(3)))
    for all_rows, some in zip(whole, (left, variance, of_law), strict=True):
        all_rows[rows] = some
    return model, whole


def correlation_time(x: Annotated[Array, "w ..."]) -> float:
    """Estimate how many of consecutive numbers count as one independent one, for their mean: 1 or more.

    Of several columns it is their mean.  The sum of the correlation ends where a pair of its values is not positive (Geyer).
    """
    x = x.reshape(len(x), -1) - x.mean(axis=0)
    spectrum = np.abs(np.fft.rfft(x, 2 * len(x), axis=0)) ** 2
    r = np.fft.irfft(spectrum.sum(axis=1))[: len(x)]
    if not r[0] > 0.0:
        return 1.0
    pairs = (r[: len(x) // 2 * 2] / r[0]).reshape(-1, 2).sum(axis=1)
    stop = int(np.argmax(pairs <= 0.0)) if (pairs <= 0.0).any() else pairs.size
    return max(1.0, float(2.0 * pairs[:stop].sum() - 1.0))


def _scaled(values: Array, *, log: bool) -> Array:
    """Return the values, or their logarithms: NaN where there is none."""
    return np.asarray(np.log(np.where(values > 0.0, values, np.nan)) if log else values)


def _moves(column: Annotated[Array, "w lags"]) -> bool:
    """Tell whether a covariate is known for most readings, and is not always the same."""
    known = column[np.isfinite(column[:, 0]), 0]
    return bool(2 * known.size > len(column) and known.min() < known.max())


def _is_temperature(name: str) -> bool:
    """Tell by its name whether a covariate is a temperature in degC, at 0 of which frost begins."""
    lower = name.lower()
    return "temp" in lower or lower.endswith(("degc", "_c")) or lower in ("t", "ta", "tair")


def _basis(lagged: Mapping[str, Array], lags: Mapping[str, int], w: int, size: float | None) -> Basis:
    """Lay out the functions of covariates at their lags; `size` is the readings' scatter where it is relative."""
    covariates = []
    for name, column in lagged.items():
        values = column[np.isfinite(column[:, lags[name]]), lags[name]]
        ends = float(values.min()), float(values.max())
        has_frost = _is_temperature(name) or ends[0] < 0.0 < ends[1]
        frost = float((values < 0.0).mean()) if has_frost else np.nan
        covariates.append(Covariate(name, lags[name], float(values.mean()), float(values.std()), ends, frost))
    x, groups = _functions(covariates, lagged, w)
    fixed = {0: np.inf}
    first = 1
    for covariate in covariates:
        if size is not None and covariate.frost < _FROST_SEEN and _is_temperature(covariate.name):
            fixed[first + 2] = (_FROST_PER_K * covariate.std) ** 2
        first += 2 + (not np.isnan(covariate.frost))
    centre = np.nanmean(x, axis=0)
    away = np.nan_to_num(x - centre)
    centre[0] = 0.0
    return Basis(tuple(covariates), groups, fixed, centre, away.T @ away / w)


def _functions(
    covariates: Sequence[Covariate], lagged: Mapping[str, Array], w: int
) -> tuple[Annotated[Array, "w k"], NDArray[np.intp]]:
    """Compute 1, the parts of each covariate and the products of pairs, and the group of each."""
    blocks, straight = [np.ones((w, 1))], []
    for covariate in covariates:
        parts = covariate.parts(lagged[covariate.name][:, covariate.lag])
        straight.append(parts[0])
        blocks += parts
    if len(straight) > 1:
        blocks.append(np.hstack([a * b for a, b in combinations(straight, 2)]))
    return np.hstack(blocks), np.repeat(np.arange(len(blocks)), [block.shape[1] for block in blocks])


def _with_lags(basis: Basis, lagged: Mapping[str, Array], y: Array, certainty: Array, size: float | None) -> Basis:
    """Set each covariate in turn to the lag of greatest evidence."""
    for name in lagged:
        tried = []
        for lag in range(len(LAGS_H)):
            lags = {c.name: lag if c.name == name else c.lag for c in basis.covariates}
            other = _basis(lagged, lags, y.size, size)
            tried.append((_fit(np.nan_to_num(other.at(lagged, y.size)), y, certainty, other).evidence, other))
        basis = max(tried, key=lambda one: one[0])[1]
    return basis


def _fit(x: Annotated[Array, "w k"], y: Annotated[Array, "w"], certainty: Annotated[Array, "w"], basis: Basis) -> _Fit:
    """Fit coefficients to readings of which 1 / variance is `certainty`, and the prior variance of each group."""
    weighted = x * certainty[:, None]
    information, moment = weighted.T @ x, weighted.T @ y
    total = float(np.average((y - np.average(y, weights=certainty)) ** 2, weights=certainty))
    low, high = _PRIORS[0] * total, _PRIORS[1] * max(total, float(np.average(y, weights=certainty)) ** 2)
    prior = np.full(int(basis.groups.max()) + 1, total)
    for group, value in basis.fixed.items():
        prior[group] = min(value, high)
    free = np.array([group not in basis.fixed for group in range(prior.size)])
    of_group = basis.groups[:, None] == np.arange(prior.size)
    for _ in range(100):
        each = prior[basis.groups]
        covariance = np.linalg.inv(information + np.diag(1.0 / each))
        mean = covariance @ moment
        determined = of_group.sum(axis=0) - (covariance.diagonal() / each) @ of_group
        new = np.clip(mean**2 @ of_group / np.maximum(determined, 1e-9), low, high)
        new = np.where(free, new, prior)
        done = np.abs(np.log(new / prior)).max() < 0.01
        prior = new
        if done:
            break
    each = prior[basis.groups]
    covariance = np.linalg.inv(information + np.diag(1.0 / each))
    mean = covariance @ moment
    root = np.sqrt(each)
    evidence = moment @ mean - np.linalg.slogdet(np.eye(each.size) + root[:, None] * information * root)[1]
    return _Fit(mean, np.asarray(covariance, dtype=float), each, 0.5 * float(evidence))


def _left_out(
    x: Array, y: Array, certainty: Array, law: _Fit, parts: list[NDArray[np.intp]]
) -> tuple[Annotated[Array, "w"], Annotated[Array, "w"]]:
    """Predict each part of the readings by the others with the prior of `law`; return what is left, and its law's variance."""
    left, variance = np.empty(y.size), np.empty(y.size)
    weighted = x * certainty[:, None]
    information, moment = weighted.T @ x + np.diag(1.0 / law.prior), weighted.T @ y
    for part in parts:
        covariance = np.linalg.inv(information - weighted[part].T @ x[part])
        left[part] = y[part] - x[part] @ (covariance @ (moment - weighted[part].T @ y[part]))
        variance[part] = ((x[part] @ covariance) * x[part]).sum(axis=1)
    return left, variance


def tails(u: Annotated[Array, "w"]) -> tuple[float, Annotated[Array, "w"]]:
    """Choose the degrees of freedom of numbers of normal quartiles by likelihood; return them, and the weight of each."""
    scaled = [(nu, u * quartiles_over_normal(nu)) for nu in TAILS]
    nu, best = max(scaled, key=lambda one: float((student.logpdf(one[1], one[0]) + np.log(one[1] / u)).sum()))
    return nu, (nu + 1.0) / (nu + best**2)


def quartiles_over_normal(nu: float) -> float:
    """Compute the quartiles of Student's t distribution over those of the normal one."""
    return float(stdtrit(nu, 0.75) / ndtri(0.75))
