"""Health of the daemon itself, as lines of health.jsonl.

This is the only module of the monitor that compares the wall clock with the time of the data; a live source may bound its data by
the clock (`drivers.live`).
"""

from __future__ import annotations

import json
import logging
import math
import shutil
import statistics
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drivers.base import ACCELERATION, SampleBlock, SourceHealth
from drivers.recent import Recent
from drivers.recorder import RecorderHealth
from monitor.core import utc
from monitor.service.appended_lines import AppendedLines
from monitor.service.boot import boot_time
from monitor.service.component import Way
from monitor.service.threads import Chores, Reader

if TYPE_CHECKING:
    from monitor.service.publication import Publication
    from monitor.service.request_handler import RequestHandler

_log = logging.getLogger(__name__)

LATENCY_MS = (5, 10, 20, 50, 100, 200, 500, 1000)
"""Upper edges of the bins of the latency histogram; one more bin holds the rest. [ms]"""
_RECENT = 1000
"""Number of latest windows over which the median latency is taken."""
_MOST_TEXT = 300
_STARTING = "the monitor is starting"
_CHECK_S = 1.0
"""Interval at which the outputs are asked whether they fail, so that a line of health tells a failure soon. [s; judgement]"""


class Vitals:
    """Counters and latencies of the daemon since its start, and the free space of the disk of its output folder."""

    def __init__(self, out: Path) -> None:
        self._out, self._begun_s = out, time.monotonic()
        self._free_bytes: int | None = None
        self.refused = 0
        """Number of blocks that neither the recorder nor the pipeline could accept."""
        self.refusal = ""
        self._recent = Recent()
        self.unprocessed = 0
        """Number of blocks for which shutting down left no time."""
        self._bins = [0] * (len(LATENCY_MS) + 1)
        self._latest_ms = self._most_ms = 0.0
        self._recent_ms: deque[float] = deque(maxlen=_RECENT)
        self._delay_s: float | None = None
        self._away_ns: int | None = None

    def look_at_disk(self) -> None:
        """Measure the free space of the disk, for the next line (in a thread that may wait for the disk)."""
        try:
            self._free_bytes = shutil.disk_usage(self._out).free
        except OSError:
            self._free_bytes = None

    def refuse(self, reason: str) -> None:
        """Count a refused block, and tell why."""
        self.refused += 1
        self.refusal = reason[:_MOST_TEXT]
        self._recent.tell(f"a block is refused, {self.refused} so far: {reason}")

    def received(self, block: SampleBlock) -> None:
        """Note the delay of a block that was taken from the queue: wall clock less the time of its last sample."""
        if block.topic == ACCELERATION:
            self._delay_s = time.time() - block.t_ns * 1e-9 - block.n_samples / block.sample_rate_hz

    def published(self, arrived_s: float) -> None:
        """Note the latency of a published window, whose last sample arrived at `arrived_s` (monotonic clock, s)."""
        ms = self._latest_ms = 1e3 * (time.monotonic() - arrived_s)
        self._most_ms = max(self._most_ms, ms)
        self._recent_ms.append(ms)
        self._bins[sum(ms > edge for edge in LATENCY_MS)] += 1

    def latency(self) -> dict[str, Any]:
        """Summarize the latency from the arrival of a window's last sample to its published line, ms."""
        names = (*(f"<= {edge}" for edge in LATENCY_MS), f"> {LATENCY_MS[-1]}")
        counts = dict(zip(names, self._bins, strict=True))
        median = statistics.median(self._recent_ms) if self._recent_ms else 0.0
        values = {"latest": self._latest_ms, "median": median, "max": self._most_ms}
        return {**{name: round(ms, 2) for name, ms in values.items()}, "windows": counts}

    def line(
        self,
        span: Mapping[str, Any] | None,
        reader: Reader | None,
        recorder: RecorderHealth | None,
        ways: Iterable[tuple[str, Way]],
    ) -> dict[str, Any]:
        """Build a line of health.jsonl.

        The span's sensors' health comes as plain values, None where no data arrived; there is no reader while the daemon
        starts, and no recorder where nothing is recorded.
        """
        ways = list(ways)
        boot_id, boot_s = boot_time()
        stream = dict(span or {})
        channels = stream.pop("channels", [])
        own: dict[str, Any] = plain(
            {
                "wall_ns": time.time_ns(),
                "boot_id": boot_id,
                "boot_s": boot_s,
                "source": self._source(reader),
                "delay_s": self._delay_s,
                "refused": {"blocks": self.refused, "latest": self.refusal},
                "queue": 0 if reader is None else len(reader.queue),
                "uptime_s": time.monotonic() - self._begun_s,
                "disk_free_bytes": self._free_bytes,
                "latency_ms": self.latency(),
                "recorder": recorder,
                "failed": failures(ways),
                "lost": losses(ways),
            }
        )
        return {"t_ns": stream.get("t_end_ns"), "stream": stream or None, "channels": channels, **own}

    def _source(self, reader: Reader | None) -> dict[str, Any]:
        """Describe the source: what its driver counts, since when it is away, when it is tried again, and all that in words."""
        health = SourceHealth(False, {}) if reader is None else reader.source.health()
        ended = reader is not None and reader.ended
        lost = 0 if reader is None else reader.lost + health.counts.get("links_lost", 0)
        is_starting = reader is None or not (reader.opened or lost or ended or health.connected)
        self._away_ns = None if health.connected or ended else self._away_ns or time.time_ns()
        source = {
            "connected": health.connected,
            "detail": health.detail,
            "trouble": health.trouble or self._recent.latest,
            "counts": dict(health.counts),
            "clocks": health.clocks,
            "lost": lost,
            "error": _STARTING if reader is None or is_starting else reader.error,
            "ended": ended,
            "away_since_ns": self._away_ns,
            "next_try_s": None if reader is None else reader.next_try_s,
        }
        return {**source, "says": _STARTING if is_starting else source_words(source)}


def source_words(source: Mapping[str, Any]) -> str:
    """Say whether a source is connected, and of one that is away since when, why, and when it is tried again.

    Examples
    --------
    >>> source_words({"error": "connection refused", "away_since_ns": 0, "next_try_s": 8.0, "lost": 3})
    'lost since 1970-01-01 00:00:00 UTC (connection refused); tried again in 8 s; 3 times lost'
    """
    if source.get("ended"):
        return "read to its end"
    lost = source.get("lost", 0)
    times = "1 time" if lost == 1 else f"{lost} times"
    if source.get("connected"):
        return f"connected, lost {times}"
    since_ns, next_s = source.get("away_since_ns"), source.get("next_try_s")
    since = "" if since_ns is None else f" since {utc(since_ns, seconds=True)} UTC"
    again = "it is tried again" if next_s is None else f"tried again in {next_s:.0f} s"
    why = source.get("error") or source.get("detail") or "not connected"
    return f"lost{since} ({why}); {again}; {times} lost"


class HealthLines:
    """Lines of health.jsonl: at least every `quiet_s`, and when a part fails or the age of the data changes the state.

    Until `begin` is called they say that the site starts.
    """

    name = "health.jsonl"

    def __init__(
        self, file: AppendedLines, vitals: Vitals, chores: Chores, clock: Callable[[], float], quiet_s: float
    ) -> None:
        self.way, self._vitals, self._chores, self._clock, self.quiet_s = file, vitals, chores, clock, quiet_s
        self._publication: Publication | None = None
        self._told_s = self._checked_s = clock()
        self._failed: set[str] = set()
        self._was_late = False

    def begin(
        self, publication: Publication, requests: RequestHandler, ways: Callable[[], Sequence[tuple[str, Way]]]
    ) -> None:
        """Tell from now on of a site that runs; `ways` lists every part that may be blocked, with its name."""
        self._publication, self._requests, self._ways = publication, requests, ways

    def tell_start(self) -> None:
        """Write a line that says that the daemon starts."""
        self._told_s = self._clock()
        self.way.write(json.dumps(self._vitals.line(None, None, None, ()), allow_nan=False))

    def step(self, now: float) -> None:
        """Write and publish a line if one is due at `now`, s."""
        assert self._publication is not None
        is_late = self._publication.evaluation.is_late
        if is_late != self._was_late or now - self._told_s >= self.quiet_s or self._failures_changed(now):
            self._was_late = is_late
            self.tell(None)

    def close(self, timeout_s: float) -> None:
        """Write the last line."""
        self.tell(None)

    def tell(self, span: dict[str, Any] | None) -> None:
        """Write and publish a line, with the sensors' health of a span if one ended."""
        if (publication := self._publication) is None:
            if self._clock() - self._told_s >= self.quiet_s:
                self.tell_start()
            return
        evaluation = publication.evaluation
        publication.publish_state()
        self._told_s = self._checked_s = self._clock()
        self._chores.do("free space", self._vitals.look_at_disk)
        line = self._vitals.line(span, evaluation.reader, publication.files.recording.health(), self._ways())
        line |= {"ledger_head": self._requests.head, "data_age_s": evaluation.age_s}
        line["web"] = next((outlet.url for outlet in publication.outlets if outlet.url), None)
        for name in line["failed"].keys() - self._failed:
            _log.warning("blocked: %s: %s", name, line["failed"][name])
        self._failed = set(line["failed"])
        self.way.write(json.dumps(line, allow_nan=False))
        for outlet in publication.outlets:
            outlet.health_line(line)

    def _failures_changed(self, now: float) -> bool:
        """Return whether other parts fail than the latest line says; they are asked every `_CHECK_S`."""
        if now - self._checked_s < _CHECK_S:
            return False
        self._checked_s = now
        return failures(self._ways()).keys() != self._failed


def failures(ways: Iterable[tuple[str, Way]]) -> dict[str, str]:
    """Return the reason for each output that is blocked."""
    return {name: way.failed for name, way in ways if way.failed}


def losses(ways: Iterable[tuple[str, Way]]) -> dict[str, int]:
    """Return the number of lost items for each output that lost any since the start."""
    return {name: way.dropped for name, way in ways if way.dropped}


@lru_cache
def _field_names(kind: Any) -> tuple[str, ...]:
    return tuple(f.name for f in fields(kind))


def plain(value: Any) -> Any:
    """Convert a value to what strict JSON can express: None for a number that is not finite, a dictionary for a dataclass.

    Other floats are rounded to nine significant digits.
    """
    if value is None or isinstance(value, str | int):  # most values: a host converts lines of hundreds of sites
        return value
    if isinstance(value, float):
        return float(f"{value:.9g}") if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if is_dataclass(value):
        return {name: plain(getattr(value, name)) for name in _field_names(value.__class__)}
    return value
