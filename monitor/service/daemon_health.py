"""How the daemon itself fares, as lines of health.jsonl: here alone the wall clock is held against the data's time."""

from __future__ import annotations

import math
import shutil
import statistics
import time
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

from drivers.base import ACCELERATION, SampleBlock
from drivers.recorder import RecorderHealth
from monitor.service.threads import Reader

LATENCY_MS = (5, 10, 20, 50, 100, 200, 500, 1000)
"""Upper edges of the histogram's bins; one more holds the rest."""
_RECENT = 1000
"""Windows that the median is of."""
_MOST_TEXT = 300


class Way(Protocol):
    """A way out."""

    @property
    def failed(self) -> str | None:
        """Why it is blocked; None or empty while all is well."""

    @property
    def dropped(self) -> int:
        """How much found no room on it since the start."""


class Vitals:
    """Counts since the daemon began; `out` is where results go."""

    def __init__(self, out: Path) -> None:
        self._out, self._begun_s = out, time.monotonic()
        self.refused = 0
        """Blocks that neither the recorder nor the pipeline could take."""
        self.refusal = ""
        """The latest reason."""
        self.unprocessed = 0
        """Blocks that shutting down left no time for."""
        self._bins = [0] * (len(LATENCY_MS) + 1)
        self._latest_ms = self._most_ms = 0.0
        self._recent_ms: deque[float] = deque(maxlen=_RECENT)
        self._delay_s: float | None = None

    def refuse(self, reason: str) -> None:
        """A block was turned away."""
        self.refused += 1
        self.refusal = reason[:_MOST_TEXT]

    def received(self, block: SampleBlock) -> None:
        """A block was taken from the queue."""
        if block.topic == ACCELERATION:
            self._delay_s = time.time() - block.t_ns * 1e-9 - block.n_samples / block.sample_rate_hz

    def published(self, arrived_s: float) -> None:
        """A window's line is written; its last sample came at `arrived_s` (monotonic)."""
        ms = self._latest_ms = 1e3 * (time.monotonic() - arrived_s)
        self._most_ms = max(self._most_ms, ms)
        self._recent_ms.append(ms)
        self._bins[sum(ms > edge for edge in LATENCY_MS)] += 1

    def latency(self) -> dict[str, Any]:
        """Milliseconds from the arrival of a window's last sample to its published line."""
        names = (*(f"<= {edge}" for edge in LATENCY_MS), f"> {LATENCY_MS[-1]}")
        counts = dict(zip(names, self._bins, strict=True))
        median = statistics.median(self._recent_ms) if self._recent_ms else 0.0
        said = {"latest": self._latest_ms, "median": median, "max": self._most_ms}
        return {**{name: round(ms, 2) for name, ms in said.items()}, "windows": counts}

    def line(
        self,
        span: Mapping[str, Any] | None,
        reader: Reader,
        recorder: RecorderHealth | None,
        ways: Iterable[tuple[str, Way]],
    ) -> dict[str, Any]:
        """A line of health.jsonl; `span` is a `Health` made plain, None when no data came."""
        ways = list(ways)
        source = reader.source.health()
        stream = dict(span or {})
        channels = stream.pop("channels", [])
        own: dict[str, Any] = plain(
            {
                "wall_ns": time.time_ns(),
                "source": {
                    "connected": source.connected,
                    "detail": source.detail,
                    "counts": dict(source.counts),
                    "clocks": source.clocks,
                    "lost": reader.lost,
                    "error": reader.error,
                },
                "delay_s": self._delay_s,
                "refused": {"blocks": self.refused, "latest": self.refusal},
                "queue": len(reader.queue),
                "uptime_s": time.monotonic() - self._begun_s,
                "disk_free_bytes": _free(self._out),
                "latency_ms": self.latency(),
                "recorder": recorder,
                "failed": failures(ways),
                "lost": losses(ways),
            }
        )
        return {"t_ns": stream.get("t_end_ns"), "stream": stream or None, "channels": channels, **own}


def failures(ways: Iterable[tuple[str, Way]]) -> dict[str, str]:
    """Which ways out are blocked, and why."""
    return {name: way.failed for name, way in ways if way.failed}


def losses(ways: Iterable[tuple[str, Way]]) -> dict[str, int]:
    """How much found no room on its way out since the start, of each that lost anything."""
    return {name: way.dropped for name, way in ways if way.dropped}


def _free(place: Path) -> int | None:
    try:
        return shutil.disk_usage(place).free
    except OSError:
        return None


@lru_cache
def _names(kind: Any) -> tuple[str, ...]:
    return tuple(f.name for f in fields(kind))


def plain(value: Any) -> Any:
    """The same as strict JSON can say it: None for what is not finite, a dictionary for a dataclass."""
    if is_dataclass(value):
        return {name: plain(getattr(value, name)) for name in _names(value.__class__)}
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, float):
        return float(f"{value:.9g}") if math.isfinite(value) else None
    return value
