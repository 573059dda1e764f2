"""What the web page shows: the latest results, bounded in number, and their JSON.

Nothing here asks the pipeline: results, states and health come as they are published, the past from the output folder.  The
method of an endpoint names its keys: their values, and for the description their schemas and what they mean.
"""

from __future__ import annotations

import json
import math
import threading
import time
from bisect import bisect_right, insort
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from monitor import __version__
from monitor.core import BadInputError, parse_json, rounded, tail_lines
from monitor.damage import Assessment, State, outdated
from monitor.publish import EVENTS, SHOWN, Kind, closed_files, read_line, read_lines
from monitor.service.status import troubles_of

ENDPOINTS = ("status", "windows", "events", "findings", "alarms", "sensors")
"""Methods of `Snapshots` that name the keys of an endpoint. [names; contract]"""
_DIGITS = 6
"""Significant digits of the numbers of windows. [1; judgement: finer than any interval]"""
_SILENT_S = 60.0
"""Age of the latest health line beyond which a daemon counts as silent; one is written at least every 10 s."""
_BULKY = ("floors", "ground", "spectrum")
"""Keys of an event that events.jsonl alone has. [none; cost]"""

Schema = dict[str, Any]
Keys = dict[str, tuple[Any, Schema, str]]
"""Key -> value, JSON schema, meaning."""
_INTEGER, _NUMBER, _FLAG, _TEXT = (kind.schema for kind in (Kind.INTEGER, Kind.NUMBER, Kind.FLAG, Kind.TEXT))
_NAME: Schema = {"type": "string"}
_NAMES: Schema = {"type": "array", "items": _NAME}
_COUNT: Schema = {"type": "integer"}
_COUNTS: Schema = {"type": "object", "additionalProperties": _COUNT}
_OBJECT: Schema = {"type": ["object", "null"]}
_MONITOR: Schema = {"type": "string", "enum": ["starting", "running", "silent"]}
_STATE: Schema = {"type": "string", "enum": [state.value for state in State]}


def described(properties: Mapping[str, Schema], *optional: str) -> Schema:
    """Write the JSON schema of an object, whose keys are all there but the optional ones."""
    return {"type": "object", "properties": properties, "required": [key for key in properties if key not in optional]}


_CHANNEL: dict[str, Schema] = {"channel": _NAME, "in_use": {"type": "boolean"}, "reason": _TEXT}
_FINDING = (
    dict.fromkeys(("id", "reason", "verdict", "says"), _TEXT)
    | dict.fromkeys(("t_ns", "from_ns"), _INTEGER)
    | {"causes": {"type": ["array", "null"]}}
)
_SHOWN = {shown.key: {**shown.kind.schema, "description": shown.meaning} for shown in SHOWN}
_ALARM = {"level": _TEXT} | {key: Kind.ALARM.schema["properties"][key] for key in ("stories", "changed")}
PARTS = {
    "Window": described(_SHOWN | _ALARM, *(_SHOWN.keys() - {"t_end_ns", "skipped"})),
    "Finding": described(_FINDING),
}
"""Objects of which answers hold several: name -> JSON schema. [none; definition]"""


def part(name: str) -> Schema:
    """Refer to an object of the OpenAPI document by its name."""
    return {"$ref": f"#/components/schemas/{name}"}


def _many(of: Schema) -> Schema:
    return {"type": "array", "items": of}


_WINDOW: Schema = {"anyOf": [part("Window"), {"type": "null"}]}


class Range(BaseModel):
    """Which windows are asked for."""

    model_config = ConfigDict(use_attribute_docstrings=True)
    since_ns: int = Field(default=0, ge=0, lt=1 << 63)
    """Only windows that end later than this."""
    limit: int = Field(default=500, ge=1, le=2000)
    """Largest number of windows; of more, evenly spaced ones are given, the latest among them."""


@dataclass(frozen=True, slots=True)
class Keep:
    """How much of the past is kept, and read at the start."""

    windows: int = 20_000
    """Number of windows; beyond it every second one of the older half is dropped. [1; cost: about 12 MB]"""
    items: int = 200
    """Number of latest events, findings and alarms. [1; judgement]"""
    tail_bytes: int = 64 << 20
    """Bytes at the end of a file of results that are read. [B; cost: a second of reading; about 40 000 windows]"""
    read: int = 8_000
    """Number of windows that are read, the latest half of them without gaps. [1; cost: about two seconds]"""
    packed: int = 40_000
    """Number of latest windows taken from a packed month. [1; cost: as many as `tail_bytes` hold]"""


KEEP = Keep()


@dataclass(frozen=True, slots=True)
class Answer:
    """What an endpoint answers."""

    body: bytes
    etag: str
    """Changes whenever the body does."""
    kind: str = "application/json"


class Snapshots:
    """Keep what was published last, and write it as JSON; any thread may call any method."""

    def __init__(self, site: str, clock: Callable[[], float] = time.monotonic, keep: Keep = KEEP) -> None:
        self._site, self._clock, self._keep = site, clock, keep
        self._lock = threading.Lock()
        self._begun = time.time_ns()  # in every tag, so that none of an earlier run is taken for one of this run
        self._revisions = dict.fromkeys(ENDPOINTS, 0)
        self._assessment = Assessment(State.NOT_JUDGED, "No window of data yet.")
        self._since_ns: int | None = None
        self._windows: list[tuple[int, bytes]] = []
        self._last: dict[str, dict[str, Any] | None] = {"latest": None, "judged": None}
        self._events: dict[str, dict[str, Any]] = {}
        self._findings: dict[tuple[Any, Any], dict[str, Any]] = {}
        self._summary: Mapping[str, Any] = {}
        self._health: Mapping[str, Any] = {}
        self._heard_s = math.inf

    def state(self, assessment: Assessment) -> None:
        """Keep the present state of the structure."""
        with self._lock:
            if assessment.state is not self._assessment.state:
                self._since_ns = (self._last["latest"] or {}).get("t_end_ns")
            self._assessment = assessment
            self._touch()

    def window(self, line: Mapping[str, Any]) -> None:
        """Keep a window, given as its line of results.jsonl."""
        self.windows_before([line])
        with self._lock:
            latest = self._last["latest"]
            if latest is None or line["t_end_ns"] >= latest["t_end_ns"]:
                self._last |= dict.fromkeys(("latest",) if line["skipped"] else ("latest", "judged"), _window(line))
            self._touch("sensors")

    def windows_before(self, lines: Iterable[Mapping[str, Any]]) -> None:
        """Keep windows in the order of their times, whenever they come."""
        for line in lines:
            row = line["t_end_ns"], _json(_window(line))
            with self._lock:
                place = bisect_right(self._windows, row[0], key=itemgetter(0))
                if place and self._windows[place - 1][0] == row[0]:
                    self._windows[place - 1] = row
                else:
                    insort(self._windows, row, key=itemgetter(0))
                if len(self._windows) > self._keep.windows:
                    del self._windows[: self._keep.windows // 2 : 2]
                self._touch("windows")

    def event(self, line: Mapping[str, Any]) -> None:
        """Keep a line of events.jsonl, or the preliminary message, whose revision is null; the highest revision counts."""
        with self._lock:
            known = self._events.get(line["id"])
            if known is None or _revision(line) >= _revision(known):
                self._events = _latest({**self._events, line["id"]: dict(line)}, "t_begin_ns", self._keep.items)
                self._touch("events")

    def finding(self, finding: Mapping[str, Any]) -> None:
        """Keep the finding of a diagnosis."""
        place, brief = (finding.get("t_ns"), finding.get("from_ns")), {key: finding.get(key) for key in _FINDING}
        with self._lock:
            if self._findings.get(place) != brief:
                self._findings = _latest({**self._findings, place: brief}, "t_ns", self._keep.items)
                self._touch("findings")

    def health(self, line: Mapping[str, Any]) -> None:
        """Keep a line of health.jsonl; the sensors' part of it until the next span of data ends."""
        with self._lock:
            channels = line.get("channels") or self._health.get("channels") or ()
            self._health, self._heard_s = {**line, "channels": channels}, self._clock()
            self._touch("sensors")

    def summary(self, content: Mapping[str, Any]) -> None:
        """Keep the content of summary.json."""
        for finding in content.get("findings") or ():
            self.finding(finding)
        with self._lock:
            if any(content.get(key) != self._summary.get(key) for key in ("alarms", "event_alarms")):
                self._touch("alarms")
            self._summary = content
            self._touch("sensors")

    def answer(self, name: str, *asked: Range) -> Answer:
        """Write what an endpoint answers."""
        with self._lock:
            keys: Keys = getattr(self, name)(*asked)
            rows = [f'"{key}":'.encode() + _json(value) for key, (value, *_) in keys.items()]
            etag = f'"{self._begun:x}-{name}-{self._revisions[name]}-{int(self._is_silent)}"'
        return Answer(b"{" + b",".join(rows) + b"}", etag)

    def status(self) -> Keys:
        """State of the structure and of the monitor; which other endpoints changed."""
        shown = self._shown
        monitor = "starting" if not self._health else "silent" if self._is_silent else "running"
        health, summary, known = self._health.get, self._summary.get, self._known.get
        return {
            "site": (self._site, _NAME, "Name of the site."),
            "version": (__version__, _NAME, "Version of shm-monitor."),
            "begun_ns": (self._begun, _COUNT, "When the page began to be served; another one: `revisions` count anew."),
            "state": (shown.state.value, _STATE, "State of the structure."),
            "headline": (shown.headline, _NAME, "The state in one sentence."),
            "doubts": (shown.doubts, _NAMES, "What else holds."),
            "monitor": (monitor, _MONITOR, "Whether the monitor runs."),
            "troubles": (troubles_of(self._health), _NAMES, "Parts that do not work."),
            "t_ns": (health("t_ns"), _INTEGER, "Data until."),
            "data_age_s": (health("data_age_s"), _NUMBER, "Since the latest data came, s."),
            "uptime_s": (health("uptime_s"), _NUMBER, "Since the start of the monitor, s."),
            "disk_free_bytes": (health("disk_free_bytes"), _INTEGER, "Where results go."),
            "windows": (summary("windows"), _INTEGER, "Number of windows in this run."),
            "skipped": (summary("skipped"), _INTEGER, "Number of those that could not be judged."),
            "alarm": (summary("alarm"), _OBJECT, "The present alarm, as in summary.json."),
            "stories": (known("names") or (), _NAMES, "Names of the stories."),
            "has_baseline": (known("has_baseline"), _FLAG, "Without one there is no alarm."),
            "alarm_loss": (known("alarm_loss"), _NUMBER, "Loss from which a confirmed one is an alarm."),
            "latest": (self._last["latest"], _WINDOW, "The latest window."),
            "judged": (self._last["judged"], _WINDOW, "The latest that was not skipped."),
            "revisions": (
                self._revisions,
                _COUNTS,
                "Name of an endpoint: a number that grows when its answer changes.",
            ),
        }

    def windows(self, asked: Range) -> Keys:
        """Results of windows, oldest first."""
        rows = self._windows[bisect_right(self._windows, asked.since_ns, key=itemgetter(0)) :]
        matched = len(rows)
        if matched > asked.limit:
            rows = [rows[matched - 1 - (k * matched) // asked.limit] for k in reversed(range(asked.limit))]
        return {
            "matched": (matched, _COUNT, "Number of windows that end after `since_ns`."),
            "windows": ([text for _, text in rows], _many(part("Window")), "At most `limit` of them."),
        }

    def events(self) -> Keys:
        """Latest events (strong motion), newest first."""
        schema = _many(described({"id": _NAME, "t_begin_ns": _COUNT}))
        brief = [{key: value for key, value in one.items() if key not in _BULKY} for one in self._events.values()]
        return {"events": (brief, schema, "Lines of events.jsonl.")}

    def findings(self) -> Keys:
        """Latest findings of diagnoses, newest first."""
        return {"findings": (list(self._findings.values()), _many(part("Finding")), "As in summary.json.")}

    def alarms(self) -> Keys:
        """Latest alarm episodes, and alarms of events, newest first."""
        episodes, of_events = (
            list(reversed(self._summary.get(key) or ()))[: self._keep.items] for key in ("alarms", "event_alarms")
        )
        return {
            "alarms": (episodes, _many(described({"level": _NAME})), "Those of summary.json."),
            "event_alarms": (of_events, _many(described({"id": _NAME})), "Those of summary.json."),
        }

    def sensors(self) -> Keys:
        """Health of the sensors, the stream, the source and the recorder."""
        row, health = self._last["latest"] or {}, self._health.get
        reasons = dict.fromkeys(self._known.get("aside") or (), "enters no estimate")
        reasons |= zip(row.get("channels_left_out") or (), row.get("left_out_reasons") or (), strict=False)
        told = {channel["channel"]: channel for channel in health("channels") or ()}
        channels = [
            {**told.get(name, {"channel": name}), "in_use": name not in reasons, "reason": reasons.get(name)}
            for name in dict.fromkeys([*(self._known.get("channels") or ()), *told, *reasons])
        ]
        return {
            "channels": (channels, _many(described(_CHANNEL)), "Of the latest span of data."),
            "t_ns": (health("t_ns"), _INTEGER, "Data until."),
            "delay_s": (health("delay_s"), _NUMBER, "Clock less time of the data, s."),
            **{key: (health(key), _OBJECT, "") for key in ("stream", "source", "recorder", "refused")},
            "quality": (self._summary.get("quality"), _OBJECT, "As in summary.json."),
        }

    def published(self) -> tuple[Assessment, dict[str, Any]]:
        """Return what the page shows (`publish.live_sheet`) beside the windows, status and sensors."""
        with self._lock:
            is_as_told = self._shown.state is self._assessment.state
            since_ns = self._since_ns if is_as_told else (self._last["latest"] or {}).get("t_end_ns")
            content = {"summary": self._summary, "since_ns": since_ns}
            lists = {"events": list(self._events.values()), "findings": list(self._findings.values())}
            return self._shown, content | lists

    @property
    def _shown(self) -> Assessment:
        return outdated(self._assessment, "the monitor is silent") if self._is_silent else self._assessment

    @property
    def _is_silent(self) -> bool:
        return self._clock() - self._heard_s > _SILENT_S

    @property
    def _known(self) -> Mapping[str, Any]:
        return self._summary.get("known") or {}

    def _touch(self, *names: str) -> None:
        """Count a change of these endpoints' answers, and of the status, which tells it."""
        for name in ("status", *names):
            self._revisions[name] += 1


def _json(value: Any) -> bytes:
    """Write JSON; of a list of bytes each is JSON already."""
    if isinstance(value, list) and value and isinstance(value[0], bytes):
        return b"[" + b",".join(value) + b"]"
    return json.dumps(value, separators=(",", ":"), allow_nan=False).encode()


def latest_windows(out: Path, keep: Keep = KEEP) -> Iterator[dict[str, Any]]:
    """Read the latest windows that an output folder holds, oldest first; what is damaged is left out.

    Read are the end of results.jsonl and, where it holds less than `Keep.read` windows, of the last closed month.  Of more
    than so many the latest half is given, and of the older ones every k-th.
    """
    rows = tail_lines(out / "results.jsonl", keep.tail_bytes)
    closed = closed_files(out)[-1:]
    if len(rows) < keep.read and closed:
        with suppress(OSError, BadInputError):
            packed = closed[0].suffix == ".zst"
            before = deque(read_lines(closed[0]), keep.packed) if packed else tail_lines(closed[0], keep.tail_bytes)
            rows = [*before, *rows]
    half = keep.read // 2
    newest, older = rows[-half:], rows[:-half]
    for row in (*older[:: math.ceil(len(older) / half) or 1], *newest):
        try:
            yield read_line(row)
        except ValueError:
            continue


def latest_events(out: Path, keep: Keep = KEEP) -> Iterator[dict[str, Any]]:
    """Read the lines of events.jsonl in an output folder; what is damaged is left out."""
    for row in tail_lines(out / EVENTS, keep.tail_bytes):
        try:
            line = parse_json(row)
        except ValueError:
            continue
        if isinstance(line, dict) and isinstance(line.get("id"), str) and isinstance(line.get("t_begin_ns"), int):
            yield line


def _window(line: Mapping[str, Any]) -> dict[str, Any]:
    """Take from a line of results.jsonl what the page shows, with `_DIGITS` significant digits; a skipped window is short."""
    alarm = line.get("alarm") or {}
    kept = {shown.key: line.get(shown.key) for shown in SHOWN}
    kept["covariates"] = kept["covariates"] or {}
    if line["skipped"]:
        kept = {key: value for key, value in kept.items() if value not in (None, [])}
    lists = {key: alarm.get(key) or [] for key in ("stories", "changed")}
    return {**rounded(kept, _DIGITS), "level": alarm.get("level"), **lists}


def _revision(line: Mapping[str, Any]) -> int:
    """Return the revision of an event's line; -1 of the preliminary message."""
    return -1 if line.get("revision") is None else int(line["revision"])


def _latest(items: dict[Any, dict[str, Any]], time_key: str, most: int) -> dict[Any, dict[str, Any]]:
    """Keep the latest items, at most so many, the newest first."""
    newest = sorted(items.items(), key=lambda item: item[1].get(time_key) or 0, reverse=True)
    return dict(newest[:most])
