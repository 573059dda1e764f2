"""What the product says of readings and pairs at its own limit, and at one that is moved: by its public functions."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from inspect import signature
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from drivers.base import ACCELERATION
from drivers.mcap_file import McapWriter
from monitor.config import Configuration
from monitor.core import Array, BadInputError, Level, WindowResult
from monitor.damage import FeatureTable, ModalBaseline, judge_features
from monitor.pipeline import Pipeline
from monitor.runs import calibrate, compare, cut_into_blocks

_RATE = "false_announcements_per_year"
_RATE_LIMITS, _RATE_STEPS = (1e-8, 1e4), 12
"""Years a false announcement, between which a limit is looked for, and halvings. [years, 1; choice: from one a third of a
second]"""
HOP = 8
"""Windows of `modal` that begin in one window's length. [1; choice]"""
T0_NS = 1_800_000_000_000_000_000
Flags = Annotated[NDArray[np.bool_], "w"]


class Features:
    """Later readings of a series, judged by `features`; nothing is judged where it refuses.

    A limit is the years in which a healthy structure shows as much once.
    """

    steps, limits = _RATE_STEPS, _RATE_LIMITS

    def __init__(self, table: FeatureTable, learned_until_ns: int, is_changed: Flags) -> None:
        self.is_changed = is_changed
        try:
            self.verdicts = judge_features(table, learned_until_ns)[1]
        except BadInputError:
            self.verdicts = []

    def announced(self, limit: float | None) -> Flags:
        """Tell at which readings there is a warning."""
        if not self.verdicts:
            return np.zeros(self.is_changed.size, dtype=bool)
        if limit is None:
            return np.array([v.skipped is None and v.alarm.level.rank >= Level.WARNING.rank for v in self.verdicts])
        return np.array([v.features is not None and v.features.years >= limit for v in self.verdicts])

    def healthy(self, limit: float | None = None) -> Flags:
        return self.announced(limit)[~self.is_changed]

    def changed(self, limit: float | None = None) -> Flags:
        return self.announced(limit)[self.is_changed]

    def unjudged(self) -> int:
        return sum(v.skipped is not None for v in self.verdicts) if self.verdicts else self.is_changed.size


@dataclass(frozen=True, eq=False)
class Record:
    """Pieces of recordings."""

    rate_hz: float
    window_s: float
    learned: Sequence[Array]
    healthy: Sequence[Array]
    changed: Sequence[Array]

    def windows(self, n: int) -> list[slice]:
        """List the samples of the windows that a piece of n samples has."""
        size = round(self.window_s * self.rate_hz)
        return [slice(start, start + size) for start in range(0, n - size + 1, size // HOP)]

    def site(self, limit: float | None) -> Configuration:
        """Form the site's configuration; `limit` is years a false announcement."""
        return Configuration.model_validate(
            {
                "structure": {"kind": "modal"},
                "sensors": [{"channel": f"a{j + 1}"} for j in range(self.learned[0].shape[1])],
                "processing": {
                    "rate_hz": self.rate_hz,
                    "cutoff_hz": 0.4 * self.rate_hz,
                    "window_s": self.window_s,
                    "hop_s": self.window_s / HOP,
                },
                "alarm": {} if limit is None else {_RATE: 1.0 / limit},
            }
        )


class Modes:
    """Windows of recordings, judged by `modal`: a baseline of the learned pieces, each later piece replayed."""

    steps, limits = _RATE_STEPS, _RATE_LIMITS

    def __init__(self, record: Record) -> None:
        self.record = record
        try:
            self.baseline: ModalBaseline | None = _calibrated(record)
        except BadInputError:
            self.baseline = None
        self._healthy: dict[float | None, list[bool | None]] = {}
        self._changed: dict[float | None, list[bool | None]] = {}

    def beside(self, changed: Sequence[Array]) -> Modes:
        """Judge other changed pieces by the same baseline, beside the same healthy ones."""
        out = copy(self)
        out.record, out._changed = replace(self.record, changed=changed), {}
        return out

    def healthy(self, limit: float | None = None) -> Flags:
        return np.array([said is True for said in self._told(self._healthy, self.record.healthy, limit)])

    def changed(self, limit: float | None = None) -> Flags:
        return np.array([said is True for said in self._told(self._changed, self.record.changed, limit)])

    def unjudged(self) -> int:
        told = self._told(self._healthy, self.record.healthy, None) + self._told(
            self._changed, self.record.changed, None
        )
        return told.count(None)

    def _told(
        self, known: dict[float | None, list[bool | None]], pieces: Sequence[Array], limit: float | None
    ) -> list[bool | None]:
        """Tell at which windows anything is announced, None of one that does not come or is skipped; each is made once."""
        if limit not in known:
            known[limit] = []
            for piece in pieces:
                due = self.record.windows(len(piece))
                windows = [] if self.baseline is None else self._replayed(piece, limit, self.baseline)[: len(due)]
                known[limit] += [None if w.skipped else w.alarm.level is not Level.NORMAL for w in windows]
                known[limit] += [None] * (len(due) - len(windows))
        return known[limit]

    def _replayed(self, piece: Array, limit: float | None, baseline: ModalBaseline) -> list[WindowResult]:
        pipeline = Pipeline(self.record.site(limit), baseline)
        blocks = cut_into_blocks(ACCELERATION, piece, pipeline.config.channels, self.record.rate_hz, T0_NS, 10_000)
        return [r for block in blocks for r in pipeline.push(block) if isinstance(r, WindowResult)]


def _calibrated(record: Record) -> ModalBaseline:
    with tempfile.TemporaryDirectory() as folder:
        paths = [
            _written(
                Path(folder) / f"{n}.mcap", piece, record.rate_hz, T0_NS - (len(record.learned) - n) * 3_600_000_000_000
            )
            for n, piece in enumerate(record.learned)
        ]
        return calibrate.calibrate_modes(paths, record.site(None))


def _written(path: Path, piece: Array, rate_hz: float, t0_ns: int) -> Path:
    """Write samples as a recording."""
    names = tuple(f"a{j + 1}" for j in range(piece.shape[1]))
    with McapWriter(path) as writer:
        for block in cut_into_blocks(ACCELERATION, piece, names, rate_hz, t0_ns, 10_000):
            writer.write(block)
    return path


TAKES_HEALTHY = "healthy" in signature(compare.compare).parameters
"""Whether `compare` takes more records of one state."""


def statistic_of_pair(a: Array, b: Array, rate_hz: float, healthy: Sequence[Array] = ()) -> float:
    """Compare two records by `compare`; return what it differs by, over its limit, NaN where it cannot say."""
    with tempfile.TemporaryDirectory() as folder:
        paths = [_written(Path(folder) / f"{n}.mcap", x, rate_hz, T0_NS) for n, x in enumerate((a, b, *healthy))]
        try:
            content = compare.compare(*paths[:2], **({"healthy": paths[2:]} if healthy else {}))
        except BadInputError:
            return float("nan")
    if "chance" in content:
        return (
            float("nan")
            if content["chance"] is None
            else (1.0 + 1e-9) * content["rate"] / max(content["chance"], 1e-12)
        )
    return max((abs(test["z"]) / content["limit"] for test in content["tests"]), default=0.0)
