"""Result lines: a window as its line of results.jsonl, an alarm as JSON, and the summary of a replay in words."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import NoneType
from typing import Any

import numpy as np

from monitor.core import (
    WHOLE,
    Alarm,
    AlarmCondition,
    ComplexArray,
    Level,
    ModalReading,
    OtherMode,
    WindowResult,
    finish,
    parse_json,
    partial,
)
from monitor.damage import LEVEL, AlarmState, State, WindowFacts, drift_m, hold, modal_facts, modal_parts
from monitor.publish.results.schema import LINE_SCHEMA, MODAL_KEYS

_KINDS: dict[str, type] = {
    "array": list,
    "boolean": bool,
    "null": NoneType,
    "number": float,
    "object": dict,
    "string": str,
}
"""Type of JSON schema -> type of its values, but for integers. [none; definition]"""


def _rounded(values: Any) -> Any:
    """Round numbers of any shape to nine significant digits, which exceeds the precision of the data and keeps lines short."""
    return _round_nested(np.asarray(values, dtype=float).tolist())


def _round_nested(value: Any) -> Any:
    """Round the numbers of nested lists; a number that is not finite becomes None."""
    if isinstance(value, list):
        return [_round_nested(v) for v in value]
    return float(f"{value:.9g}") if math.isfinite(value) else None


def window_line(result: WindowResult) -> dict[str, Any]:
    """Collect the values of a window's line of results.jsonl.

    Parameters
    ----------
    result : WindowResult
        The estimates of the window, or why there are none.

    Returns
    -------
    dict
        Keys and units as in docs/results.md; None where nothing was estimated.

    Examples
    --------
    >>> from monitor.core import Alarm, Level, Skipped
    >>> alarm = Alarm(Level.NORMAL, (), "no baseline")
    >>> line = window_line(WindowResult(0, 400_000_000_000, 400.0, None, None, None, alarm, Skipped("too few poles")))
    >>> line["t_end_ns"], line["alarm"]["level"], line["skipped"], line["ddi"]
    (400000000000, 'normal', 'too few poles', None)
    """
    modes, stiffness, damage, modal = result.modes, result.stiffness, result.damage, result.modal
    n_modes = 0 if modes is None else len(modes.frequencies_hz)
    return {
        "window": result.index,
        "t_end_ns": result.t_end_ns,
        "window_s": _rounded(result.window_s),
        "frequencies_hz": modes and _rounded(modes.frequencies_hz),
        "frequencies_std_hz": modes and _rounded(modes.frequencies_std_hz),
        "damping_ratio": modes and _rounded(modes.damping_ratio),
        "damping_std": modes and _rounded(modes.damping_std),
        "mode_shapes": modes and [_shape(shape) for shape in modes.shapes],
        "order": modes and modes.order,
        "refined": modes and modes.refined,
        "stiffness_n_per_m": stiffness and _rounded(stiffness.stiffness_n_per_m),
        "stiffness_std": stiffness and _rounded(np.sqrt(np.diag(stiffness.covariance))),
        "ddi": damage and _rounded(damage.ddi),
        "ddi_std": damage and _rounded(damage.ddi_std),
        "ddi_sequential": damage and _rounded(damage.ddi_sequential),
        "loss_n_per_m": damage and _rounded(damage.loss_n_per_m),
        "unidentified": damage and list(damage.unidentified),
        "detectable_loss": None if result.detectable_loss is None else _rounded(result.detectable_loss),
        "rms_m_s2": None if result.rms_m_s2 is None else _rounded(result.rms_m_s2),
        "model_modes": modes and [int(k) + 1 for k in modes.model_mode],
        "mode_tracks": list(result.mode_tracks[:n_modes]),
        "other_modes": modes and _other_modes(modes.others, result.mode_tracks[n_modes:]),
        "misfit": stiffness and _rounded(stiffness.misfit),
        "temperature_degc": result.temperature and _rounded(result.temperature.lagged_degc[0]),
        "temperature_effect": None
        if damage is None or damage.temperature_effect is None
        else _rounded(damage.temperature_effect),
        "covariates": {name: _rounded(_as_shown(name, values[0])) for name, values in result.covariates.items()},
        "covariate_effect": damage and {name: _rounded(part) for name, part in damage.covariate_effect.items()},
        **_modal_changes(modal),
        "alarm": {
            "level": result.alarm.level.value,
            "stories": list(result.alarm.stories),
            "reason": result.alarm.reason,
            "active": {str(j): level.value for j, level in result.alarm.active.items()},
            "shelved": [j for j, c in result.alarm.conditions.items() if c is AlarmCondition.SHELVED],
            "changed": [] if modal is None else _changed(modal, result.alarm),
        },
        "channels_left_out": [gone.channel for gone in result.left_out],
        "left_out_reasons": [gone.reason for gone in result.left_out],
        "rates_hz": result.rates_hz and _rounded(result.rates_hz),
        "skipped": result.skipped and result.skipped.reason,
    }


def _modal_changes(modal: ModalReading | None) -> dict[str, Any]:
    """Collect the changes of the modes since the baseline; None where they are not what is judged."""
    if modal is None:
        return dict.fromkeys(MODAL_KEYS)
    shape, shape_std = modal.largest_shape_change()
    return {
        "frequency_change": _rounded(np.expm1(modal.ln_frequency)),
        "frequency_change_std": _rounded(modal.ln_frequency_std),
        "shape_change": _rounded(shape),
        "shape_change_std": _rounded(shape_std),
        "frequency_effect": {name: _rounded(np.expm1(part)) for name, part in modal.covariate_effect.items()},
    }


def _changed(modal: ModalReading, alarm: Alarm) -> list[str]:
    """Name the modes and shapes at the announced level; none where all modes changed alike, or nothing did."""
    parts = modal_parts(modal.ln_frequency.size)
    return [parts[j - 1] for j, level in alarm.active.items() if j != WHOLE and level is alarm.level]


def _as_shown(name: str, value: float) -> float:
    """Return a covariate's value as it is published: the level as RMS drift in m."""
    return drift_m(value) if name == LEVEL else value


def _shape(shape: ComplexArray) -> list[list[float] | None]:
    """Write a mode's shape, a pair of real and imaginary part for each channel; None for a channel that is left out."""
    pairs = _rounded(np.stack([shape.real, shape.imag], axis=-1))
    return [pair if np.isfinite(value) else None for pair, value in zip(pairs, shape, strict=True)]


def _other_modes(others: Sequence[OtherMode], tracks: Sequence[int]) -> list[dict[str, Any]]:
    """Collect the values of the modes that the model has no counterpart for."""
    return [
        {
            "frequency_hz": _rounded(mode.frequency_hz),
            "frequency_std_hz": _rounded(mode.frequency_std_hz),
            "damping_ratio": _rounded(mode.damping_ratio),
            "mode_shape": _shape(mode.shape),
            "track": track,
        }
        for mode, track in zip(others, tracks, strict=True)
    ]


def alarm_line(alarm: Alarm) -> dict[str, Any]:
    """Collect the values of an alarm for JSON; story ``0`` is the structure as a whole."""
    return {
        "level": alarm.level.value,
        "stories": list(alarm.stories),
        "reason": alarm.reason,
        "active": {str(story): level.value for story, level in alarm.active.items()},
        "conditions": {str(story): condition.value for story, condition in alarm.conditions.items()},
    }


def current_alarm_line(state: AlarmState) -> dict[str, Any]:
    """Collect the values of the present alarm, operators' requests since the latest window included."""
    _, present = hold(state, 0)
    return {key: value for key, value in alarm_line(present).items() if key != "reason"}


def to_json(value: dict[str, Any]) -> str:
    """Write values as strict JSON on one line.

    Raises
    ------
    ValueError
        If a number is not finite.

    Examples
    --------
    >>> to_json({"ddi": [0.12, None], "window": 3})
    '{"ddi": [0.12, null], "window": 3}'
    """
    return json.dumps(value, allow_nan=False, separators=(", ", ": "))


class LinesFile:
    """File results.jsonl in the making, which takes its final name only when it is closed."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = partial(path).open("w", encoding="utf-8")

    def write(self, line: str) -> None:
        """Add one line."""
        self._file.write(line + "\n")

    def close(self) -> None:
        """Flush the file to the disk and give it its final name."""
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()
        finish(self._path)

    def abandon(self) -> None:
        """Close the unfinished file and remove it."""
        self._file.close()
        partial(self._path).unlink(missing_ok=True)


def read_line(text: str | bytes, defaults: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Read a line of results.jsonl, which may be damaged.

    Parameters
    ----------
    text : str or bytes
        The line.
    defaults : mapping, optional
        Values of keys that the line may lack.

    Raises
    ------
    ValueError
        It is no line of results.

    Examples
    --------
    >>> read_line('{"t_end_ns": [1], "alarm": {}, "skipped": null}')
    Traceback (most recent call last):
    ...
    ValueError: it is not as `LINE_SCHEMA` says
    """
    line = parse_json(text)
    if isinstance(line, dict):
        line = {**(defaults or {}), **line}
    if not _fits(line, LINE_SCHEMA):
        raise ValueError("it is not as `LINE_SCHEMA` says")
    return dict(line)


def _fits(value: Any, schema: Mapping[str, Any]) -> bool:
    """Return whether a value has the types of a JSON schema, its numbers are finite, and its integers fit into 64 bits."""
    kinds = schema.get("type", [])
    if not any(_is_of(value, kind) for kind in ([kinds] if isinstance(kinds, str) else kinds)):
        return not kinds
    if isinstance(value, dict):
        parts = schema.get("properties", {})
        return set(schema.get("required", ())) <= value.keys() and all(
            _fits(v, parts.get(k, {})) for k, v in value.items()
        )
    return not isinstance(value, list) or all(_fits(v, schema.get("items", {})) for v in value)


def _is_of(value: Any, kind: str) -> bool:
    """Return whether a value is of a type of JSON schema."""
    if isinstance(value, int) and not isinstance(value, bool):
        return kind in {"integer", "number"} and -(1 << 63) <= value < 1 << 63
    if isinstance(value, float) and not math.isfinite(value):
        return False
    return isinstance(value, _KINDS.get(kind, ()))


def facts_of_line(line: Mapping[str, Any]) -> WindowFacts:
    """Collect what the state needs of a window from its line of results.jsonl."""
    level = Level(line["alarm"]["level"])
    if line.get("frequency_change") is not None:
        return _modal_facts(line, level)
    active = _active(line["alarm"], level, line["alarm"]["stories"])
    losses = {} if line["ddi"] is None else {story: _reading(line, story) for story in active}
    detectable = line.get("detectable_loss")
    return WindowFacts(
        line["t_end_ns"],
        line.get("window_s") or 0.0,
        line["skipped"],
        active,
        losses,
        tuple(line["alarm"].get("shelved", ())),
        None if detectable is None else tuple(detectable),
        line.get("misfit"),
        line.get("rms_m_s2"),
        () if line["ddi"] is None else tuple(zip(line["ddi"], line["ddi_std"], strict=True)),
        tuple(zip(line.get("channels_left_out") or (), line.get("left_out_reasons") or (), strict=False)),
        rates_hz=_rates_hz(line),
    )


def _rates_hz(line: Mapping[str, Any]) -> tuple[float, float] | None:
    """Return the stated rate and that by the timestamps, where a line has both."""
    stated, stamped = line.get("rates_hz") or (None, None)
    return None if stated is None or stamped is None else (float(stated), float(stamped))


def _modal_facts(line: Mapping[str, Any], level: Level) -> WindowFacts:
    """Collect what the state needs of a window of modes alone."""
    frequency, shape = line["frequency_change"], line["shape_change"]
    sizes = zip([*frequency, *shape], [*line["frequency_change_std"], *line["shape_change_std"]], strict=True)
    parts, known = modal_parts(len(frequency)), list(sizes)
    changed = [parts.index(part) + 1 for part in line["alarm"]["changed"]]
    active = _active(line["alarm"], level, changed)
    return modal_facts(
        line["t_end_ns"],
        line.get("window_s") or 0.0,
        active,
        [(None, None) if size is None else (size, std) for size, std in known],
        tuple(line["alarm"].get("shelved", ())),
        line.get("detectable_loss"),
        line.get("rms_m_s2"),
        tuple(zip(line.get("channels_left_out") or (), line.get("left_out_reasons") or (), strict=False)),
        _rates_hz(line),
    )


def _active(alarm: Mapping[str, Any], level: Level, announced: list[int]) -> dict[int, Level]:
    """Return the level of each announced story or part; older lines, without `active`, tell those of the highest level alone."""
    if "active" in alarm:
        return {int(j): Level(own) for j, own in alarm["active"].items()}
    return {} if level is Level.NORMAL else dict.fromkeys(announced or [WHOLE], level)


def _reading(line: Mapping[str, Any], story: int) -> tuple[float, float, float | None]:
    """Return a story's damage index, its standard deviation and the stiffness lost in N/m; `WHOLE`: of what lost least."""
    j = int(np.argmin(line["ddi"])) if story == WHOLE else story - 1
    lost = line.get("loss_n_per_m")
    return float(line["ddi"][j]), float(line["ddi_std"][j]), None if lost is None else float(lost[j])


def replay_text(summary: Mapping[str, Any]) -> str:
    """Describe a replay in words, from the content of its summary.json; the state stands last, where a terminal shows it."""
    pace = f"{summary['realtime_factor']:.0f} x real time" + (", diagnosis apart" if summary.get("findings") else "")
    text = [f"{summary['windows']} windows, {summary['skipped']} skipped, {pace}"]
    if not_due := summary.get("windows_not_due"):
        text.append(f"{not_due} more reach into the time between recordings: not due, not counted")
    drawn_hz = summary["structure_file_frequencies_hz"]
    modes = summary["model_modes"] or []
    means = list(zip(modes, summary["frequencies_hz"] or [], strict=True))
    for (mode, measured), misfit in zip(means, summary["frequency_misfit"] or [None] * len(means), strict=True):
        line = f"mode {mode}: {measured:.4g} Hz measured"
        if misfit is not None:  # there is a model
            line += f", {drawn_hz[mode - 1]:.4g} Hz by the structure file (the data lie {100 * misfit:+.1f} % off)"
        text.append(line)
    for other in summary["other_modes"]:
        where = f"in {other['windows']} of {summary['windows']} windows"
        whose = "the model" if drawn_hz else "the baseline"
        text.append(f"besides: {other['frequency_hz']:.4g} Hz measured {where}, no mode of {whose}")
    text += summary["missing_modes"]
    text += [f"event {event['id']}: {event['says']}" for event in summary.get("events", ())]
    state = State(summary["state"])
    return "\n".join([*text, f"{state.words}: {summary['headline']}", *(f"  {doubt}" for doubt in summary["doubts"])])
