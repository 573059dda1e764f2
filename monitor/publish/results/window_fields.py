"""The fields of a window's line: the one place that names them.

From this table follow the line of results.jsonl and its JSON schema, the Arrow columns, the history's columns, what the web page
and its description show of a window, and the table of docs/results.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Annotated, Any, Literal, NotRequired

import numpy as np
from annotated_types import Interval
from pydantic import ConfigDict, FiniteFloat, TypeAdapter, WithJsonSchema
from typing_extensions import TypedDict

from monitor.core import WHOLE, Alarm, AlarmCondition, ComplexArray, ModalReading, OtherMode, WindowResult, rounded
from monitor.damage import LEVEL, drift_m, modal_parts

_Integer = Annotated[int, Interval(ge=-(1 << 63), lt=1 << 63), WithJsonSchema({"type": "integer"})]
_Numbers = list[FiniteFloat | None] | None
_STRICT = ConfigDict(strict=True, extra="allow")


class _Alarm(TypedDict, total=False):
    __pydantic_config__ = _STRICT  # type: ignore[misc]
    level: str
    stories: list[_Integer] | None
    directions: list[Literal["x", "y", "torsion"]]
    reason: str
    active: dict[str, str]
    shelved: list[_Integer] | None
    changed: list[str] | None
    features: list[str] | None


def _brief(schema: Any) -> Any:
    """Write a schema without titles, and what may be null by two types: more readers know that."""
    if isinstance(schema, list):
        return [_brief(one) for one in schema]
    if not isinstance(schema, dict):
        return schema
    if "anyOf" in schema:
        value, null = schema["anyOf"]
        return {**_brief(value), "type": [value["type"], null["type"]]}
    return {key: _brief(value) for key, value in schema.items() if key != "title"}


class Kind(Enum):
    """Kind of a field's values: their type, and the JSON schema that follows from it.

    A new field is of a kind that may be null: lines of before have no value of it.
    """

    type: Any
    schema: dict[str, Any]
    NEVER_NULL_INTEGER = "an integer", _Integer
    NEVER_NULL_NUMBER = "a number", FiniteFloat
    INTEGER = "an integer or null", _Integer | None
    NUMBER = "a number or null", FiniteFloat | None
    FLAG = "true, false or null", bool | None
    TEXT = "text or null", str | None
    NUMBERS = "numbers", _Numbers
    INTEGERS = "integers", list[_Integer] | None
    TEXTS = "texts", list[str] | None
    SHAPES = "for each mode, a pair of real and imaginary part for each channel", list[list[_Numbers]] | None
    MODES = "modes", list[dict[str, Any]] | None
    BY_NAME = "numbers by name", dict[str, FiniteFloat | None]
    LISTS_BY_NAME = "lists of numbers by name", dict[str, _Numbers] | None
    ALARM = "an alarm", _Alarm

    def __new__(cls, words: str, kind_of_value: Any) -> Kind:
        """Make a kind whose value is its words."""
        kind = object.__new__(cls)
        kind._value_, kind.type = words, kind_of_value
        kind.schema = _brief(TypeAdapter(kind_of_value).json_schema())
        return kind


@dataclass(frozen=True, slots=True)
class Field:
    """One field."""

    key: str
    kind: Kind
    of: Callable[[WindowResult], Any]
    """Its value, as JSON, of a window's result."""
    meaning: str
    """With its unit, for people."""
    kept: bool = False
    """Whether the history has a column for it."""
    shown: bool = False
    """Whether the web page has it."""


def _numbers(*names: str) -> Callable[[WindowResult], Any]:
    """Return what reads numbers of the result, or of a part of it such as `modes`; None without the part or the numbers."""

    def read(result: WindowResult) -> Any:
        value: Any = result
        for name in names:
            value = None if value is None else getattr(value, name)
        return None if value is None else rounded(np.asarray(value, dtype=float))

    return read


def _shape(shape: ComplexArray) -> list[list[float] | None]:
    """Write a mode's shape, a pair of real and imaginary part for each channel; None for a channel that is left out."""
    pairs = rounded(np.stack([shape.real, shape.imag], axis=-1))
    return [pair if np.isfinite(value) else None for pair, value in zip(pairs, shape, strict=True)]


def _other_modes(others: Sequence[OtherMode], tracks: Sequence[int]) -> list[dict[str, Any]]:
    """Collect the values of the modes that the model has no counterpart for."""
    numbers = ("frequency_hz", "frequency_std_hz", "damping_ratio")
    return [
        {**{key: rounded(getattr(mode, key)) for key in numbers}, "mode_shape": _shape(mode.shape), "track": track}
        for mode, track in zip(others, tracks, strict=True)
    ]


def _n_modes(result: WindowResult) -> int:
    return 0 if result.modes is None else len(result.modes.frequencies_hz)


def shown_as(name: str, value: float, result: WindowResult) -> float:
    """Return a covariate's value as it is published: the level as RMS drift in m; beside features as it was given."""
    return drift_m(value) if name == LEVEL and result.features is None else value


def _of_shape(which: int) -> Callable[[WindowResult], Any]:
    """Return what reads the largest change of each mode's shape (0), or its deviation (1)."""
    return lambda result: result.modal and rounded(result.modal.largest_shape_change()[which])


def announced(alarm: Alarm) -> dict[str, Any]:
    """Collect what an alarm announces, for JSON; story ``0`` is the structure as a whole."""
    return {
        "level": alarm.level.value,
        "stories": list(alarm.stories),
        **({"directions": list(alarm.directions)} if alarm.directions is not None else {}),
        "reason": alarm.reason,
        "active": {str(story): level.value for story, level in alarm.active.items()},
    }


def _alarm(result: WindowResult) -> dict[str, Any]:
    alarm = result.alarm
    return {
        **announced(alarm),
        "shelved": [j for j, c in alarm.conditions.items() if c is AlarmCondition.SHELVED],
        "changed": [] if result.modal is None else _changed(result.modal, alarm),
        **({} if result.features is None else {"features": result.features.told(alarm)}),
    }


def _changed(modal: ModalReading, alarm: Alarm) -> list[str]:
    """Name the modes and shapes at the announced level; none where all modes changed alike, or nothing did."""
    parts = modal_parts(modal.ln_frequency.size)
    return [parts[j - 1] for j, level in alarm.active.items() if j != WHOLE and level is alarm.level]


# fmt: off
FIELDS = (
    Field("window", Kind.NEVER_NULL_INTEGER, lambda r: r.index, "Number of the window since the stream began.", kept=True),
    Field("t_end_ns", Kind.NEVER_NULL_INTEGER, lambda r: r.t_end_ns,
          "End of the window, UTC, ns since 1970.", kept=True, shown=True),
    Field("window_s", Kind.NEVER_NULL_NUMBER, _numbers("window_s"),
          "Length of the data in the window, s.", kept=True, shown=True),
    Field("frequencies_hz", Kind.NUMBERS, _numbers("modes", "frequencies_hz"),
          "Natural frequencies, Hz.", kept=True, shown=True),
    Field("frequencies_std_hz", Kind.NUMBERS, _numbers("modes", "frequencies_std_hz"),
          "Their standard deviations, Hz.", kept=True, shown=True),
    Field("damping_ratio", Kind.NUMBERS, _numbers("modes", "damping_ratio"), "Damping ratios.", kept=True, shown=True),
    Field("damping_std", Kind.NUMBERS, _numbers("modes", "damping_std"),
          "Their standard deviations.", kept=True, shown=True),
    Field("mode_shapes", Kind.SHAPES, lambda r: r.modes and [_shape(shape) for shape in r.modes.shapes],
          "Mode shapes: a pair of real and imaginary part for each channel, null for one that is left out."),
    Field("order", Kind.INTEGER, lambda r: r.modes and r.modes.order, "Order of the state space from which the modes are."),
    Field("refined", Kind.FLAG, lambda r: r.modes and r.modes.refined, "Whether the modes were refined by maximum likelihood."),
    Field("stiffness_n_per_m", Kind.NUMBERS, _numbers("stiffness", "stiffness_n_per_m"),
          "Stiffness of each story of the updated model, N/m; story 1 is the top one; null without a model.", shown=True),
    Field("stiffness_std", Kind.NUMBERS, lambda r: r.stiffness and rounded(np.sqrt(np.diag(r.stiffness.covariance))),
          "Its standard deviation, N/m.", shown=True),
    Field("ddi", Kind.NUMBERS, _numbers("damage", "ddi"),
          "Damage detection index of each story: relative stiffness lost since the baseline (0.12 = 12 %); null "
          "without a model.", kept=True, shown=True),
    Field("ddi_std", Kind.NUMBERS, _numbers("damage", "ddi_std"),
          "Its standard deviation, the baseline's own uncertainty included.", kept=True, shown=True),
    Field("ddi_sequential", Kind.NUMBERS, _numbers("damage", "ddi_sequential"),
          "The same read from the stiffness matrices, story after story, as in the paper."),
    Field("loss_n_per_m", Kind.NUMBERS, _numbers("damage", "loss_n_per_m"), "Stiffness lost in each story, N/m.", kept=True),
    Field("unidentified", Kind.INTEGERS, lambda r: r.damage and list(r.damage.unidentified),
          "Stories of which the modes say next to nothing."),
    Field("detectable_loss", Kind.NUMBERS, _numbers("detectable_loss"),
          "Smallest sudden loss of each story that would be seen (90 % to reach `warning` within an hour, or eight readings), "
          "with what the clock leaves open; null where none would, or without a baseline.", shown=True),
    Field("rms_m_s2", Kind.NUMBER, _numbers("rms_m_s2"), "Level of motion, mean over channels, m/s^2.", shown=True),
    Field("model_modes", Kind.INTEGERS, lambda r: r.modes and [int(k) + 1 for k in r.modes.model_mode],
          "Which mode of the model, or without one of the baseline, each frequency is; 1 = lowest.", shown=True),
    Field("mode_tracks", Kind.INTEGERS, lambda r: list(r.mode_tracks[: _n_modes(r)]),
          "Which mode each one is over time; -1: not seen often enough yet."),
    Field("other_modes", Kind.MODES, lambda r: r.modes and _other_modes(r.modes.others, r.mode_tracks[_n_modes(r) :]),
          "Modes in the data that the model has no counterpart for (torsion, another direction): frequency, "
          "deviation, damping ratio, shape, track."),
    Field("misfit", Kind.NUMBER, _numbers("stiffness", "misfit"),
          "Goodness of fit of the change since the baseline: near 1 when a change of stiffness explains what is "
          "seen, large when something else does.", kept=True, shown=True),
    Field("temperature_degc", Kind.NUMBER, lambda r: r.temperature and rounded(r.temperature.lagged_degc[0]),
          "Temperature of the window, degC.", kept=True, shown=True),
    Field("temperature_effect", Kind.NUMBERS, _numbers("damage", "temperature_effect"),
          "Change of ln stiffness of each story that the temperature explains and that was taken out."),
    Field("covariates", Kind.BY_NAME,
          lambda r: {name: rounded(shown_as(name, values[0], r)) for name, values in r.covariates.items()},
          "Value of each covariate (`level`: RMS story drift, m).", shown=True),
    Field("covariate_effect", Kind.LISTS_BY_NAME,
          lambda r: r.damage and {name: rounded(part) for name, part in r.damage.covariate_effect.items()},
          "Change of ln stiffness of each story that each covariate explains and that was taken out; `unmeasured`: "
          "what all stories do together without a known cause ([temperature](temperature.md))."),
    Field("frequency_change", Kind.NUMBERS, lambda r: r.modal and rounded(np.expm1(r.modal.ln_frequency)),
          "Without a model: relative change of each mode's frequency since the baseline.", kept=True, shown=True),
    Field("frequency_change_std", Kind.NUMBERS, _numbers("modal", "ln_frequency_std"),
          "Its standard deviation.", kept=True, shown=True),
    Field("shape_change", Kind.NUMBERS, _of_shape(0),
          "Without a model: largest change of each mode's shape since the baseline.", shown=True),
    Field("shape_change_std", Kind.NUMBERS, _of_shape(1), "Its standard deviation.", shown=True),
    Field("spectrum_score", Kind.NUMBER, lambda r: r.modal and rounded(r.modal.spectrum),
          "Without a model: score, in standard deviations, of modes that are missing or were never there, by the rates of "
          "calibration; null where that is not judged.", shown=True),
    Field("frequency_effect", Kind.LISTS_BY_NAME,
          lambda r: r.modal and {name: rounded(np.expm1(part)) for name, part in r.modal.ln_frequency_effect.items()},
          "Without a model: relative change of each frequency that each covariate explains and that was taken out."),
    Field("residual_sigma", Kind.NUMBERS, _numbers("features", "sigma"),
          "Of features: what the covariates leave of each in this reading, in standard deviations of healthy ones; null where "
          "it is missing."),
    Field("feature_change", Kind.NUMBERS, _numbers("features", "change"),
          "Change of each feature since the healthy time, less what the covariates explain, by the mean of the latest readings "
          "that tells most, or of 8: of its logarithm, or of itself where it is not of one sign.", kept=True),
    Field("feature_change_std", Kind.NUMBERS, _numbers("features", "change_std"),
          "Its standard deviation.", kept=True),
    Field("years", Kind.NUMBER, _numbers("features", "years"),
          "Of features: in how many years a healthy structure shows as much once, in readings in a row."),
    Field("alarm", Kind.ALARM, _alarm,
          "`normal`, `advisory` (significant, not confirmed), `warning` (confirmed), `alarm` (confirmed, 10 % or "
          "more), the stories and the reason; `active` has the level of each story (0: the structure as a whole) "
          "or, without a model, of each mode and shape; in a building, of each stiffness by its place in the lists, and "
          "`directions` has the direction of each storey. A level is held until the data surely say less "
          "([alarms](alarms.md#levels))."),
    Field("channels_left_out", Kind.TEXTS, lambda r: [gone.channel for gone in r.left_out],
          "Channels of which no use was made.", shown=True),
    Field("left_out_reasons", Kind.TEXTS, lambda r: [gone.reason for gone in r.left_out],
          "What was wrong with each of them.", shown=True),
    Field("rates_hz", Kind.NUMBERS, _numbers("rates_hz"),
          "Rate that the source states, and its rate by the timestamps of the last hour, Hz."),
    Field("skipped", Kind.TEXT, lambda r: r.skipped and r.skipped.reason,
          "Why the damage index of this window is not judged, or null; modes that were found are there all the "
          "same.", kept=True, shown=True),
)
# fmt: on
"""In the order of the line. [none; definition]"""
KEPT = tuple(field for field in FIELDS if field.kept)
"""Fields that the history keeps. [none; definition]"""
SHOWN = tuple(field for field in FIELDS if field.shown)
"""Fields that the web page shows. [none; definition]"""
LINE_SCHEMA: dict[str, Any] = {
    "title": "shm.Window",
    "type": "object",
    "properties": {field.key: field.kind.schema for field in FIELDS},
    "required": ["t_end_ns", "alarm", "skipped"],
}
"""JSON schema of a line. [none; definition]"""
_Line = TypedDict(  # type: ignore[misc]
    "_Line", {f.key: f.kind.type if f.key in LINE_SCHEMA["required"] else NotRequired[f.kind.type] for f in FIELDS}
)
_Line.__pydantic_config__ = _STRICT  # type: ignore[attr-defined]
_LINE = TypeAdapter(_Line)


def checked_line(line: object) -> dict[str, Any]:
    """Return a line that is as `LINE_SCHEMA` says, its numbers finite and its integers of 64 bits; else raise ValueError."""
    return dict(_LINE.validate_python(line))


def window_line(result: WindowResult) -> dict[str, Any]:
    """Collect the values of a window's line; keys and units as in docs/results.md, None where nothing was estimated.

    Examples
    --------
    >>> from monitor.core import Alarm, Level, Skipped
    >>> alarm = Alarm(Level.NORMAL, (), "no baseline")
    >>> line = window_line(WindowResult(0, 400_000_000_000, 400.0, None, None, None, alarm, Skipped("too few poles")))
    >>> line["t_end_ns"], line["alarm"]["level"], line["skipped"], line["ddi"]
    (400000000000, 'normal', 'too few poles', None)
    """
    return {field.key: field.of(result) for field in FIELDS}
