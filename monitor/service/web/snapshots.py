"""What the web page shows: the latest results, bounded in number, and their JSON.

Nothing here asks the pipeline: results, states and health come as they are published, the past from the output folder.
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
from itertools import islice
from operator import itemgetter
from pathlib import Path
from typing import Any

from monitor import __version__
from monitor.core import BadInputError, parse_json, rounded, tail_lines
from monitor.damage import Assessment, State, outdated
from monitor.publish import EVENTS, SHOWN, closed_files, read_line, read_lines
from monitor.service.status import troubles_of

_ALARMS = ("alarms", "event_alarms")
"""Keys of summary.json: alarms of stories, and those of events. [names]"""
DEFAULT_LIMIT = 500
"""Number of windows in an answer where the request names none. [1; judgement: about the points that a chart can show]"""
MOST_IN_ANSWER = 2_000
"""Largest number of windows in an answer. [1; cost: about 1 MB, and 25 ms to compress it]"""
_DIGITS = 6
"""Significant digits of the numbers of windows. [1; judgement: finer than any interval]"""
_SILENT_S = 60.0
"""Age of the latest health line beyond which a daemon counts as silent; one is written at least every 10 s."""

_WINDOW_KEYS = tuple(field.key for field in SHOWN)
"""Keys of a window; besides there are `level`, `stories` and `changed` of the alarm. [none; definition]"""
FINDING_KEYS = ("id", "t_ns", "from_ns", "reason", "verdict", "says", "causes")
"""Keys of a finding. [none; definition]"""
_BULKY = ("floors", "ground", "spectrum")
"""Keys of an event that events.jsonl alone has. [none; cost]"""


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
    """JSON of an endpoint."""

    body: bytes
    etag: str
    """Changes whenever the body does."""


class Snapshots:
    """Keep what was published last, and write it as JSON; any thread may call any method."""

    def __init__(self, site: str, clock: Callable[[], float] = time.monotonic, keep: Keep = KEEP) -> None:
        self._site, self._clock, self._keep = site, clock, keep
        self._lock = threading.Lock()
        self._begun = time.time_ns()  # in every tag, so that none of an earlier run is taken for one of this run
        self._revisions = dict.fromkeys(("status", "windows", "events", "findings", "alarms", "sensors"), 0)
        self._assessment = Assessment(State.NOT_JUDGED, "No window of data yet.")
        self._since_ns: int | None = None
        self._windows: list[tuple[int, bytes]] = []
        self._latest: dict[str, Any] | None = None
        self._judged: dict[str, Any] | None = None
        self._events: dict[str, dict[str, Any]] = {}
        self._findings: dict[tuple[Any, Any], dict[str, Any]] = {}
        self._summary: Mapping[str, Any] = {}
        self._health: Mapping[str, Any] | None = None
        self._channels: list[dict[str, Any]] = []
        self._heard_s: float | None = None

    def state(self, assessment: Assessment) -> None:
        """Keep the present state of the structure."""
        with self._lock:
            if assessment.state is not self._assessment.state:
                self._since_ns = None if self._latest is None else self._latest["t_end_ns"]
            self._assessment = assessment
            self._touch("status")

    def window(self, line: Mapping[str, Any]) -> None:
        """Keep a window, given as its line of results.jsonl."""
        self.windows_before([line])
        with self._lock:
            if self._latest is None or line["t_end_ns"] >= self._latest["t_end_ns"]:
                self._latest = _window(line)
                self._judged = self._judged if line["skipped"] else self._latest
            self._touch("status", "sensors")

    def windows_before(self, lines: Iterable[Mapping[str, Any]]) -> None:
        """Keep windows in the order of their times, whenever they come."""
        for line in lines:
            row = line["t_end_ns"], json.dumps(_window(line), separators=(",", ":"), allow_nan=False).encode()
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
        place, brief = (finding.get("t_ns"), finding.get("from_ns")), {key: finding.get(key) for key in FINDING_KEYS}
        with self._lock:
            if self._findings.get(place) != brief:
                self._findings = _latest({**self._findings, place: brief}, "t_ns", self._keep.items)
                self._touch("findings")

    def health(self, line: Mapping[str, Any]) -> None:
        """Keep a line of health.jsonl; the sensors' part of it until the next span of data ends."""
        with self._lock:
            self._health, self._heard_s = line, self._clock()
            if line.get("channels"):
                self._channels = list(line["channels"])
            self._touch("status", "sensors")

    def summary(self, content: Mapping[str, Any]) -> None:
        """Keep the content of summary.json."""
        for finding in content.get("findings") or ():
            self.finding(finding)
        with self._lock:
            if any(content.get(key) != self._summary.get(key) for key in _ALARMS):
                self._touch("alarms")
            self._summary = content
            self._touch("status", "sensors")

    def status_answer(self) -> Answer:
        """Write the state of the structure and of the monitor, and with `revisions` which other endpoints changed."""
        with self._lock:
            silent = self._silent()
            health, known = self._health or {}, self._summary.get("known") or {}
            content = {
                "site": self._site,
                "version": __version__,
                "begun_ns": self._begun,
                **self._shown().content,
                "monitor": "starting" if not health else "silent" if silent else "running",
                "troubles": troubles_of(health),
                **{key: health.get(key) for key in ("t_ns", "data_age_s", "uptime_s", "disk_free_bytes")},
                **{key: self._summary.get(key) for key in ("windows", "skipped", "alarm")},
                "stories": list(known.get("names") or ()),
                **{key: known.get(key) for key in ("has_baseline", "alarm_loss")},
                "latest": self._latest,
                "judged": self._judged,
                "revisions": dict(self._revisions),
            }
            return self._answer("status", content, f"-{int(silent)}")

    def windows_answer(self, since_ns: int | None, limit: int) -> Answer:
        """Write the windows that end after `since_ns`, oldest first; of more than `limit` evenly spaced ones with the latest."""
        with self._lock:
            first = 0 if since_ns is None else bisect_right(self._windows, since_ns, key=itemgetter(0))
            rows = self._windows[first:]
            etag = self._etag("windows", "")
        matched = len(rows)
        if matched > limit:
            rows = [rows[matched - 1 - (k * matched) // limit] for k in reversed(range(limit))]
        head = f'{{"matched":{matched},"windows":['.encode()
        return Answer(head + b",".join(text for _, text in rows) + b"]}", etag)

    def events_answer(self) -> Answer:
        """Write the latest events, the newest first."""
        with self._lock:
            brief = [{key: v for key, v in e.items() if key not in _BULKY} for e in self._events.values()]
            return self._answer("events", {"events": brief})

    def findings_answer(self) -> Answer:
        """Write the latest findings, the newest first."""
        with self._lock:
            return self._answer("findings", {"findings": list(self._findings.values())})

    def alarms_answer(self) -> Answer:
        """Write the latest alarm episodes, and alarms of events, the newest first."""
        with self._lock:
            newest = {key: reversed(self._summary.get(key) or ()) for key in _ALARMS}
            return self._answer("alarms", {key: list(islice(of, self._keep.items)) for key, of in newest.items()})

    def sensors_answer(self) -> Answer:
        """Write the sensors' health in the latest span of data, and of the stream, the source and the recorder."""
        with self._lock:
            row, health = self._latest or {}, self._health or {}
            reasons = dict.fromkeys((self._summary.get("known") or {}).get("aside") or (), "enters no estimate")
            reasons |= zip(row.get("channels_left_out") or (), row.get("left_out_reasons") or (), strict=False)
            told = {channel["channel"]: channel for channel in self._channels}
            names = dict.fromkeys([*((self._summary.get("known") or {}).get("channels") or ()), *told, *reasons])
            channels = [
                {**told.get(name, {"channel": name}), "in_use": name not in reasons, "reason": reasons.get(name)}
                for name in names
            ]
            parts = {key: health.get(key) for key in ("t_ns", "stream", "source", "recorder", "refused", "delay_s")}
            return self._answer("sensors", {"channels": channels, **parts, "quality": self._summary.get("quality")})

    def published(self) -> tuple[Assessment, dict[str, Any]]:
        """Return what the page shows (`publish.live_sheet`) beside the windows, status and sensors."""
        with self._lock:
            content = {"summary": self._summary, "since_ns": self._since_ns}
            lists = {"events": list(self._events.values()), "findings": list(self._findings.values())}
            return self._shown(), content | lists

    def _shown(self) -> Assessment:
        """Return the state, outdated where the daemon is silent."""
        return outdated(self._assessment, "the monitor is silent") if self._silent() else self._assessment

    def _silent(self) -> bool:
        return self._heard_s is not None and self._clock() - self._heard_s > _SILENT_S

    def _touch(self, *names: str) -> None:
        for name in names:
            self._revisions[name] += 1

    def _etag(self, name: str, more: str) -> str:
        return f'"{self._begun:x}-{name}-{self._revisions[name]}{more}"'

    def _answer(self, name: str, content: Mapping[str, Any], more: str = "") -> Answer:
        text = json.dumps(content, separators=(",", ":"), allow_nan=False)
        return Answer(text.encode(), self._etag(name, more))


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
    kept = {key: line.get(key) for key in _WINDOW_KEYS}
    kept["covariates"] = kept["covariates"] or {}
    if line["skipped"]:
        kept = {key: value for key, value in kept.items() if value not in (None, [])}
    lists = {key: alarm.get(key) or [] for key in ("stories", "changed")}
    return {**rounded(kept, _DIGITS), "level": alarm.get("level"), **lists}


def _revision(line: Mapping[str, Any]) -> int:
    """Return the revision of an event's line; -1 of the preliminary message."""
    revision = line.get("revision")
    return revision if isinstance(revision, int) else -1


def _latest(items: dict[Any, dict[str, Any]], time_key: str, most: int) -> dict[Any, dict[str, Any]]:
    """Keep the latest items, at most so many, the newest first."""
    newest = sorted(items.items(), key=lambda item: item[1].get(time_key) or 0, reverse=True)
    return dict(newest[:most])
