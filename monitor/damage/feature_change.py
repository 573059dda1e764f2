"""Features without waveforms: what covariates explain is taken out, and the rest is tested for a change.

Features are natural frequencies or any other numbers that a healthy structure keeps.  The law is that of `covariate_law`,
learned over a healthy part.  What it leaves there, predicted for stretches of time that were left out of the learning, gives the
scatter of means over 1, 2, 4 ... readings: it holds the noise, its autocorrelation and the error of the law.  So neither the
distribution nor the autocorrelation of the noise is assumed.

Where no covariate is given, each feature is compared with what the others let expect of it (`common_change`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc, ndtri, stdtr

from monitor.core import Array, BadInputError, Level, OnProgress, Skipped, Step
from monitor.damage.common_change import EVERY_NS, WAIT_NS, Expected, nothing_learned
from monitor.damage.covariate_law import Axis, CovariateLaw, learn
from monitor.damage.sequential_test import STRETCHES
from monitor.signals import NORMAL_MAD

_LAGS_H = (0.0, 3.0, 6.0, 12.0, 24.0, 48.0)
"""First-order lags that are tried. [h; judgement: air to steel deck, and to thick concrete]"""
_LAW_STRETCHES = 3
"""Stretches of the law over the learned range of a covariate, and over as much on either side. [1; judgement]"""
_FROST_STEP_K = 2.5
"""Distance of the knots about 0 degC. [K; judgement]"""
_FROST_SLOPE = 4.0
"""Prior slope in frost over that above it. [ratio; Z24 bridge: some 1 percent of frequency a K against 0.2]"""
_FOLDS = 8
"""Parts of the healthy time that are left out of the learning in turn. [1; convention: cross-validation by 5 to 10 folds]"""
_MIN_READINGS = 40
"""Fewest healthy readings from which a feature is learned. [readings; judgement: five of each fold]"""
_LEAST_BLOCKS = 12
"""Fewest disjoint healthy stretches from which the scatter of their means is estimated. [1; judgement]"""
_SHORTEST = 8
"""Shortest stretch that is tested: the mean of its middle half is not moved by two outliers. [readings; judgement]"""
_CONFIRMED = 4
"""Readings in a row at which a change must be significant to be a `warning`, or not to be normal again. [readings; judgement]"""
_SIGNIFICANCE = 5.0
"""z-score from which a change is significant. [standard deviations; a false one in 3.5 million independent looks]"""
_UNKNOWN = 3.0
"""Standard deviation of the law over that of the healthy scatter from which a reading is not judged. [ratio; judgement: a
change of fifteen healthy deviations would not be significant]"""
_SHRINKAGE = 0.1
"""Share of the features' residual correlation that is not trusted. [1; judgement]"""


@dataclass(frozen=True, eq=False, slots=True)
class FeatureTable:
    """Features and covariates of one structure over time."""

    t_ns: Annotated[NDArray[np.int64], "w"]
    """UTC, increasing."""
    features: Mapping[str, Annotated[Array, "w"]]
    """NaN where one is missing."""
    covariates: Mapping[str, Annotated[Array, "w"]]
    """NaN where one is missing."""


@dataclass(frozen=True, slots=True)
class FeatureVerdict:
    """What one time's features say."""

    t_ns: int
    residual_sigma: tuple[float | None, ...]
    """What the covariates leave of each feature, over the standard deviation of that in healthy readings; None if missing."""
    level: Level
    changed: tuple[str, ...]
    """Names of the changed features."""
    reason: str
    skipped: Skipped | None


@dataclass(frozen=True, eq=False, slots=True)
class FeatureModel:
    """Law and healthy scatter of one feature."""

    name: str
    log: bool
    """True if relative changes are tested: the feature is positive."""
    centre: float
    law: CovariateLaw | None
    std: float
    """Scatter of one healthy reading about its prediction."""
    explained: float
    """Share of the healthy variance that the covariates explain, by predictions of what was left out."""
    readings: int
    stretches: tuple[tuple[int, float, int], ...]
    """Length, scatter of the trimmed means and number of disjoint healthy stretches."""

    def predict(self, values: Mapping[str, Array], w: int) -> tuple[Annotated[Array, "w"], Annotated[Array, "w"]]:
        """Predict the (logarithm of the) feature and the law's standard deviation at lagged covariates."""
        if self.law is None:
            return np.full(w, self.centre), np.zeros(w)
        ln, std = _at_rows(self.law, [values[axis.name] for axis in self.law.axes])
        return self.centre + ln, std


@dataclass(frozen=True, eq=False, slots=True)
class Together:
    """How the features change together over healthy readings."""

    expected: Expected
    noise: Annotated[Array, "k k"]
    """Covariance of one reading about what changes slowly."""

    def left_by_others(self, away: Annotated[Array, "w k"]) -> tuple[Annotated[Array, "w k"], Annotated[Array, "w k"]]:
        """Compute what the others leave of each feature, and how uncertain that is beyond the healthy scatter.

        `away` are the distances of the features from their healthy centres, NaN where one is missing.  A feature that stands
        alone at its time is compared with nothing: NaN.
        """
        left, added = np.full(away.shape, np.nan), np.zeros(away.shape)
        healthy = self.expected.beside_others(np.zeros(away.shape[1]), self.noise).std
        for row, values in enumerate(away):
            seen = np.flatnonzero(np.isfinite(values))
            if seen.size < 2:
                continue
            found = self.expected.of(seen).beside_others(values[seen], self.noise[np.ix_(seen, seen)], either_side=True)
            left[row, seen] = found.loss
            added[row, seen] = np.sqrt(np.maximum(found.std**2 - healthy[seen] ** 2, 0.0))
        return left, added


@dataclass(frozen=True, eq=False, slots=True)
class FeatureJudge:
    """What was learned from the healthy part: a model for each feature, and how their residuals go together."""

    models: tuple[FeatureModel, ...]
    correlations: Mapping[int, tuple[Annotated[Array, "k k"], int]]
    """Stretch -> correlation of the features' healthy means, and its degrees of freedom."""
    spacing_ns: float
    """Median time between readings."""
    together: Together | None = None
    """How the features change together, where no covariate was given and it could be learned."""


def judge_features(
    table: FeatureTable, train_until_ns: int, on_progress: OnProgress = lambda _: None
) -> tuple[FeatureJudge, list[FeatureVerdict]]:
    """Learn the law of each feature from the readings up to a time (UTC), and judge the later ones, one verdict for each row.

    Raises
    ------
    BadInputError
        If a feature has too few healthy readings.
    """
    healthy = int(np.searchsorted(table.t_ns, train_until_ns, side="right"))
    lagged = {name: _lagged(table.t_ns, values) for name, values in table.covariates.items()}
    models: list[FeatureModel] = []
    left = {}
    for name, values in table.features.items():
        model, residual = _learn_feature(name, values[:healthy], {k: v[:healthy] for k, v in lagged.items()})
        models.append(model)
        left[name] = residual
    spacing_ns = float(np.median(np.diff(table.t_ns))) if table.t_ns.size > 1 else 1.0
    together = None if lagged else _learn_together(table.t_ns[:healthy], np.column_stack(list(left.values())))
    if together is not None:
        away = _cross_validated(together, table.t_ns[:healthy], np.column_stack(list(left.values())))
        left = {model.name: of for model, of in zip(models, away.T, strict=True)}
        models = [_beside_others(model, left[model.name]) for model in models]
    judge = FeatureJudge(tuple(models), _correlations(models, left), spacing_ns, together)
    return judge, _judge(judge, table, lagged, healthy, on_progress)


def _lagged(t_ns: NDArray[np.int64], values: Annotated[Array, "w"]) -> Annotated[Array, "w lags"]:
    """Apply the first-order lags to a covariate; missing values stay missing."""
    out = np.full((values.size, len(_LAGS_H)), np.nan)
    lags_ns = np.maximum(np.array(_LAGS_H) * 3.6e12, 1.0)
    state, before = None, int(t_ns[0]) if t_ns.size else 0
    for k in np.flatnonzero(np.isfinite(values)):
        decay = np.exp(-(int(t_ns[k]) - before) / lags_ns)
        state = np.full(lags_ns.size, values[k]) if state is None else values[k] + (state - values[k]) * decay
        out[k], before = state, int(t_ns[k])
    return out


def _is_temperature(name: str) -> bool:
    """Tell by its name whether a covariate is a temperature in degC, which has a kink at 0."""
    lower = name.lower()
    return "temp" in lower or lower.endswith(("degc", "_c")) or lower in ("t", "ta", "tair")


def _feature_axis(name: str, values: Array, size: float, log: bool) -> Axis | None:
    """Return the prior dependence of a feature that scatters by `size`; None for a covariate that never moved."""
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    if not high > low:
        return None
    slope = 2.0 * size / (high - low)
    knots = np.linspace(2.0 * low - high, 2.0 * high - low, 3 * _LAW_STRETCHES + 1)
    if not _is_temperature(name):
        return Axis(name, "", knots, np.full(knots.size + 2, slope))
    frost = np.array([-_FROST_STEP_K, 0.0, _FROST_STEP_K])
    knots = np.unique(np.concatenate([knots[np.abs(knots) > 1.5 * _FROST_STEP_K], frost]))
    frozen = np.r_[False, knots <= 0.0, False]
    return Axis(name, "degC", knots, np.where(frozen, max(_FROST_SLOPE * slope, 0.01 if log else 0.0), slope))


def _learn_feature(name: str, values: Array, lagged: Mapping[str, Array]) -> tuple[FeatureModel, Annotated[Array, "w"]]:
    """Learn a feature's law and scatter from healthy rows.

    Beside it are the residuals of predictions from the other parts of the time; NaN where none could be made.
    """
    rows = np.flatnonzero(np.isfinite(values))
    if rows.size < _MIN_READINGS:
        raise BadInputError(f"feature {name!r}: {rows.size} healthy readings, at least {_MIN_READINGS} are needed")
    log = bool((values[rows] > 0.0).all())
    y = np.log(values[rows]) if log else values[rows]
    centre, size = float(np.median(y)), _robust_std(y - np.median(y))
    if size == 0.0:
        raise BadInputError(f"feature {name!r}: more than half of its healthy readings are the same number")
    keep = np.abs(y - centre) < 8.0 * size  # a reading of another mode is no reading of this one
    rows, y = rows[keep], y[keep]
    axes, columns = [], []
    for covariate, column in lagged.items():
        known = np.isfinite(column[rows, 0])
        axis = _feature_axis(covariate, column[rows][known, 0], size, log) if known.mean() > 0.5 else None
        if axis is not None:
            axes.append(axis)
            columns.append(column[rows])
    law, residual, overlap, std, bounded = None, y - np.median(y), 1.0, size, y
    # The scatter about the law, and its autocorrelation, decide how closely the law follows the readings.
    for _ in range(3 if axes else 0):
        about = np.median(y) if law is None else np.mean(bounded) + _at_rows(law, columns)[0]
        bounded = np.clip(y, about - 4.0 * std, about + 4.0 * std)
        law = _fit_law(bounded, axes, columns, std, overlap)
        residual = _left_out(bounded, y, law, axes, columns, std, overlap)
        std = _robust_std(residual[np.isfinite(residual)])
        overlap = _inflation(residual[np.isfinite(residual)], std)
    centre = float(np.median(y)) if law is None else float(np.mean(bounded))
    whole = np.full(values.size, np.nan)
    whole[rows] = residual
    good = residual[np.isfinite(residual)]
    stretches = _stretches(good)
    explained = 1.0 - float(np.var(np.clip(good, -4 * std, 4 * std)) / np.var(np.clip(y - centre, -4 * size, 4 * size)))
    return FeatureModel(name, log, centre, law, std, explained, int(rows.size), stretches), whole


def _stretches(residual: Array) -> tuple[tuple[int, float, int], ...]:
    """Estimate the scatter of the means over each stretch that enough residuals are there for."""
    w = residual.size
    return tuple((m, _tail_std(_trimmed(residual, m)), w // m) for m in _stretch_lengths() if w // m >= _LEAST_BLOCKS)


def _learn_together(t_ns: NDArray[np.int64], away: Annotated[Array, "w k"]) -> Together | None:
    """Learn from healthy readings how the features change together.

    `away` are their distances from their healthy centres, NaN where one is missing.  It is None where too few days are known, or
    nothing is to be seen of it.
    """
    known = np.isfinite(away).all(axis=1)
    t_ns, away = t_ns[known], away[known]
    k = away.shape[1]
    if k < 2 or len(away) <= _MIN_READINGS:
        return None
    noise = np.array([_robust_std(np.diff(column)) for column in away.T]) / np.sqrt(2.0)
    if not (noise > 0.0).all():
        return None
    ends = np.searchsorted(t_ns, t_ns + WAIT_NS, side="right")
    rows = [row for row, end in enumerate(ends) if end - row > 2 and int(t_ns[-1] - t_ns[row]) >= WAIT_NS]
    if not rows:
        return None
    distances = np.array([away[row] - np.median(away[row + 1 : ends[row]], axis=0) for row in rows]) / noise
    size = np.array([_robust_std(column) for column in distances.T])
    distances = np.clip(distances, -4.0 * size, 4.0 * size)
    hours = int(min(len(rows) * float(np.median(np.diff(t_ns))), float(t_ns[-1] - t_ns[0])) / EVERY_NS)
    if not hours:
        return None
    common = replace(nothing_learned(k), square=distances.T @ distances * (hours / len(rows)), windows=hours)
    learned = common.learned(np.diag(noise), 0.0)  # features have no shares that are alike before anything is learned
    return None if learned is None else Together(learned, np.diag(noise**2))


def _cross_validated(
    together: Together, t_ns: NDArray[np.int64], away: Annotated[Array, "w k"]
) -> Annotated[Array, "w k"]:
    """Compute what the others leave of each feature, each eighth of the time by what the rest learned."""
    left = np.full(away.shape, np.nan)
    for part in np.array_split(np.arange(len(away)), _FOLDS):
        rest = np.setdiff1d(np.arange(len(away)), part)
        left[part] = (_learn_together(t_ns[rest], away[rest]) or together).left_by_others(away[part])[0]
    return left


def _beside_others(model: FeatureModel, residual: Array) -> FeatureModel:
    """Set the scatter of a feature to that of what the others leave of it in healthy readings."""
    good = residual[np.isfinite(residual)]
    if good.size < _MIN_READINGS:
        raise BadInputError(
            f"feature {model.name!r}: {good.size} healthy readings at which another feature is known, at least "
            f"{_MIN_READINGS} are needed; name a covariate, or judge it alone"
        )
    std = _robust_std(good)
    explained = 1.0 - float(np.var(np.clip(good, -4.0 * std, 4.0 * std))) / model.std**2
    return replace(model, std=std, explained=explained, stretches=_stretches(good))


def _at_rows(law: CovariateLaw, values: Sequence[Array]) -> tuple[Annotated[Array, "w"], Annotated[Array, "w"]]:
    """Evaluate the law of one feature at the rows of lagged covariates; return change and standard deviation."""
    away = np.column_stack([a.basis(v[:, a.lag]) for a, v in zip(law.axes, values, strict=True)]) - law.centre
    variance = np.zeros(len(away))
    for axis, value, columns in zip(law.axes, values, law.columns().values(), strict=True):
        slopes = law.slopes[0, columns]
        variance[~np.isfinite(value[:, axis.lag])] += float(slopes @ law.spread[columns, columns] @ slopes)
    away = np.nan_to_num(away)
    variance += law.mixing[0, 0] ** 2 * np.einsum("wk,kl,wl->w", away, law.posterior[0], away)
    return away @ law.slopes[0], np.sqrt(variance)


def _fit_law(y: Array, axes: list[Axis], columns: list[Array], std: float, overlap: float) -> CovariateLaw:
    """Learn the law of one feature, each covariate at its best lag."""
    lags_s = [3600.0 * lag for lag in _LAGS_H]
    return learn(y[:, None], np.array([[std**2]]), np.ones((1, 1)), axes, columns, overlap, lags_s)


def _left_out(
    bounded: Array, y: Array, law: CovariateLaw, axes: list[Axis], columns: list[Array], std: float, overlap: float
) -> Array:
    """Compute the residuals of each part of the time about the law of the others, at the lags of `law`.

    Where the others do not know the covariates' values, there is none (NaN).
    """
    residual = np.full(y.size, np.nan)
    chosen = [c[:, a.lag : a.lag + 1] for a, c in zip(law.axes, columns, strict=True)]
    for part in np.array_split(np.arange(y.size), _FOLDS):
        rest = np.setdiff1d(np.arange(y.size), part)
        if any(np.isfinite(c[rest]).sum() < _MIN_READINGS // 2 for c in chosen):
            continue
        other = learn(
            bounded[rest][:, None], np.array([[std**2]]), np.ones((1, 1)), axes, [c[rest] for c in chosen], overlap
        )
        change, error = _at_rows(other, [c[part] for c in chosen])
        residual[part] = np.where(error < std, y[part] - np.mean(bounded[rest]) - change, np.nan)
    if np.isfinite(residual).sum() < y.size / 2:
        return np.asarray(y - np.mean(bounded) - _at_rows(law, columns)[0])
    return residual


def _stretch_lengths() -> list[int]:
    """List the stretches that are tested, in readings."""
    return [_SHORTEST * m for m in STRETCHES]


def _robust_std(x: Array) -> float:
    """Estimate a standard deviation about zero from the median of the sizes."""
    return float(NORMAL_MAD * np.median(np.abs(x)))


def _tail_std(x: Array) -> float:
    """Estimate a standard deviation about zero, not less than the tails need (1 % of a normal distribution is beyond 2.58)."""
    return max(_robust_std(x), float(np.sqrt(np.mean(x**2))), float(np.quantile(np.abs(x), 0.99)) / 2.58)


def _trimmed(x: Array, m: int) -> Array:
    """Compute the means of the middle halves of all stretches of m readings."""
    ordered = np.sort(np.lib.stride_tricks.sliding_window_view(x, m), axis=1)
    return np.asarray(ordered[:, m // 4 : m - m // 4].mean(axis=1))


def _inflation(residual: Array, std: float) -> float:
    """Estimate by how much autocorrelation raises the variance of a long mean over that of independent readings."""
    ratios = [
        m * float(np.mean(_trimmed(residual, m) ** 2)) / std**2
        for m in _stretch_lengths()
        if residual.size // m >= _LEAST_BLOCKS
    ]
    return max([1.0, *ratios])


def _correlations(models: list[FeatureModel], left: Mapping[str, Array]) -> dict[int, tuple[Array, int]]:
    """Estimate how the features' means over each stretch go together in healthy readings."""
    x = np.array([left[m.name] / m.std for m in models])
    x = x[:, np.isfinite(x).all(axis=0)]
    out = {}
    for m in _stretch_lengths():
        blocks = x.shape[1] // m
        if len(models) > 1 and blocks >= _LEAST_BLOCKS + len(models):
            r = np.atleast_2d(np.corrcoef(np.array([_trimmed(row, m) for row in x])))
            trust = 1.0 - max(_SHRINKAGE, len(models) / blocks)
            out[m] = trust * r + (1.0 - trust) * np.eye(len(models)), blocks - 1
    return out


def _judge(
    judge: FeatureJudge, table: FeatureTable, lagged: Mapping[str, Array], first: int, on_progress: OnProgress
) -> list[FeatureVerdict]:
    """Judge the rows from `first` on, in order."""
    recent: list[list[tuple[int, float, float]]] = [[] for _ in judge.models]
    alarm, verdicts = _Alarm(), []
    predicted = _predicted(judge, table, lagged)
    for row in range(first, table.t_ns.size):
        on_progress(Step("judges the rows", row, table.t_ns.size, "rows"))
        t_ns = int(table.t_ns[row])
        sigma, unknown = _take_row(judge, table, predicted, recent, row)
        known = sum(s is not None for s in sigma)
        changed: tuple[str, ...] = ()
        skipped, reason = None, "unchanged: the features were not judged"
        if not known:
            skipped = Skipped("no feature at this time")
        elif len(unknown) == known:
            skipped = Skipped(_beyond(unknown[0], lagged, row))
        else:
            z, changed, words = _evidence(judge, recent, t_ns)
            alarm = alarm.after(z)
            reason = words if alarm.level is not Level.NORMAL else "no significant change"
        announced = changed if alarm.level is not Level.NORMAL else ()
        verdicts.append(FeatureVerdict(t_ns, sigma, alarm.level, announced, reason, skipped))
    return verdicts


@dataclass(frozen=True, slots=True)
class _Alarm:
    """State of the alarm between readings."""

    level: Level = Level.NORMAL
    run: int = 0
    """Significant readings up to now, in a row."""
    quiet: int = 0
    """Insignificant ones."""

    def after(self, z: float) -> _Alarm:
        """Return the state after a reading with this z-score."""
        is_active = self.level is not Level.NORMAL
        if z >= _SIGNIFICANCE - (1.0 if is_active else 0.0):
            confirmed = is_active and (self.run + 1 >= _CONFIRMED or self.level is not Level.ADVISORY)
            return _Alarm(Level.WARNING if confirmed else Level.ADVISORY, self.run + 1)
        level = Level.NORMAL if self.quiet + 1 >= _CONFIRMED else self.level
        return _Alarm(level, 0, self.quiet + 1)


def _take_row(
    judge: FeatureJudge,
    table: FeatureTable,
    predicted: list[tuple[Array, Array]],
    recent: list[list[tuple[int, float, float]]],
    row: int,
) -> tuple[tuple[float | None, ...], list[FeatureModel]]:
    """Add what is left of each feature to the `recent` ones.

    Returned are `FeatureVerdict.residual_sigma`, and the features whose prediction is too uncertain to be judged.
    """
    sigma: list[float | None] = []
    unknown = []
    for model, past, (means, law_stds) in zip(judge.models, recent, predicted, strict=True):
        value = float(table.features[model.name][row])
        if not np.isfinite(value + means[row]) or (model.log and value <= 0.0):
            sigma.append(None)
            continue
        law_std = float(law_stds[row])
        residual = (float(np.log(value)) if model.log else value) - float(means[row])
        sigma.append(residual / float(np.hypot(model.std, law_std)))
        if law_std > _UNKNOWN * model.std:
            unknown.append(model)
            continue
        past.append((int(table.t_ns[row]), residual, law_std))
        del past[: -2 * _SHORTEST * max(STRETCHES)]
    return tuple(sigma), unknown


def _predicted(judge: FeatureJudge, table: FeatureTable, lagged: Mapping[str, Array]) -> list[tuple[Array, Array]]:
    """Predict each feature (or its logarithm) at all rows, with the standard deviation of the law."""
    predicted = [model.predict(lagged, table.t_ns.size) for model in judge.models]
    if judge.together is None:
        return predicted
    away = []
    for model, (means, _) in zip(judge.models, predicted, strict=True):
        values = table.features[model.name]
        if model.log:
            values = np.log(np.where(values > 0.0, values, np.nan))
        away.append(values - means)
    left, added = judge.together.left_by_others(np.column_stack(away))
    return [(means + a - of, add) for (means, _), a, of, add in zip(predicted, away, left.T, added.T, strict=True)]


def _beyond(model: FeatureModel, lagged: Mapping[str, Array], row: int) -> str:
    """Say which covariate lies beyond what was learned."""
    for axis in model.law.axes if model.law is not None else ():
        value = float(lagged[axis.name][row, axis.lag])
        if axis.beyond(value):
            low, high = axis.range
            return f"{axis.name} {value:.3g} is {axis.beyond(value)} anything learned from, {low:.3g} to {high:.3g}"
    if model.law is None:
        return "the features lie farther from their healthy values than anything learned from"
    return "what the covariates do here was not learned"


def _evidence(
    judge: FeatureJudge, recent: list[list[tuple[int, float, float]]], t_ns: int
) -> tuple[float, tuple[str, ...], str]:
    """Compute the largest z-score over stretches, of one feature or of all together, with the changed features in words."""
    best, found = 0.0, {}
    for m in _stretch_lengths():
        scores, size = np.zeros(len(judge.models)), np.zeros(len(judge.models))
        tested = np.zeros(len(judge.models), dtype=bool)
        for j, (model, past) in enumerate(zip(judge.models, recent, strict=True)):
            scatter = {length: (std, blocks) for length, std, blocks in model.stretches}
            if m not in scatter or len(past) < m or t_ns - past[-m][0] > 3.0 * m * judge.spacing_ns:
                continue
            std, blocks = scatter[m]
            residual = np.sort([r for _, r, _ in past[-m:]])
            size[j] = residual[m // 4 : m - m // 4].mean()
            scores[j] = size[j] / np.sqrt(std**2 + np.mean([s**2 for _, _, s in past[-m:]]))
            tested[j] = True
            z = float(-ndtri(max(stdtr(blocks - 1, -abs(scores[j])), 1e-300)))
            if z > best:
                best, found = z, {model.name: size[j]}
        if tested.all() and m in judge.correlations:
            correlation, freedom = judge.correlations[m]
            k = len(judge.models)
            square = float(scores @ np.linalg.solve(correlation, scores))
            z = _hotelling(square, k, freedom)
            if z > best:
                best = z
                found = {n.name: s for n, s, u in zip(judge.models, size, scores, strict=True) if abs(u) > 2.0}
                found = found or {judge.models[int(np.abs(scores).argmax())].name: size[int(np.abs(scores).argmax())]}
    logs = {model.name: model.log for model in judge.models}
    words = [f"{n} changed by {100 * s:+.2f} %" if logs[n] else f"{n} changed by {s:+.3g}" for n, s in found.items()]
    return best, tuple(found), f"{', '.join(words)} beyond what the covariates explain (z = {best:.1f})"


def _hotelling(square: float, k: int, freedom: int) -> float:
    """Convert Hotelling's T^2 of k features to the z-score that is as improbable."""
    if freedom <= k:
        return 0.0
    p = float(fdtrc(k, freedom - k + 1, square * (freedom - k + 1) / (freedom * k)))
    return float(-ndtri(max(p, 1e-300)))
