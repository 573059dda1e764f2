"""What the healthy stiffness may owe to each covariate: priors, axes, and the law as read from a baseline's file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field

from monitor.core import Array, Settings, decode
from monitor.damage.common_change import CommonChange, learn_common
from monitor.damage.covariate_law import Axis, CovariateLaw, learn, stories_prior
from monitor.damage.level import drift_m
from monitor.signals import LAGS_S

LEVEL = "level"
"""Name of the covariate that is always there: RMS drift of the stories. [name]"""
TEMPERATURE = "temperature"
"""Name of the covariate of the topic ``/temperature``. [name]"""
_MIN_INDEPENDENT_WINDOWS = 4
"""Fewest windows without overlap from which a law is learned. [windows; judgement]"""
_LEVEL_STEP_DB = 3.0
"""Length of the stretches of the level's law. [dB; judgement: a factor of 1.4]"""
_LEVEL_REACH_DB = 18.0
"""Farthest stretch of the level's law from the healthy mean. [dB; judgement: a factor of 8]"""
_TEMPERATURE_STEP_K = 5.0
"""Length of the stretches of the temperature's law. [K; judgement]"""
_TEMPERATURE_REACH_DEGC = (-25.0, 45.0)
"""Ends of the stretches of the temperature's law; one of them begins at 0 degC. [degC; judgement]"""
_STRETCHES = 4
"""Stretches over the learned range of any other covariate, and over as much on either side. [1; judgement]"""
_WORDS = {LEVEL: ("weaker", "stronger"), TEMPERATURE: ("colder", "warmer")}
"""What a value below and above the range is called. [words]"""


class CovariateSettings(Settings):
    """``[compensation]``: how far stiffness may follow covariates, before anything is learned (one standard deviation).

    Published frequencies of intact structures were doubled: a relative change of stiffness is twice that of the frequency.
    """

    level_per_doubling: float = Field(default=0.015, gt=0)
    """Relative change of a story's stiffness where the motion doubles.  Steel and concrete buildings lose 2 to 10 % of their
    frequency over a factor of 10 to 1000 of level (Tamura and Suganuma, J. Wind Eng. Ind. Aerodyn. 59 (1996) 115-130; Clinton et
    al., Bull. Seism. Soc. Am. 96 (2006) 237-257)."""
    temperature_per_k: float = Field(default=0.003, gt=0)
    """The same per K above 0 degC.  Bridges change by 0.5 to 2 per mille of frequency a K (Peeters and De Roeck, Earthquake Eng.
    Struct. Dyn. 30 (2001) 149-171; Xia et al., J. Civil Struct. Health Monit. 2 (2012) 29-46)."""
    frost_per_k: float = Field(default=0.02, gt=0)
    """The same per K below 0 degC: the Z24 bridge gained some 10 % of frequency in 10 K of frost (Peeters and De Roeck)."""
    other: float = Field(default=0.05, gt=0)
    """The same for any other covariate, over its learned range."""
    learn_in_service: bool = True
    """Learn the slopes on from windows of healthy service, the healthy stiffness never."""
    unevenness: float = Field(default=0.5, gt=0)
    """Scatter of the stories' slopes about a common one, relative to its size."""


@dataclass(frozen=True, eq=False, slots=True)
class Change:
    """Change of a healthy window's stiffness from the baseline's, and the covariates that it was under."""

    relative: Annotated[Array, "n"]
    deviations: Annotated[Array, "rows n"]
    """Influences whose squares sum to the covariance of `relative`."""
    places: tuple[tuple[bool, int], ...]
    """Stretch of data of each row of `deviations`: overlapping windows share stretches."""
    covariates: Mapping[str, Annotated[Array, "lags"]]
    """Lagged values of each known covariate."""
    t_ns: int = 0
    """End of the window, UTC; 0 where it is not learned what the quantities do together."""


class LearnedRange(NamedTuple):
    """Values of a covariate over the healthy windows, as people read them: the level in m of RMS drift."""

    unit: str
    low: float
    high: float


def learn_law(
    changes: Sequence[Change],
    span_s: float,
    units: Mapping[str, str],
    settings: CovariateSettings,
    *,
    alike: bool = True,
) -> CovariateLaw | None:
    """Learn the dependence of the stories, or of other quantities, on all covariates over healthy windows.

    `span_s` is the time from the first window to the last: lags up to a quarter of it are tried.  `units` has every covariate
    that may be learned from.  `alike` says whether the quantities follow the covariates in about the same way, before anything
    is learned.

    It is None where too few windows are independent, or no covariate is known in nine tenths of them: their mean would not be
    the baseline's.
    """
    names = [name for name in units if sum(name in c.covariates for c in changes) >= 0.9 * len(changes)]
    if len(changes) < _MIN_INDEPENDENT_WINDOWS:
        return None
    overlap = _overlap(changes)
    if len(changes) < _MIN_INDEPENDENT_WINDOWS * overlap:
        return None
    values, axes = [], []
    for name in names:
        size = next(c.covariates[name].size for c in changes if name in c.covariates)
        lagged = np.array([c.covariates.get(name, np.full(size, np.nan)) for c in changes])
        axis = _axis(name, units[name], lagged[:, 0], settings)
        if axis is not None:
            axes.append(axis)
            values.append(lagged)
    if not axes:
        return None
    relative = np.log1p(np.array([c.relative for c in changes]))
    noise = np.mean([c.deviations.T @ c.deviations for c in changes], axis=0)
    n = relative.shape[1]
    prior = stories_prior(n, settings.unevenness) if alike else np.eye(n)
    lags = [lag_s for lag_s in LAGS_S if lag_s <= span_s / 4.0]
    law = learn(relative, noise, prior, axes, values, overlap, lags)
    return replace(law, common=_common_change(law, relative, values, changes)) if any(c.t_ns for c in changes) else law


def _common_change(
    law: CovariateLaw, relative: Array, values: Sequence[Array], changes: Sequence[Change]
) -> CommonChange:
    """Learn from the healthy windows whose covariates are known what the covariates leave of their changes."""
    taken = np.column_stack([v[:, axis.lag] for axis, v in zip(law.axes, values, strict=True)])
    known = np.isfinite(taken).all(axis=1)
    t_ns = np.array([c.t_ns for c in changes], dtype=np.int64)[known]
    order = np.argsort(t_ns, kind="stable")
    left = relative[known] - law.at(taken[known])
    return learn_common(left[order], t_ns[order], law.mixing)


def _overlap(changes: Sequence[Change]) -> float:
    """Compute the variance of the windows' mean over that of as many independent windows; shared data enter once."""
    rows: dict[tuple[bool, int], Array] = {}
    for change in changes:
        for place, row in zip(change.places, change.deviations, strict=True):
            rows[place] = rows.get(place, 0.0) + row
    together = sum(float(row @ row) for row in rows.values())
    return together / sum(float((c.deviations**2).sum()) for c in changes)


def _axis(name: str, unit: str, values: Array, settings: CovariateSettings) -> Axis | None:
    """Return the prior dependence on a covariate; None for one that never moved and of which nothing else is known."""
    if name == LEVEL:
        half = np.arange(-_LEVEL_REACH_DB, _LEVEL_REACH_DB + 1.0, _LEVEL_STEP_DB)
        slope = settings.level_per_doubling / (20.0 * np.log10(2.0))
        return Axis(name, unit, float(np.nanmean(values)) + half, np.full(half.size + 2, slope))
    if name == TEMPERATURE:
        low, high = _TEMPERATURE_REACH_DEGC
        knots = np.arange(low, high + 1.0, _TEMPERATURE_STEP_K)
        frost = np.r_[False, knots <= 0.0, False]  # the common slope, then the stretch that ends at each knot
        return Axis(name, unit, knots, np.where(frost, settings.frost_per_k, settings.temperature_per_k))
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    if high <= low:
        return None
    knots = np.linspace(2.0 * low - high, 2.0 * high - low, 3 * _STRETCHES + 1)
    return Axis(name, unit, knots, np.full(knots.size + 2, settings.other / (high - low)))


def beyond_words(law: CovariateLaw, covariates: Mapping[str, Array]) -> str:
    """Say which covariate the law's uncertainty is due to, with its value and the range learned.

    Examples
    --------
    >>> axis = Axis("temperature", "degC", np.zeros(1), np.ones(3), range=(10.0, 20.0))
    >>> law = CovariateLaw((axis,), np.zeros(3), np.eye(3), np.zeros((1, 3)), np.eye(3)[None], np.eye(1))
    >>> beyond_words(law, {"temperature": np.array([-5.0])})
    'colder than anything at calibration: temperature -5 degC, learned from 10 to 20 degC'
    """
    variances = law.variances(covariates)
    missing = [axis.name for axis in law.axes if axis.name not in variances]
    name = max(variances, key=lambda name: variances[name], default="")
    axis = next((a for a in law.axes if a.name == name), None)
    side = "" if axis is None else axis.beyond(float(covariates[name][axis.lag]))
    if axis is None or not side:
        unknown = f"; {', '.join(missing)} not known" if missing else ""
        return f"what the covariates do here was not learned at calibration{unknown}"
    word = _WORDS.get(name, ("lower", "higher"))[side == "above"]
    value, low, high = (shown(axis, v) for v in (float(covariates[name][axis.lag]), *axis.range))
    unit = shown_unit(axis)
    return (
        f"{word} than anything at calibration: {name} {value:.3g} {unit}, learned from {low:.3g} to {high:.3g} {unit}"
    )


def law_lines(law: CovariateLaw | None, moved: str = "the stiffness of the stories") -> list[str]:
    """Say for people how far each covariate `moved` the healthy stiffness, one line each."""
    if law is None:
        return ["no dependence on temperature or level learned: too short a record"]
    lines = []
    for axis in law.axes:
        change, std = law.over_range(axis.name)
        sizes = ", ".join(f"{100 * c:+.2f} ± {200 * s:.2f}" for c, s in zip(change, std, strict=True))
        low, high = (shown(axis, v) for v in axis.range)
        lag = f", lag {axis.lag_s:.0f} s" if axis.lag else ""
        lines.append(f"{axis.name} from {low:.3g} to {high:.3g} {shown_unit(axis)} changes {moved} by {sizes} %{lag}")
    if (words := common_words(law)) is not None:
        lines.append(f"what all do together and no covariate explains: {words}")
    return lines


def common_words(law: CovariateLaw | None) -> str | None:
    """Say for people if it is learned what the stories do together without a known cause; None where nothing is."""
    return None if law is None or law.common is None else law.common.words(law.mixing)


def learned_ranges(law: CovariateLaw | None) -> dict[str, LearnedRange]:
    """Return the unit, lowest and highest value that each covariate had at calibration, for people."""
    if law is None:
        return {}
    return {a.name: LearnedRange(shown_unit(a), shown(a, a.range[0]), shown(a, a.range[1])) for a in law.axes}


def shown(axis: Axis, value: float) -> float:
    """Convert a covariate's value for people: a level in dB to the RMS drift in m."""
    return drift_m(value) if axis.name == LEVEL else value


def shown_unit(axis: Axis) -> str:
    """Return the unit of `shown`."""
    return "m" if axis.name == LEVEL else axis.unit


def read_law(content: Any, n: int, place: str = "law") -> CovariateLaw | None:
    """Read the law of n quantities from a baseline's file, None where none was learned; ValueError if it is damaged."""
    if content is None:
        return None
    law = decode(CovariateLaw, content, place=place, n=n)
    if sum(axis.slope_std.size for axis in law.axes) != law.centre.size:
        raise ValueError("the covariates are not those of the law")
    if any(not 0 <= axis.lag < len(LAGS_S) for axis in law.axes) or (law.common and law.common.windows < 0):
        raise ValueError("its covariates are damaged")
    return law
