"""CAN nodes to rows of samples: each node's frames in order, several nodes joined on one count.  No I/O.

Nodes that each sample by their own clock are joined sample by sample, never interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drivers import clock
from drivers.base import ClockHealth, SourceError
from drivers.clock import ClockState, Timeline
from drivers.counter import Sequencer
from drivers.frames import Layout

Ints = NDArray[np.int64]
Samples = NDArray[np.float32]
Rows = tuple[Ints, Samples]
"""Rising indices, shape (n,), and samples, shape (n, n_channels)."""

HOLD_S = 1.0
"""A node that lags by more is not waited for; its samples are missing then."""
WARM_S = 3
"""Seconds of data on which it is decided whether nodes fit each other."""
_MARGIN = 0.25
_MAX_T_S = 4e9


@dataclass(slots=True)
class Node:
    """What one node sent: frames in, rows out."""

    layout: Layout
    rate_hz: float
    counts_frames: bool
    frames: list[bytes] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    clock: ClockState = field(default_factory=ClockState)
    line: Timeline | None = None
    """Of this node's own count."""
    untimed: int = 0
    """Frames before the first with a timestamp."""
    bad_times: int = 0
    sequencer: Sequencer = field(init=False)
    _factor: int = field(init=False)
    _next: int | None = None
    _held: Rows = field(init=False)

    def __post_init__(self) -> None:
        by_frame = self.counts_frames or not self.layout.counter_bits
        self.sequencer = Sequencer(self.layout.counter_bits, 1 if by_frame else self.layout.n_samples)
        self._factor = self.layout.n_samples if by_frame else 1
        self._held = (
            np.empty(0, np.int64),
            np.empty((0, self.layout.n_samples, len(self.layout.channels)), np.float32),
        )

    def take(self, *, everything: bool = False) -> Rows:
        """Rows that are in order now; `everything`: whatever is held, since nothing will come any more."""
        if self.frames:
            frames, times = b"".join(self.frames), np.array(self.times, dtype=np.float64)
            self.frames, self.times = [], []
            samples, counters = self.layout.decode(frames)
            self._add(samples.reshape(len(times), self.layout.n_samples, -1), counters, times)
        self.sequencer.ended |= everything
        return self._release(everything)

    def _add(self, samples: Samples, counters: Ints, times: NDArray[np.float64]) -> None:
        timed = (times >= 0) & (times < _MAX_T_S)  # false for NaN
        self.bad_times += int(np.count_nonzero(~timed))
        times = np.where(timed, times, np.nan)
        if self.line is None:
            first = int(np.argmax(timed)) if timed.any() else len(timed)
            self.untimed += first
            samples, counters, times, timed = samples[first:], counters[first:], times[first:], timed[first:]
            if not len(times):
                return
        rate = self.rate_hz / self._factor
        indices, new = self.sequencer.number(counters, times, rate, real_time=self.clock.real_time)
        rows = indices * self._factor
        if self.line is None:
            self.line = Timeline(int(rows[0]), self._anchor(float(times[0])), self.rate_hz)
        known = new & timed
        last = rows[known] + self.layout.n_samples - 1  # a frame leaves with its last sample
        self.clock, self.line = clock.step(self.clock, self.line, last, times[known], self.rate_hz)
        held, old = self._held
        self._held = np.concatenate((held, rows[new])), np.concatenate((old, samples[new]))

    def _anchor(self, t_s: float) -> int:
        """UTC of the first sample, whole microseconds: finer than that no transport tells."""
        before_us = (self.layout.n_samples - 1) / self.rate_hz * 1e6
        return max(0, round(round(t_s * 1e6) - before_us)) * 1000

    def _release(self, everything: bool) -> Rows:
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
        """UTC of this node's sample 0 by its clock; None while unknown."""
        if len(self.clock.offsets) < WARM_S:
            return None
        least = min(self.clock.offsets[-5:])
        return self.clock.t_s + least - self.clock.index / self.rate_hz

    def health(self) -> ClockHealth:
        """The clock against the times that blocks carry."""
        found = clock.fit(self.clock, self.rate_hz)
        offset = found.offset_s + clock.origin_s(self.line, self.clock) if self.line else 0.0
        std = found.drift_std_ppm if np.isfinite(found.drift_std_ppm) else 0.0
        name = self.layout.name
        return ClockHealth(name, offset, found.drift_ppm, std, self.clock.steps)


@dataclass(slots=True)
class Joiner:
    """Rows of several nodes to rows of all; the first node's count is the common one."""

    nodes: tuple[Node, ...]
    channels: tuple[str, ...]
    rate_hz: float
    realign: bool
    unmatched: int = 0
    """Rows given without the samples of some node, and samples of nodes that came too late."""
    realigned: int = 0
    detail: str = ""
    _shifts: list[int] | None = None
    _queues: list[list[Rows]] = field(init=False)
    _from: list[int] = field(init=False)
    _done: int = -(1 << 62)

    def __post_init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Find out anew how the nodes fit."""
        self._shifts = [0] if len(self.nodes) == 1 else None
        self._queues = [[] for _ in self.nodes]
        self._from = [-(1 << 62)] * len(self.nodes)

    def join(self, *, everything: bool = False) -> Rows:
        """What all nodes have by now, in the order of `channels`, NaN where one has nothing.

        Raises
        ------
        SourceError
            If the nodes' samples do not fall together.
        """
        for queue, node in zip(self._queues, self.nodes, strict=True):
            rows = node.take(everything=everything)
            if len(rows[0]):
                queue.append(rows)
        if len(self.nodes) == 1:
            joined = self._queues[0]
            self._queues[0] = []
            if not joined:
                return np.empty(0, np.int64), np.empty((0, len(self.channels)), np.float32)
            columns = [self.nodes[0].layout.channels.index(name) for name in self.channels]
            return joined[0][0], joined[0][1][:, columns]
        if not self._fit(everything):
            self._bound()
            return np.empty(0, np.int64), np.empty((0, len(self.channels)), np.float32)
        return self._merge(everything)

    def _bound(self) -> None:
        """While one node is waited for, the others' rows are kept for some seconds only."""
        for queue in self._queues:
            while sum(len(rows) for rows, _ in queue) > 4 * WARM_S * self.rate_hz and len(queue) > 1:
                self.unmatched += len(queue.pop(0)[0])

    def _fit(self, everything: bool) -> bool:
        """Whether it is known which samples fall together."""
        origins = [node.origin_s() for node in self.nodes]
        first = origins[0]
        waiting = [node.layout.name for node, origin in zip(self.nodes, origins, strict=True) if origin is None]
        if waiting and self._shifts is None and not everything:
            self.detail = f"waiting for {', '.join(waiting)}"
            return False
        paced = all(node.clock.real_time for node in self.nodes)
        fresh = self._shifts is None
        self._shifts = self._shifts or [0] * len(self.nodes)
        said = []
        for at, (node, origin) in enumerate(zip(self.nodes, origins, strict=True)):
            if at == 0 or origin is None or first is None or not paced:
                continue
            apart = (origin - first) * self.rate_hz - self._shifts[at]
            if abs(apart) > 0.5 + (0.0 if fresh else _MARGIN):
                self._move(at, node, apart, fresh)
                apart -= round(apart)
            said.append(f"{node.layout.name} {apart:+.2f}")
        if not paced and any(not node.layout.counter_bits for node in self.nodes):
            raise SourceError("nodes without a counter can be joined in real time only")
        after = f"samples after those of {self.nodes[0].layout.name}"
        self.detail = f"{', '.join(said)} {after}" if said else "joined by their counters alone"
        return True

    def _move(self, at: int, node: Node, apart: float, fresh: bool) -> None:
        assert self._shifts is not None
        counted = bool(node.layout.counter_bits)
        if not (self.realign or (fresh and not counted)):
            self.reset()
            raise SourceError(
                f"{node.layout.name} samples {apart:+.2f} samples after {self.nodes[0].layout.name}: their clocks are "
                "not synchronised; synchronise the nodes, or set realign = true"
            )
        self._shifts[at] += round(apart)
        if not fresh:
            # A hole, since the samples about it do not follow each other.
            self.realigned += 1
            self._from[at] = self._done + 3

    def _merge(self, everything: bool) -> Rows:
        assert self._shifts is not None
        width = len(self.channels)
        parts: list[Rows] = []
        for at, queue in enumerate(self._queues):
            parts.append(_concatenate(queue, len(self.nodes[at].layout.channels), self._shifts[at]))
        ends = [int(rows[-1]) if len(rows) else self._done for rows, _ in parts]
        cut = max(ends) if everything else max(min(ends), max(ends) - round(HOLD_S * self.rate_hz))
        usable = [
            (rows > self._done) & (rows <= cut) & (rows >= start)
            for (rows, _), start in zip(parts, self._from, strict=True)
        ]
        late = sum(int(np.count_nonzero(rows <= self._done)) for rows, _ in parts)
        index = np.unique(np.concatenate([rows[use] for (rows, _), use in zip(parts, usable, strict=True)]))
        joined = np.full((len(index), width), np.nan, dtype=np.float32)
        for at, ((rows, samples), use) in enumerate(zip(parts, usable, strict=True)):
            columns = [self.channels.index(name) for name in self.nodes[at].layout.channels]
            joined[np.searchsorted(index, rows[use])[:, None], columns] = samples[use]
            rest = rows > cut
            shift = self._shifts[at]
            self._queues[at] = [(rows[rest] - shift, samples[rest])] if rest.any() else []
        self.unmatched += late + int(np.count_nonzero(np.isnan(joined).any(axis=1)))
        self._done = max(self._done, cut)
        return index, joined


def _concatenate(queue: list[Rows], width: int, shift: int) -> Rows:
    if not queue:
        return np.empty(0, np.int64), np.empty((0, width), np.float32)
    return np.concatenate([rows for rows, _ in queue]) + shift, np.concatenate([samples for _, samples in queue])
