"""Converts the frames of CAN nodes to rows of samples, and joins several nodes on one sample index.  No I/O.

Nodes that sample by clocks of their own are joined sample by sample, without interpolation.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from drivers import clock
from drivers.base import ClockHealth, Ints, SourceError
from drivers.clock import ClockState, Timeline
from drivers.counter import Contents, Sequencer
from drivers.frames import Layout

Samples = NDArray[np.float32]
Rows = tuple[Annotated[Ints, "n"], Annotated[Samples, "n channels"]]
"""Increasing sample indices, and samples, m/s^2."""

HOLD_S = 1.0
"""Longest wait for a node that lags, s of data; beyond it, the node's samples are missing."""
WARM_S = 3
"""Seconds of data before the nodes are aligned."""
_MARGIN = 0.25
"""Lag beyond half a sample, in samples, that nodes once aligned may reach before they are aligned again."""
_MAX_T_S = 4e9
"""Timestamps from here on, s since 1970, are not used."""


@dataclass(slots=True)
class Node:
    """Decoder of the frames of one node: raw frames in, rows of samples out."""

    layout: Layout
    rate_hz: float
    counts_frames: bool
    frames: list[bytes] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    clock: ClockState = field(default_factory=ClockState)
    line: Timeline | None = None
    """UTC of the node's sample indices; None before the first timestamp."""
    untimed: int = 0
    """Number of frames before the first one with a timestamp."""
    bad_times: int = 0
    """Number of frames whose timestamp cannot be used."""
    sequencer: Sequencer = field(init=False)
    _factor: int = field(init=False)
    _next: int | None = None
    _held: Rows = field(init=False)

    def __post_init__(self) -> None:
        by_frame = self.counts_frames or not self.layout.counter_bits
        self.sequencer = Sequencer(self.layout.counter_bits, 1 if by_frame else self.layout.n_samples)
        self._factor = self.layout.n_samples if by_frame else 1
        self._held = _no_rows(self.layout.n_samples, len(self.layout.channels))

    def take(self, *, everything: bool = False) -> Rows:
        """Return the rows that are in order now; with `everything`, all rows, because no frame will follow."""
        if self.frames:
            frames, times = b"".join(self.frames), np.array(self.times, dtype=np.float64)
            self.frames, self.times = [], []
            samples, counters = self.layout.decode(frames)
            contents = np.frombuffer(frames, dtype=f"S{self.layout.n_bytes}")
            self._add(samples.reshape(len(times), self.layout.n_samples, -1), counters, times, contents)
        self.sequencer.ended |= everything
        return self._release(everything)

    def _add(
        self,
        samples: Annotated[Samples, "frames n_samples channels"],
        counters: Annotated[Ints, "frames"],
        times: Annotated[NDArray[np.float64], "frames"],
        contents: Annotated[Contents, "frames"],
    ) -> None:
        """Number the frames and keep the new ones."""
        timed = (times >= 0) & (times < _MAX_T_S)  # false for NaN
        self.bad_times += int(np.count_nonzero(~timed))
        times = np.where(timed, times, np.nan)
        if self.line is None:
            first = int(np.argmax(timed)) if timed.any() else len(timed)
            self.untimed += first
            samples, counters, times, timed = samples[first:], counters[first:], times[first:], timed[first:]
            contents = contents[first:]
            if not len(times):
                return
        rate = self.rate_hz / self._factor
        indices, new = self.sequencer.number(counters, times, rate, real_time=self.clock.real_time, contents=contents)
        rows = indices * self._factor
        if self.line is None:
            self.line = Timeline(int(rows[0]), self._anchor(float(times[0])), self.rate_hz)
        known = new & timed
        last = rows[known] + self.layout.n_samples - 1  # a frame is sent when its last sample is taken
        self.clock, self.line = clock.step(self.clock, self.line, last, times[known], self.rate_hz)
        held, old = self._held
        self._held = np.concatenate((held, rows[new])), np.concatenate((old, samples[new]))

    def _anchor(self, t_s: float) -> int:
        """Compute the UTC of the first sample, ns, in whole microseconds: no transport has finer timestamps."""
        before_us = (self.layout.n_samples - 1) / self.rate_hz * 1e6
        return max(0, round(round(t_s * 1e6) - before_us)) * 1000

    def _release(self, everything: bool) -> Rows:
        """Remove and return the rows before the first gap that late frames can still fill."""
        rows, samples = self._held
        n, step = self.layout.n_samples, self.sequencer.stride * self._factor
        order = np.argsort(rows)
        rows, samples = rows[order], samples[order]
        if len(rows) and self._next is None:
            self._next = int(rows[0])
        final = (np.diff(rows, prepend=(self._next or 0) - step) == step) | (
            rows - step < self.sequencer.horizon * self._factor
        )
        count = len(rows) if everything or final.all() else int(np.argmin(final))
        self._held = rows[count:], samples[count:]
        if count:
            self._next = int(rows[count - 1]) + step
        singles = (rows[:count, None] + np.arange(n)).ravel()
        return singles, samples[:count].reshape(-1, len(self.layout.channels))

    def origin_s(self) -> float | None:
        """Compute the UTC of this node's sample 0 by its clock, s; None while unknown."""
        if len(self.clock.offsets) < WARM_S:
            return None
        least = min(self.clock.offsets[-5:])
        return self.clock.t_s + least - self.clock.index / self.rate_hz

    def counts(self) -> dict[str, int]:
        """Return the event counts so far."""
        found = self.sequencer
        return {
            "lost_samples": found.lost * self.layout.n_samples,
            "repeated": found.repeated,
            "late": found.late,
            "stray": found.stray,
            "restarts": found.restarts,
            "bad_times": self.bad_times,
            "untimed": self.untimed,
            "steps": self.clock.steps,
        }

    def health(self) -> ClockHealth:
        """Return offset and drift of the node's clock against the times that blocks carry."""
        found = clock.fit(self.clock, self.rate_hz)
        offset = found.offset_s + clock.origin_s(self.line, self.clock) if self.line else 0.0
        std = found.drift_std_ppm if np.isfinite(found.drift_std_ppm) else 0.0
        name = self.layout.name
        return ClockHealth(name, offset, found.drift_ppm, std, self.clock.steps)


@dataclass(slots=True)
class Joiner:
    """Joiner of the rows of several nodes; the sample index of the first node is the common index."""

    nodes: tuple[Node, ...]
    channels: tuple[str, ...]
    rate_hz: float
    realign: bool
    unmatched: int = 0
    """Number of joined rows that lack the samples of some node, plus number of rows that arrived too late."""
    realigned: int = 0
    """Number of shifts by whole samples since the first alignment."""
    detail: str = ""
    """One sentence on the alignment."""
    _shifts: list[int] | None = None
    """Shift of each node's index against the common index, samples; None while not aligned."""
    _queues: list[list[Rows]] = field(init=False)
    _from: list[int] = field(init=False)
    _done: int = -(1 << 62)

    def __post_init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Discard the alignment of the nodes and the waiting rows."""
        self._shifts = [0] if len(self.nodes) == 1 else None
        self._queues = [[] for _ in self.nodes]
        self._from = [-(1 << 62)] * len(self.nodes)

    def join(self, *, everything: bool = False) -> Rows:
        """Join the rows of all nodes so far, NaN where a node has no sample; with `everything`, wait for no node.

        Raises `SourceError` if the nodes do not sample at the same times.
        """
        for queue, node in zip(self._queues, self.nodes, strict=True):
            rows = node.take(everything=everything)
            if len(rows[0]):
                queue.append(rows)
        if len(self.nodes) == 1:
            joined = self._queues[0]
            self._queues[0] = []
            if not joined:
                return _no_rows(len(self.channels))
            columns = [self.nodes[0].layout.channels.index(name) for name in self.channels]
            return joined[0][0], joined[0][1][:, columns]
        if not self._align(everything):
            self._limit_queues()
            return _no_rows(len(self.channels))
        return self._merge(everything)

    def _limit_queues(self) -> None:
        """Drop the oldest rows beyond some seconds, while the others wait for one node."""
        for queue in self._queues:
            while sum(len(rows) for rows, _ in queue) > 4 * WARM_S * self.rate_hz and len(queue) > 1:
                self.unmatched += len(queue.pop(0)[0])

    def _align(self, everything: bool) -> bool:
        """Find the shift of each node against the first one; False while a node's clock is unknown."""
        origins = [node.origin_s() for node in self.nodes]
        first = origins[0]
        waiting = [node.layout.name for node, origin in zip(self.nodes, origins, strict=True) if origin is None]
        if waiting and self._shifts is None and not everything:
            self.detail = f"waiting for {', '.join(waiting)}"
            return False
        in_real_time = all(node.clock.real_time for node in self.nodes)
        is_first = self._shifts is None
        self._shifts = self._shifts or [0] * len(self.nodes)
        lag_texts = []
        for at, (node, origin) in enumerate(zip(self.nodes, origins, strict=True)):
            if at == 0 or origin is None or first is None or not in_real_time:
                continue
            lag = (origin - first) * self.rate_hz - self._shifts[at]
            if abs(lag) > 0.5 + (0.0 if is_first else _MARGIN):
                self._shift_node(at, node, lag, is_first)
                lag -= round(lag)
            lag_texts.append(f"{node.layout.name} {lag:+.2f}")
        if not in_real_time and any(not node.layout.counter_bits for node in self.nodes):
            raise SourceError("nodes without a counter can be joined in real time only")
        after = f"samples after those of {self.nodes[0].layout.name}"
        self.detail = f"{', '.join(lag_texts)} {after}" if lag_texts else "joined by their counters alone"
        return True

    def _shift_node(self, at: int, node: Node, lag: float, is_first: bool) -> None:
        """Shift a node by its lag rounded to whole samples; raise SourceError if the settings forbid it."""
        assert self._shifts is not None
        counted = bool(node.layout.counter_bits)
        if not (self.realign or (is_first and not counted)):
            self.reset()
            raise SourceError(
                f"{node.layout.name} samples {lag:+.2f} samples after {self.nodes[0].layout.name}: their clocks are "
                "not synchronised; synchronise the nodes, or set realign = true"
            )
        self._shifts[at] += round(lag)
        if not is_first:
            # Leave a gap, because the samples on its two sides are not consecutive.
            self.realigned += 1
            self._from[at] = self._done + 3

    def _merge(self, everything: bool) -> Rows:
        assert self._shifts is not None
        nodes = zip(self.nodes, self._queues, self._shifts, strict=True)
        parts = [_concatenate([_no_rows(len(node.layout.channels)), *queue], shift) for node, queue, shift in nodes]
        ends = [int(rows[-1]) if len(rows) else self._done for rows, _ in parts]
        cut = max(ends) if everything else max(min(ends), max(ends) - round(HOLD_S * self.rate_hz))
        usable = [
            (rows > self._done) & (rows <= cut) & (rows >= start)
            for (rows, _), start in zip(parts, self._from, strict=True)
        ]
        late = sum(int(np.count_nonzero(rows <= self._done)) for rows, _ in parts)
        index = np.unique(np.concatenate([rows[use] for (rows, _), use in zip(parts, usable, strict=True)]))
        joined = np.full((len(index), len(self.channels)), np.nan, dtype=np.float32)
        for at, ((rows, samples), use) in enumerate(zip(parts, usable, strict=True)):
            columns = [self.channels.index(name) for name in self.nodes[at].layout.channels]
            joined[np.searchsorted(index, rows[use])[:, None], columns] = samples[use]
            rest = rows > cut
            self._queues[at] = [(rows[rest] - self._shifts[at], samples[rest])] if rest.any() else []
        self.unmatched += late + int(np.count_nonzero(np.isnan(joined).any(axis=1)))
        self._done = max(self._done, cut)
        return index, joined


def _no_rows(*shape: int) -> Rows:
    """Return no rows, of samples of this shape."""
    return np.empty(0, np.int64), np.empty((0, *shape), np.float32)


def _concatenate(queue: list[Rows], shift: int) -> Rows:
    """Concatenate rows, with `shift` added to their indices."""
    return np.concatenate([rows for rows, _ in queue]) + shift, np.concatenate([samples for _, samples in queue])
