"""Records beside a run's results: the sensors' quality, the findings of diagnoses, and the decisions of operators."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from monitor.core import AlarmCondition, parse_json, utc_ns
from monitor.damage import Loss
from monitor.events import Event, EventAlarm
from monitor.publish.reports.period_data import utc
from monitor.publish.results.event_lines import EVENTS, last_told, read_event
from monitor.publish.results.recorded_time import between_recordings
from monitor.publish.results.summary import Quality as Totals

_REQUEST = re.compile(
    r"(acknowledge|reset|shelve|unshelve) alarm of (story|mode|the shape of mode) (\d+)[^:]*: ?(.*)", re.DOTALL
)

SENSORS = ("channel", "in use", "#RMS, m/s²", "#peak, m/s²", "#noise floor, m/s²/√Hz", "remarks")
"""Head of the live page's table of the channels. [words]"""


@dataclass(frozen=True, slots=True)
class Quality:
    """Quality of the sensors and of the stream."""

    says: str
    """Source and span of the figures in words."""
    table: Mapping[str, Any]
    """As `quality` of summary.json; of a channel `peak_m_s2` and `noise_floor` (median, m/s^2/sqrt(Hz)) where they are known."""
    clocks: tuple[tuple[str, float, float], ...] = ()
    """Sensor node, largest offset in s, latest drift in ppm."""


@dataclass(frozen=True, slots=True)
class Decision:
    """Line of the ledger."""

    t_ns: int
    who: str
    what: str
    action: str = ""
    story: int = -1
    """Story of an operator's request, or what else has this alarm; `WHOLE` is the structure."""


class HealthFile:
    """Contents of health.jsonl over a period, the rotated file included."""

    def __init__(self, folder: Path, from_ns: int, to_ns: int) -> None:
        self._total = Totals()
        self._peaks: dict[str, float] = {}
        self._floors: dict[str, list[float]] = {}
        self._clocks: dict[str, tuple[float, float]] = {}
        self._ends: list[int] = []
        self._times: list[tuple[int, int]] = []
        for line in (line for name in ("health.jsonl.1", "health.jsonl") for line in _read_json_objects(folder / name)):
            if line.get("t_ns") is None:
                continue
            self._times.append((line["wall_ns"], line["t_ns"]))
            if from_ns < line["t_ns"] <= to_ns:
                self._add(line)

    def _add(self, line: dict[str, Any]) -> None:
        stream, total = line["stream"], self._total
        of = ("spikes", "repeated", "clipped")
        channels = ((c["channel"], c["rms_m_s2"] or 0.0, *(c[key] for key in of)) for c in line["channels"])
        self._ends.append(line["t_ns"])
        total.add_span(stream["samples"], stream["rate_hz"], channels)
        total.lost_s += stream["lost_s"]
        total.gaps += stream["gaps"]
        total.overlaps += stream["overlaps"]
        for c in line["channels"]:
            name, floor = c["channel"], c["noise_floor"]
            self._peaks[name] = max(self._peaks.get(name, 0.0), c["peak_m_s2"] or 0.0)
            self._floors.setdefault(name, []).extend([] if floor is None else [floor])
        for clock in (line.get("source") or {}).get("clocks", ()):
            offset, drift = clock["offset_s"] or 0.0, clock["drift_ppm"] or 0.0
            largest = self._clocks.get(clock["node"], (0.0, 0.0))[0]
            self._clocks[clock["node"]] = (max(largest, abs(offset)), drift)

    def quality(self) -> Quality | None:
        """Sum up the period's quality; return None without a line in the period."""
        if not self._ends:
            return None
        table = self._total.content()
        for name, channel in table["channels"].items():
            floors = self._floors[name]
            channel |= {"peak_m_s2": self._peaks[name], "noise_floor": float(np.median(floors)) if floors else None}
        ends = [utc(t) for t in (min(self._ends), max(self._ends))]
        says = f"health.jsonl, {len(self._ends)} spans that end from {ends[0]} to {ends[1]} UTC"
        return Quality(says, table, tuple((node, *c) for node, c in self._clocks.items()))

    def data_ns(self, wall_ns: int) -> int:
        """Convert wall-clock time to the data's time, both UTC in ns, since a stream may run faster than the clock."""
        near = min(self._times, key=lambda pair: abs(pair[0] - wall_ns), default=(wall_ns, wall_ns))
        return near[1] if abs(near[0] - wall_ns) < 60e9 else wall_ns


def read_summary(folder: Path) -> dict[str, Any]:
    """Read summary.json; return an empty dict where it cannot be read."""
    try:
        content = parse_json((folder / "summary.json").read_bytes())
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def summary_quality(summary: dict[str, Any]) -> Quality | None:
    """Return the quality in the summary of a replay, which is that of the whole run; None where the summary has none.

    The time between recordings is no gap and nothing lost.
    """
    table = summary.get("quality")
    if not table:
        return None
    between = between_recordings(summary.get("recorded", ()))
    availability, lost_s = table["availability"], table["lost_s"]
    if between and availability is not None and availability < 1.0:
        came_s = lost_s * availability / (1.0 - availability)
        lost_s = max(0.0, lost_s - 1e-9 * sum(end - begin for begin, end in between))
        availability = came_s / (came_s + lost_s)
    says = "summary.json, the whole run" + (" without the time between its recordings" if between else "")
    told = {"availability": availability, "lost_s": lost_s, "gaps": max(0, table["gaps"] - len(between))}
    return Quality(says, table | told)


def read_findings(folder: Path, from_ns: int, to_ns: int) -> list[dict[str, Any]]:
    """Read the diagnoses of the period's data, in the order of time."""
    found = [f for path in (folder / "findings").rglob("*.json") for f in _read_json_objects(path, whole=True)]
    return sorted((f for f in found if from_ns < f.get("t_ns", 0) <= to_ns), key=lambda f: int(f["t_ns"]))


def read_events(folder: Path) -> list[Event]:
    """Read the events of a run, each as its highest revision says, in the order of time."""
    events = []
    with suppress(OSError):
        for line in last_told(folder / EVENTS).values():
            with suppress(KeyError, TypeError, ValueError):
                events.append(read_event(line))
    return sorted(events, key=lambda e: e.begin_ns)


def event_alarms(summary: dict[str, Any]) -> list[EventAlarm]:
    """Return the alarms of events that a summary lists."""
    return [
        EventAlarm(str(a["id"]), tuple(a["exceeded"]), (), a["condition"] != AlarmCondition.NORMAL, str(a["by"]))
        for a in summary.get("event_alarms", ())
    ]


def read_decisions(folder: Path, health: HealthFile, n_modes: int = 0) -> list[Decision]:
    """Read the ledger in a folder, with its times converted to the data's time; of `n_modes` modes where these are judged."""
    out = []
    for line in _read_json_objects(folder / "ledger.jsonl"):
        t_ns = health.data_ns(utc_ns(line["when"]))
        asked = _REQUEST.fullmatch(line["what"])
        action, story = (asked[1], int(asked[3])) if asked else ("", -1)
        if asked and asked[2].startswith("the shape"):  # numbered after the modes' frequencies
            story += n_modes
        out.append(Decision(t_ns, line["who"], line["what"], action, story))
    return out


def requests_for(episode: Loss, decisions: Sequence[Decision], following_ns: float) -> list[Decision]:
    """Select what operators requested of an alarm's story, from the alarm's beginning to the story's next alarm."""
    return [d for d in decisions if d.story == episode.story and episode.t_first_ns <= d.t_ns < following_ns]


def _read_json_objects(path: Path, *, whole: bool = False) -> Iterator[dict[str, Any]]:
    """Read the JSON objects of a file, one a line or `whole` as one, and skip what cannot be read."""
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return
    for part in [text] if whole else text.splitlines():
        try:
            value = parse_json(part)
        except ValueError:
            continue
        if isinstance(value, dict):
            yield value
