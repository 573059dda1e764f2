"""Lines of events.jsonl: an event as JSON, and in words."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from monitor.core import DIRECTION_WORDS, Array, name_stories, parse_json, rounded
from monitor.events import Event, FloorMotion, Spectrum

EVENTS = "events.jsonl"
"""File of the events, beside results.jsonl. [name; contract]"""


_NUMBERS = {
    "drift_peak_m": "drift_m",
    "drift_peak_std_m": "drift_std_m",
    "drift_ratio_peak": "drift_ratio",
    "drift_corner_hz": "corner_hz",
    "frequencies_before_hz": "before_hz",
    "frequencies_during_hz": "during_hz",
    "frequencies_after_hz": "after_hz",
    "loss": "loss",
    "loss_std": "loss_std",
}
"""Key of a line -> field of an event. [names; contract]"""
_OF_MOTION = ("peak_m_s2", "rms_m_s2", "peak_m_s", "arias_m_s", "cav_m_s")
"""Numbers of a channel's motion, as keys and as fields. [names; contract]"""
_OF_SPECTRUM = ("period_s", "pseudo_acceleration_m_s2")
"""Those of the response spectrum. [names; contract]"""


def event_line(event: Event, recording: str | None = None) -> dict[str, Any]:
    """Collect the values of an event's line of events.jsonl, None where one cannot be said; `recording` has its samples."""
    numbers = {key: rounded(getattr(event, field)) for key, field in _NUMBERS.items()}
    if not np.isfinite(event.drift_ratio).any():
        numbers["drift_ratio_peak"] = None
    spectrum = event.spectrum
    return {
        "id": event.id,
        "revision": event.revision,
        "t_begin_ns": event.begin_ns,
        "t_end_ns": event.end_ns,
        "peak_acceleration_m_s2": {f.channel: rounded(f.peak_m_s2) for f in event.floors},
        "ground_peak_m_s2": None if event.ground is None else rounded(event.ground.peak_m_s2),
        **numbers,
        **({"drift_corner_peak_m": rounded(event.drift_corner_m)} if event.drift_corner_m.size else {}),
        "verdict": event.verdict,
        "exceeded": list(event.exceeded),
        "saturated": list(event.saturated),
        "cut": event.cut,
        "floors": [_motion(f) for f in event.floors],
        "ground": None if event.ground is None else _motion(event.ground),
        "instrumental_intensity": rounded(event.instrumental_intensity),
        "spectrum": None if spectrum is None else {key: rounded(getattr(spectrum, key)) for key in _OF_SPECTRUM},
        "recording": recording,
        "note": event.note,
    }


def read_event(line: Mapping[str, Any]) -> Event:
    """Read an event from its line of events.jsonl, NaN where it cannot say; KeyError, TypeError or ValueError if it is none."""
    numbers = {field: line[key] for key, field in _NUMBERS.items()}
    corner_hz = float(numbers.pop("corner_hz"))
    numbers["drift_ratio"] = numbers["drift_ratio"] or [None] * len(line["drift_peak_m"])
    spectrum = line["spectrum"]
    return Event(
        id=str(line["id"]),
        revision=line["revision"],
        begin_ns=int(line["t_begin_ns"]),
        end_ns=int(line["t_end_ns"]),
        floors=tuple(_read_motion(f) for f in line["floors"]),
        ground=None if line["ground"] is None else _read_motion(line["ground"]),
        spectrum=None if spectrum is None else Spectrum(*(_array(spectrum[key]) for key in _OF_SPECTRUM)),
        instrumental_intensity=line["instrumental_intensity"],
        corner_hz=corner_hz,
        **{field: _array(values) for field, values in numbers.items()},
        verdict=line["verdict"],
        exceeded=tuple(line["exceeded"]),
        saturated=tuple(line.get("saturated", ())),
        cut=bool(line.get("cut", False)),
        note=str(line["note"]),
        drift_corner_m=_array(line.get("drift_corner_peak_m") or []),
    )


def last_told(path: Path) -> dict[str, dict[str, Any]]:
    """Read the line of the highest revision of each event in events.jsonl, by its id; OSError if it cannot be read."""
    found, latest = dict[str, dict[str, Any]](), dict[str, int]()
    for text in path.read_bytes().splitlines():
        try:
            line = parse_json(text)
            id, revision = str(line["id"]), int(line["revision"])
        except (ValueError, KeyError, TypeError):  # preliminary, or a line that a crash cut
            continue
        if revision >= latest.get(id, 0):
            found[id], latest[id] = line, revision
    return found


def telling(event: Event) -> str:
    """Say which telling of an event this is, and its id."""
    told = {None: "preliminary", 0: "measured", 1: "lasting loss" if event.loss.size else "afterwards"}
    return f"strong motion ({told[event.revision]}), {event.id}"


def strongest_floor(event: Event) -> FloorMotion | None:
    """Return the motion of the channel with the largest acceleration; None where none is known."""
    known = (f for f in event.floors if math.isfinite(f.peak_m_s2))
    return max(known, key=lambda f: f.peak_m_s2, default=None)


def event_text(event: Event, names: Sequence[str] = ()) -> str:
    """Tell an event in one sentence, as for a message: first the verdict, then the largest acceleration and the largest drift.

    The `names` are those of the stories.
    """
    parts = [event.verdict or "no limit was judged"]
    of_ground = "at least " if event.cut else ""
    least = "at least " if event.saturated else of_ground
    if (strongest := strongest_floor(event)) is not None:
        parts.append(f"largest acceleration {least}{strongest.peak_m_s2:.2g} m/s^2 at {strongest.channel}")
    if event.ground is not None:
        parts.append(f"ground {of_ground}{event.ground.peak_m_s2:.2g} m/s^2")
    if np.isfinite(event.drift_m).any():
        j = int(np.nanargmax(event.drift_m))
        drift = with_interval(1e3 * event.drift_m[j], 2e3 * event.drift_std_m[j])
        parts.append(f"largest drift {least}{drift} mm in {story_place(event, j)}")
    if np.isfinite(event.loss).any():
        j = int(np.nanargmax(event.loss / event.loss_std))
        lost = with_interval(100.0 * event.loss[j], 200.0 * event.loss_std[j])
        parts.append(f"lasting loss {lost} % of stiffness in {story_place(event, j)}")
    if event.saturated:
        parts.append(f"{', '.join(event.saturated)} reached the end of the range")
    text = name_stories("; ".join(parts), names)
    return text[0].upper() + text[1:] + "."


def story_place(event: Event, j: int) -> str:
    """Return the place of an event's drift or loss by its number in their lists, from 0, as effects have it."""
    n, ways = event.drift_corner_m.size, list(DIRECTION_WORDS)
    if not n:
        return f"story {j + 1}"
    return f"storey {j % n + 1} {ways[j // n]}" if event.loss.size > n else f"storey {j + 1}"


def with_interval(value: float, half: float, digits: int = 3) -> str:
    """Write a number with what lies on either side of it, to two digits of that; to `digits` where that is not known.

    Examples
    --------
    >>> with_interval(7.5931, 0.1296), with_interval(-0.004, 1.3), with_interval(123.4, 25.0), with_interval(2.0, math.nan)
    ('7.59 ± 0.13', '0.0 ± 1.3', '123 ± 25', '2')
    """
    if not math.isfinite(half) or half <= 0.0:
        return f"{value:.{digits}g}"
    places = max(0, 1 - math.floor(math.log10(half)))
    return f"{round(value, places) + 0.0:.{places}f} ± {half:.{places}f}"  # never -0


def _motion(floor: FloorMotion) -> dict[str, Any]:
    return {"channel": floor.channel, **{key: rounded(getattr(floor, key)) for key in _OF_MOTION}}


def _read_motion(content: Mapping[str, Any]) -> FloorMotion:
    return FloorMotion(content["channel"], *_array([content[key] for key in _OF_MOTION]).tolist())


def _array(values: Sequence[float | None]) -> Array:
    """Make an array of numbers; NaN for None."""
    return np.array([np.nan if v is None else float(v) for v in values])
