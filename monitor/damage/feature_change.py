"""Features without waveforms: what covariates explain is taken out, and the rest is tested for a change.

Features are natural frequencies or any other numbers that a healthy structure keeps.  `healthy_series` gives what covariates
leave of each, and its scatter.  A reading, and the mean over 8, 16, ... of them, is compared with such means of the healthy
time, of parts that were left out of the learning: their covariance holds the noise, its correlation in time and among the
features, what they do together without a known cause, and the error of the law.  Four tests look at each mean: each feature by
itself, each beside the others, all as one sum, and all together (Hotelling).  The chance of the least likely of them on healthy
data is the mean's evidence.  How often healthy readings reach an evidence is learned by judging the left-out parts, and
extrapolated: what is announced is what a healthy structure would show less often than is allowed.

References
----------
H. Hotelling, Ann. Math. Statist. 2 (1931) 360-378; K. Lange, R. Little, J. Taylor, J. Am. Stat. Assoc. 84 (1989) 881-896
(multivariate t distribution); J. Schaefer, K. Strimmer, Stat. Appl. Genet. Mol. Biol. 4 (2005) 32
(shrinkage of correlations); J. Pickands, Ann. Statist. 3 (1975) 119-131 (excesses over a high level are exponential).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as fisher, multivariate_t, rankdata, t as student

from monitor.core import Array, BadInputError, FeatureReading, Level, OnProgress, Skipped, Step, WindowResult, utc
from monitor.damage.alarm import AlarmSettings, Shown, StoryState, summarize, update_alarm, warning_only
from monitor.damage.healthy_series import (
    FOLDS,
    TAILS,
    FeatureModel,
    Left,
    correlation_time,
    lagged,
    learn,
    quartiles_over_normal,
)
from monitor.damage.parts import Features

_LENGTHS = (1, 8, 16, 32, 64, 128, 256)
"""Readings over which what is left is averaged. [readings; judgement: one, and powers of two whose middle half is not moved by
two outliers]"""
_TOLD = 2
"""Readings in a row of which a change is told. [readings; definition: two share no data; one may be of another mode]"""
_IN_A_ROW = 4
"""Readings in a row that confirm a change. [readings; convention: control charts; outliers of 1 % are so once in 100 million]"""
FALSE_ANNOUNCEMENTS_PER_YEAR = 0.1
"""False announcements that are allowed. [1/year; convention: as of a site]"""
_TRUSTED = 2
"""Episodes that the chance of the tests counts as, beside those of the healthy time. [1; judgement: a mean that is right within a
factor of 2; one alone leaves nothing to be found after 6 days, eight announced half a day of a healthy mast's 9]"""
_WEIGHINGS = 8
"""Passes of covariance and weights of each number of degrees of freedom. [1; simulation: sixteen change no weight by 1 %]"""
_YEAR_NS = 365.25 * 86400e9
"""A year. [ns; definition]"""
_LEAST_CHANCE = 1e-300
"""Least chance that is told from none. [1; rounding]"""
_MOST_YEARS = 1e9
"""Rarest that is told from never. [years; rounding]"""
_OVER = 0.05
"""Chance at which what an announcement began with may be over. [1; convention: 95 %]"""
_ALARM = warning_only(AlarmSettings(min_loss=0.0))
"""Any change of a feature is announced that is rare enough, and none is an `alarm` by its size. [settings; definition]"""
_NONE = Skipped("no feature at this time")
"""Why a reading is not judged. [words]"""
_UNJUDGED = "unchanged: the features were not judged"
"""What an alarm says where no feature was measured. [words]"""


@dataclass(frozen=True, eq=False, slots=True)
class FeatureTable:
    """Features and covariates of one structure over time."""

    t_ns: Annotated[NDArray[np.int64], "w"]
    """UTC, increasing."""
    features: Mapping[str, Annotated[Array, "w"]]
    """NaN where one is missing."""
    covariates: Mapping[str, Annotated[Array, "w"]]
    """NaN where one is missing."""


@dataclass(frozen=True, eq=False, slots=True)
class Means:
    """Means over the m latest readings of each of k features at w times, in healthy standard deviations of independent ones."""

    m: int
    score: Annotated[Array, "w k"]
    """NaN where there is no mean of readings of late."""
    size: Annotated[Array, "w k"]
    """The means themselves."""
    law: Annotated[Array, "w k"]
    """Variance of `score` from the error of the law."""


@dataclass(frozen=True, eq=False, slots=True)
class Scatter:
    """Healthy scatter of means over m readings."""

    m: int
    covariance: Annotated[Array, "k k"]
    freedom: tuple[float, float, float]
    """Independent means that it was learned from, as they count for a feature by itself, for one beside the others, and for all
    together: what features do together mostly changes more slowly than how they differ."""
    shrunk: float
    """Independent means that the shrinkage of the correlations is worth."""
    law: Annotated[Array, "k"]
    """Share of the law's error in it."""

    def chance(self, means: Means) -> tuple[Annotated[Array, "w"], Annotated[Array, "w k"]]:
        """Compute ln of the probability that healthy features deviate as much, and the standard scores of each feature alone.

        Features without a mean are left out: those that are there are tested by what is known of them.
        """
        found, scores = np.zeros(len(means.score)), np.full(means.score.shape, np.nan)
        there = np.isfinite(means.score)
        wider = np.maximum(means.law - self.law, 0.0)
        for pattern in np.unique(there, axis=0):
            seen, rows = np.flatnonzero(pattern), np.flatnonzero((there == pattern).all(axis=1))
            if seen.size:
                at = np.ix_(rows, seen)
                known = self.covariance[np.ix_(seen, seen)]
                found[rows], scores[at] = _chance(means.score[at], known, np.nan_to_num(wider[at]), self)
        return found, scores


@dataclass(frozen=True, slots=True)
class Rate:
    """How often healthy readings reach an evidence: episodes above a level, whose excess is exponential.

    Few episodes tell its mean badly: the rate is that of the predictive distribution.
    """

    level: float
    per_year: float
    """Episodes above the level."""
    mean: float
    count: int
    """Episodes from which the mean is known."""

    def years(self, evidence: Annotated[Array, "w"]) -> Annotated[Array, "w"]:
        """Compute the mean time between episodes that reach an evidence; 0 below the level."""
        excess = np.maximum(evidence - self.level, 0.0) / (self.count * self.mean)
        ln = np.minimum(self.count * np.log1p(excess) - np.log(self.per_year), np.log(_MOST_YEARS))
        return np.where(evidence > self.level, np.exp(ln), 0.0)


@dataclass(frozen=True, eq=False, slots=True)
class Look:
    """One way to look at the latest readings: what a mean of them is compared with, and how rare it is."""

    scatter: Scatter
    in_a_row: int
    """Readings in a row that are to show a change."""
    rate: Rate

    @property
    def confirms(self) -> bool:
        """Whether as many readings in a row say so as confirm a change."""
        return self.in_a_row >= _IN_A_ROW


@dataclass(frozen=True, eq=False, slots=True)
class FeatureJudge:
    """What was learned from the healthy part."""

    models: tuple[FeatureModel, ...]
    looks: tuple[Look, ...]
    least_years: float
    """How rare a change has to be on a healthy structure to be announced."""

    @property
    def parts(self) -> Features:
        """What alarms are about, in words."""
        return Features(tuple(m.name for m in self.models), tuple(m.log for m in self.models))


def judge_features(
    table: FeatureTable,
    train_until_ns: int,
    on_progress: OnProgress = lambda _: None,
    false_announcements_per_year: float = FALSE_ANNOUNCEMENTS_PER_YEAR,
) -> tuple[FeatureJudge, list[WindowResult]]:
    """Learn the features from the readings up to a time (UTC), and judge the later ones, one result for each row.

    Raises
    ------
    BadInputError
        If a feature has too few healthy readings.
    """
    healthy = int(np.searchsorted(table.t_ns, train_until_ns, side="right"))
    late = {name: lagged(table.t_ns, values) for name, values in table.covariates.items()}
    models: list[FeatureModel] = []
    out: list[Left] = []
    for name, values in table.features.items():
        model, left = learn(name, values[:healthy], {k: v[:healthy] for k, v in late.items()})
        models.append(model)
        out.append(left)
    left_out = Left(*(np.column_stack(of) for of in zip(*out, strict=True)))
    looks = _learn_looks(table.t_ns[:healthy], left_out)
    judge = FeatureJudge(tuple(models), looks, len(looks) / false_announcements_per_year)
    lefts = (m.left(table.features[m.name], late) for m in models)
    left = Left(*(np.column_stack(of) for of in zip(*lefts, strict=True)))
    return judge, list(_judge(judge, table, left, late, healthy, on_progress))


@dataclass(frozen=True, eq=False, slots=True)
class _Seen:
    """What a look shows of all rows."""

    means: Means
    scores: Annotated[Array, "w k"]
    years: Annotated[Array, "w"]
    """How long a healthy structure takes to show as much."""
    own: Annotated[Array, "w k"]
    """The same by the test of each feature by itself; no more than that."""

    @classmethod
    def of(cls, look: Look, means: Means) -> _Seen:
        """Take a look."""
        evidence, scores = _evidence(look.scatter, means, look.in_a_row)
        k = np.isfinite(scores).sum(axis=1, keepdims=True)
        ln = _ln_of_tests(_by_itself(np.abs(scores), k, look.scatter.freedom[0]))
        own = _in_a_row(np.nan_to_num(-ln, nan=-np.inf), means, look.in_a_row)
        years = look.rate.years
        return cls(means, scores, years(evidence), years(np.minimum(own, evidence[:, None])))


def _judge(
    judge: FeatureJudge,
    table: FeatureTable,
    left: Left,
    late: Mapping[str, Array],
    first: int,
    on_progress: OnProgress,
) -> Iterator[WindowResult]:
    """Judge the rows from `first` on, in order."""
    means = {m: _means(left, m) for m in {look.scatter.m for look in judge.looks}}
    seen = [_Seen.of(look, means[look.scatter.m]) for look in judge.looks]
    confirms = np.array([look.confirms for look in judge.looks])
    # The shortest mean over several readings tells the size where no look says much.
    standing = next((i for i, look in enumerate(judge.looks) if look.scatter.m > 1), 0)
    sigma, k = left.residual / np.sqrt(left.variance + left.law), len(judge.models)
    alarms, began_ns, judged_ns = (StoryState(),) * (k + 2), (0,) * (k + 1), [0] * _IN_A_ROW
    for row in range(first, table.t_ns.size):
        on_progress(Step("judges the rows", row, table.t_ns.size, "rows"))
        t_ns, skipped = int(table.t_ns[row]), None if np.isfinite(left.residual[row]).any() else _NONE
        reading = FeatureReading(np.full(k, np.nan), np.eye(k), names=judge.parts.features, sigma=sigma[row], years=0.0)
        if skipped is None:
            judged_ns = [*judged_ns[1:], t_ns]
            years, own = np.array([one.years[row] for one in seen]), np.array([one.own[row] for one in seen])
            lasting = float((years * confirms).max(initial=0.0))
            counts = confirms if lasting >= judge.least_years else np.ones_like(confirms)
            at = int((years * counts).argmax())
            at = at if years[at] >= judge.least_years * _OVER else standing
            size = seen[at].means.size[row]
            std = np.abs(size / np.where(seen[at].scores[row] == 0.0, np.nan, seen[at].scores[row]))
            beyond = _beyond(judge.models, late, row)
            reading = replace(reading, loss=-size, covariance=np.diag(std**2), years=lasting / len(seen), beyond=beyond)
            is_own = (own * counts[:, None]).max(axis=0) >= judge.least_years
            alarms, began_ns = _update(alarms, began_ns, judge, reading, is_own, (float(years[at]), lasting), judged_ns)
        says, otherwise = ({}, _UNJUDGED) if skipped else (_words(judge.parts, reading, began_ns), "")
        alarm = summarize(alarms, says, otherwise, judge.parts)
        if reading.beyond:
            alarm = replace(alarm, reason=f"{alarm.reason}; {reading.beyond}")
        known = {name: values[row] for name, values in late.items() if np.isfinite(values[row]).all()}
        yield WindowResult(row - first, t_ns, 0.0, None, None, None, alarm, skipped, covariates=known, features=reading)


def _update(
    alarms: tuple[StoryState, ...],
    began_ns: tuple[int, ...],
    judge: FeatureJudge,
    reading: FeatureReading,
    is_own: Annotated[NDArray[np.bool_], "k"],
    years: tuple[float, float],
    judged_ns: Sequence[int],
) -> tuple[tuple[StoryState, ...], tuple[int, ...]]:
    """Update the alarms by the evidence of all tests, `years` of any and of several readings in a row.

    It is that of the features whose own test says as much and of those confirmed that still differ; else of all together.  The
    score is the logarithm of years.  A level ends when so many readings in a row say surely less as confirm one.
    """
    k, t_ns = is_own.size, judged_ns[-1]
    score, lasting = (float(np.log(x)) if x > 0.0 else -np.inf for x in years)
    of = {j for j in range(k) if is_own[j] or (alarms[j].level is Level.WARNING and j in reading.moved)} or {k}
    new, begins = list(alarms), list(began_ns)
    least = float(np.log(judge.least_years))
    for j, alarm in enumerate(alarms[:-1]):
        shown = Shown(0.0, 0.0, *((score, lasting) if j in of else (-np.inf, -np.inf)), 1)
        # An advisory stands as long as the latest readings say so.
        n, sure = (_IN_A_ROW, -float(np.log(_OVER))) if alarm.level is Level.WARNING else (1, 0.0)
        new[j] = update_alarm(alarm, shown, t_ns, _ALARM, least, np.inf, t_ns - judged_ns[-n], sure)
        begins[j] = t_ns if alarm.level is Level.NORMAL else begins[j]
    return tuple(new), tuple(begins)


def _words(parts: Features, reading: FeatureReading, began_ns: Sequence[int]) -> dict[int, str]:
    """Say how each feature changed, and all together, and since when that is announced."""
    told = enumerate(zip(reading.loss.tolist(), reading.change_std.tolist(), strict=True), 1)
    sizes = {j: parts.changed(j, loss, loss, std) for j, (loss, std) in told if np.isfinite(loss)}
    moved = ", ".join(sizes[j + 1] for j in reading.moved if j + 1 in sizes)
    sizes[len(began_ns)] = f"{parts.name(len(began_ns))} ({moved})"
    return {j: f"{says} since {utc(began_ns[j - 1])}Z" for j, says in sizes.items()}


def _beyond(models: tuple[FeatureModel, ...], late: Mapping[str, Array], row: int) -> str:
    """Say which covariate lies beyond what was learned; empty where none does."""
    for covariate in models[0].basis.covariates:
        value = float(late[covariate.name][row, covariate.lag])
        if covariate.beyond(value):
            low, high = covariate.range
            return (
                f"{covariate.name} {value:.3g} is {covariate.beyond(value)} anything learned from, {low:.3g} to {high:.3g}: "
                "less is known here"
            )
    return ""


def _means(left: Left, m: int) -> Means:
    """Average what is left of each feature over its m latest readings, without the outer quarters of 4 and more.

    Readings count by their certainty.  Where a feature is missing its latest mean stands for up to m rows.
    """
    w, k = left.residual.shape
    found = [np.full((w, k), np.nan) for _ in range(3)]
    for j in range(k):
        rows = np.flatnonzero(np.isfinite(left.residual[:, j]))
        if rows.size < m:
            continue
        over = partial(np.lib.stride_tricks.sliding_window_view, window_shape=m)
        values = over(left.residual[rows, j])
        middle = np.argsort(values, axis=1)[:, m // 4 : m - m // 4]
        take = partial(np.take_along_axis, indices=middle, axis=1)
        weights = 1.0 / take(over(left.variance[rows, j]))
        certainty, end = weights.sum(axis=1), rows[m - 1 :]
        mean = (take(values) * weights).sum(axis=1) / certainty
        law = (take(over(np.sqrt(left.law[rows, j]))) * weights).sum(axis=1) ** 2 / certainty
        latest = np.searchsorted(end, np.arange(w), side="right") - 1
        is_late = (latest >= 0) & (np.arange(w) - end[latest] <= m - 1)
        for of, values in zip(found, (mean * np.sqrt(certainty), mean, law), strict=True):
            of[is_late, j] = values[latest[is_late]]
    return Means(m, *found)


def _evidence(scatter: Scatter, means: Means, in_a_row: int) -> tuple[Annotated[Array, "w"], Annotated[Array, "w k"]]:
    """Compute -ln of the chance of healthy means, the least of some in a row, and the standard score of each feature."""
    chance, scores = scatter.chance(means)
    return _in_a_row(-chance, means, in_a_row), scores


def _in_a_row(evidence: Annotated[Array, "w ..."], means: Means, n: int) -> Annotated[Array, "w ..."]:
    """Compute the least evidence of n means in a row; -inf where there are fewer."""
    there, least = np.flatnonzero(np.isfinite(means.score).any(axis=1)), np.full(evidence.shape, -np.inf)
    if there.size >= n:
        least[there[n - 1 :]] = np.lib.stride_tricks.sliding_window_view(evidence[there], n, axis=0).min(axis=-1)
    return least


def _learn_looks(t_ns: NDArray[np.int64], left: Left) -> tuple[Look, ...]:
    """Learn the scatter of means of healthy readings, and how often they reach an evidence by what the other parts taught."""
    years, looks = float(t_ns[-1] - t_ns[0]) / _YEAR_NS, []
    everything = np.ones(len(t_ns), dtype=bool)
    for m in _LENGTHS:
        means = _means(left, m)
        if (m > 1 and 2 * FOLDS * m > len(t_ns)) or (scatter := _scatter(means, everything)) is None:
            continue
        for in_a_row in (_TOLD, _IN_A_ROW) if m == 1 else (_IN_A_ROW,):
            evidence = np.zeros(len(t_ns))
            for part in np.array_split(np.arange(len(t_ns)), FOLDS):
                rest = everything.copy()
                rest[part] = False
                evidence[part] = _evidence(_scatter(means, rest) or scatter, means, in_a_row)[0][part]
            looks.append(Look(scatter, in_a_row, _rate(evidence, m + in_a_row - 1, years)))
    if not looks:
        raise BadInputError(
            f"too few of the {len(t_ns)} healthy rows are independent of each other to learn how {left.residual.shape[1]} "
            "features scatter"
        )
    return tuple(looks)


def _scatter(means: Means, use: Annotated[NDArray[np.bool_], "w"]) -> Scatter | None:
    """Estimate the covariance of means from some of the times; None where too few of them are independent.

    Single readings count by their weights: means over more have lost those of another mode.
    """
    rows = use & np.isfinite(means.score).all(axis=1)
    x = means.score[rows]
    k = x.shape[1]
    if len(x) < 2 * means.m:
        return None
    alone = _independent(x, means.m)
    weights = _weights(x, alone) if means.m == 1 else np.ones(len(x))
    covariance, shrink = _shrunk((x * weights[:, None]).T @ x / len(x), alone)
    shrunk = alone * shrink / max(1.0 - shrink, 1e-12)
    least = 2.0 + _taken(k, shrunk)
    if alone < least:
        return None
    inverse = np.linalg.inv(covariance)
    root = np.linalg.cholesky(inverse)
    freedom = alone, _independent(x @ inverse, means.m), _independent(x @ root, means.m)
    return None if min(freedom) < least else Scatter(means.m, covariance, freedom, shrunk, means.law[rows].mean(axis=0))


def _weights(x: Annotated[Array, "r k"], count: float) -> Annotated[Array, "r"]:
    """Weigh readings by how far out they lie, as the multivariate t distribution of greatest likelihood does.

    Their covariance has the quartiles of most, not the size of a few readings of another mode.
    """
    k, found, best = x.shape[1], np.ones(len(x)), -np.inf
    covariance, _ = _shrunk(x.T @ x / len(x), count)
    for nu in reversed(TAILS):
        for _ in range(_WEIGHINGS):
            weights = (nu + k) / (nu + ((x @ np.linalg.inv(covariance)) * x).sum(axis=1))
            covariance, _ = _shrunk((x * weights[:, None]).T @ x / len(x), count)
        likelihood = float(multivariate_t.logpdf(x, shape=covariance, df=nu).sum())
        if likelihood > best:
            best, found = likelihood, weights * quartiles_over_normal(nu) ** 2
    return found


def _shrunk(covariance: Annotated[Array, "k k"], count: float) -> tuple[Annotated[Array, "k k"], float]:
    """Shrink the correlations as far as their squares do not exceed their variances; return the share that went."""
    std, off = np.sqrt(covariance.diagonal()), ~np.eye(len(covariance), dtype=bool)
    r = (covariance / np.outer(std, std))[off]
    shrink = min(1.0, float(((1.0 - r**2) ** 2).sum()) / count / max(float((r**2).sum()), 1e-12))
    return np.where(off, (1.0 - shrink) * covariance, covariance), shrink


def _taken(k: int, shrunk: float) -> float:
    """Compute how many independent means the correlations of k features take: as many fewer as their shrinkage is worth."""
    return max(k - 1.0 - shrunk, 0.0)


def _independent(x: Annotated[Array, "w k"], m: int) -> float:
    """Estimate how many independent numbers the variance of means over m readings is known from."""
    return len(x) / max(float(m), correlation_time(rankdata(np.abs(x), axis=0)))


def _chance(
    x: Annotated[Array, "r k"],
    covariance: Annotated[Array, "k k"],
    wider: Annotated[Array, "r k"],
    scatter: Scatter,
) -> tuple[Annotated[Array, "r"], Annotated[Array, "r k"]]:
    """Compute ln of the probability of the least likely of the tests on healthy means, and each feature's standard score.

    `wider` is the variance from the error of the law beyond that in the covariance.
    """
    k, freedom = x.shape[1], scatter.freedom
    taken = _taken(k, scatter.shrunk)
    each = covariance + wider[:, :, None] * np.eye(k)
    inverse = np.linalg.inv(each)
    turned = (inverse @ x[:, :, None])[:, :, 0]
    std = np.sqrt(np.diagonal(each, axis1=1, axis2=2))
    alone, beside = x / std, turned / np.sqrt(np.diagonal(inverse, axis1=1, axis2=2))
    whole = alone.sum(axis=1) / np.sqrt((each / std[:, :, None] / std[:, None, :]).sum(axis=(1, 2)))
    left = max(freedom[2] - taken, 1.0)
    chances = (
        _by_itself(np.abs(np.column_stack([alone, whole])).max(axis=1), k, freedom[0]),
        float(k) * student.sf(np.abs(beside).max(axis=1), max(freedom[1] - taken, 1.0)),
        0.5 * fisher.sf((turned * x).sum(axis=1) * left / (freedom[2] * k), k, left),
    )
    return _ln_of_tests(np.minimum.reduce(chances)), alone


def _by_itself(score: Array, k: int | NDArray[np.intp], freedom: float) -> Array:
    """Compute the probability, to one side, that one of k features or their sum has as high a score."""
    return np.asarray((k + 1.0) * student.sf(score, freedom))


def _ln_of_tests(chance: Array) -> Array:
    """Compute ln of the probability that the least likely of three tests, to two sides, is as unlikely."""
    return np.asarray(np.log(np.maximum(6.0 * chance, _LEAST_CHANCE)))


def _rate(evidence: Annotated[Array, "w"], length: int, years: float) -> Rate:
    """Learn how often healthy readings reach an evidence, from episodes that lie at least a stretch's length apart.

    Above the level lie as many stretches as the root of their number.  Of a right probability the mean excess is 1, which counts
    as some episodes more.
    """
    judged = evidence[np.isfinite(evidence)]
    level = float(np.quantile(judged, 1.0 - min(np.sqrt(length / judged.size), 1.0)))
    above = np.flatnonzero(evidence > level)
    begins = np.flatnonzero(np.diff(above, prepend=-length - 1) > length).tolist()
    peaks = np.array([evidence[above[a:b]].max() for a, b in pairwise([*begins, above.size])]) - level
    count = peaks.size + _TRUSTED
    return Rate(level, max(peaks.size, 1) / max(years, 1e-12), (float(peaks.sum()) + _TRUSTED) / count, count)
