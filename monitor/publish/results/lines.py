"""Result lines: a window as its line of results.jsonl, an alarm as JSON, and the summary of a replay in words."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from monitor.core import WHOLE, Alarm, Level, finish, parse_json, partial
from monitor.damage import AlarmState, Parts, State, WindowFacts, hold, located
from monitor.publish.results.window_fields import announced, checked_line


def alarm_line(alarm: Alarm) -> dict[str, Any]:
    """Collect the values of an alarm for JSON; story ``0`` is the structure as a whole."""
    return {
        **announced(alarm),
        "conditions": {str(story): condition.value for story, condition in alarm.conditions.items()},
    }


def current_alarm_line(state: AlarmState, parts: Parts, names: Sequence[str] = ()) -> dict[str, Any]:
    """Collect the values of the present alarm, operators' requests since the latest window included."""
    _, present = hold(state, 0, parts)
    return {key: value for key, value in alarm_line(located(present, names)).items() if key != "reason"}


def to_json(value: dict[str, Any]) -> str:
    """Write values as strict JSON on one line; ValueError if a number is not finite.

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
    """Read a line of results.jsonl, with `defaults` of keys that it may lack; ValueError if it is damaged.

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
    try:
        return checked_line(line)
    except ValueError as error:
        raise ValueError("it is not as `LINE_SCHEMA` says") from error


def facts_of_line(line: Mapping[str, Any]) -> WindowFacts:
    """Collect what the state needs of a window from its line; KeyError, TypeError or ValueError if the line is damaged.

    Changes of frequencies tell that modes are judged: the parts are the modes, then as many shapes, then the spectrum; those of
    features that these are, then all together.  Else they are stories.
    """
    changes = next((line[key] for key in ("frequency_change", "feature_change") if line.get(key) is not None), None)
    is_modal = changes is not None
    detectable, (stated, stamped) = line.get("detectable_loss"), line.get("rates_hz") or (None, None)
    Level(line["alarm"]["level"])  # a damaged line may have none
    active = {int(j): Level(level) for j, level in line["alarm"].get("active", {}).items()}
    sizes = _sizes(line, is_modal=is_modal)
    main = sizes if changes is None else sizes[: len(changes)]
    return WindowFacts(
        t_end_ns=line["t_end_ns"],
        window_s=line.get("window_s") or 0.0,
        skipped=line["skipped"],
        active=active,
        losses={
            part: reading
            for part in active
            if (reading := _reading(main if part == WHOLE else sizes[part - 1 : part], is_modal=is_modal)) is not None
        },
        shelved=tuple(line["alarm"].get("shelved", ())),
        detectable=None if detectable is None else tuple(detectable),
        misfit=line.get("misfit"),
        rms_m_s2=line.get("rms_m_s2"),
        changes=tuple((size, std) for size, std, _ in main if size is not None),
        left_out=tuple(zip(line.get("channels_left_out") or (), line.get("left_out_reasons") or (), strict=False)),
        modal=is_modal,
        rates_hz=None if stated is None or stamped is None else (float(stated), float(stamped)),
    )


def _sizes(line: Mapping[str, Any], *, is_modal: bool) -> list[tuple[Any, Any, Any]]:
    """List each story's loss, its deviation and the stiffness lost; of modes alone each frequency's change, then each shape's.

    What the window does not show is None; of a change no stiffness lost is told.  The last of modes alone is the score of the
    spectrum, and of features the years that all together take: they have no size, and 1 for its standard deviation.
    """
    if is_modal:
        of = ("feature",) if line.get("frequency_change") is None else ("frequency", "shape")
        score = line.get("years" if len(of) == 1 else "spectrum_score")
        changes = [*(x for name in of for x in line[f"{name}_change"]), score]
        stds = [*(x for name in of for x in line[f"{name}_change_std"]), None if score is None else 1.0]
        return [(None, None, None) if None in pair else (*pair, None) for pair in zip(changes, stds, strict=True)]
    losses = line["ddi"] or []
    return list(zip(losses, line["ddi_std"] or [], line.get("loss_n_per_m") or [None] * len(losses), strict=True))


def _reading(among: Sequence[tuple[Any, Any, Any]], *, is_modal: bool) -> tuple[float, float, float | None] | None:
    """Return what an alarm says of some parts: of the one that changed least; None where none was seen."""
    known = [one for one in among if one[0] is not None]
    return min(known, key=lambda one: abs(one[0]) if is_modal else one[0], default=None)


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
        text.append(f"besides: {other['frequency_hz']:.4g} Hz measured {where}, compared with no mode of {whose}")
    text += summary["missing_modes"]
    text += [f"event {event['id']}: {event['says']}" for event in summary.get("events", ())]
    state = State(summary["state"])
    return "\n".join([*text, f"{state.words}: {summary['headline']}", *(f"  {doubt}" for doubt in summary["doubts"])])
