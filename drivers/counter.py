"""Counters that wrap, in frames that may be lost, repeated or swapped, to indices that do not.  Pure.

What a frame becomes depends on the frames before it only, not on how they are cut into batches.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

REORDER = 32
"""Frames by which one may come late and still be put in its place."""
TOLERANCE_S = 2.0
"""How well a counter and timestamps must agree on what was lost; beyond, the node began anew."""
_SILENT_S = 1.0
"""Without frames for longer, the counter may have wrapped."""


@dataclass(frozen=True, slots=True)
class _Suspect:
    """Frames that jumped, until those after them confirm it: at once if forwards, after a second of them if backwards."""

    first: int
    """Counter of the first."""
    t_s: float
    last: int
    moved: int
    """From the first to the last."""
    needed: int
    """Frames still to follow."""
    frames: int = 1


@dataclass(slots=True)
class Sequencer:
    """Numbers one node's frames.

    Parameters
    ----------
    bits
        Of the counter; 0 if there is none: frames then count in order of arrival, and losses show by time only.
    stride
        How much the counter adds from frame to frame.
    """

    bits: int
    stride: int = 1
    repeated: int = 0
    late: int = 0
    """Too late to be put in order."""
    stray: int = 0
    """Alone with their counter: neither before nor after them does anything fit."""
    restarts: int = 0
    """The counter began anew."""
    ended: bool = False
    """Nothing will come any more."""
    _last: tuple[int, int, float] | None = None
    """Counter, index and time of the last frame in order of arrival."""
    _suspect: _Suspect | None = None
    _top: int = -1
    """Greatest index so far."""
    _first: int = 0
    _accepted: int = 0
    _seen: Ints = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    """Indices of late that a repetition could name."""

    def number(
        self, counters: Ints, times_s: Floats, rate_hz: float, *, real_time: bool
    ) -> tuple[Ints, NDArray[np.bool_]]:
        """Indices of frames in order of arrival, and which of them are new; both of shape (n,).

        Parameters
        ----------
        times_s
            NaN where unknown.
        rate_hz
            By which the counter grows.
        real_time
            Whether timestamps may decide how often the counter wrapped.
        """
        if self._last is None and len(counters):
            self._last = (int(counters[0]) - self.stride, int(counters[0]) - self.stride, float(times_s[0]))
            self._top, self._first = self._last[1], int(counters[0])
        indices, good = self._unwrap(counters, times_s, rate_hz, real_time)
        tops = np.maximum.accumulate(np.concatenate(([self._top], np.where(good, indices, self._top))))
        on_time = good & (indices > tops[:-1] - REORDER * self.stride) & (indices >= self._first)
        self.late += int(np.count_nonzero(good & ~on_time))
        first = np.zeros(len(indices), dtype=bool)
        where = np.flatnonzero(on_time)
        first[where[np.unique(indices[where], return_index=True)[1]]] = True
        new = first & ~np.isin(indices, self._seen)
        self.repeated += int(np.count_nonzero(on_time & ~new))
        self._top = int(tops[-1])
        self._accepted += int(np.count_nonzero(new))
        seen = np.concatenate((self._seen, indices[new]))
        self._seen = seen[seen > self._top - REORDER * self.stride]
        return indices, new

    @property
    def horizon(self) -> int:
        """Nothing below this index will be accepted any more."""
        return self._top + 1 - (0 if self.ended else REORDER * self.stride)

    @property
    def lost(self) -> int:
        """Frames that will not come any more."""
        known = self._accepted - int(np.count_nonzero(self._seen >= self.horizon))
        return max(0, -((self._first - self.horizon) // self.stride) - known)

    def _unwrap(
        self, counters: Ints, times_s: Floats, rate_hz: float, real_time: bool
    ) -> tuple[Ints, NDArray[np.bool_]]:
        """Indices, and which frames stand in a row with others."""
        if self._last is None:
            return np.empty(0, np.int64), np.empty(0, bool)
        value, index, t_s = self._last
        deltas = self._delta(np.diff(counters, prepend=value))
        with np.errstate(invalid="ignore"):
            waits = np.diff(times_s, prepend=t_s)
            odd = (np.abs(deltas) > REORDER * self.stride) | (deltas % self.stride != 0)
            odd |= (waits > self._silent_s(rate_hz)) & ((deltas != self.stride) | (self.bits == 0))
        if self._suspect is None and not odd.any() and np.isfinite(times_s).all():
            indices = index + np.cumsum(deltas)
            self._last = (int(counters[-1]), int(indices[-1]), float(times_s[-1]))
            return indices, np.ones(len(counters), dtype=bool)
        indices, good = np.zeros(len(counters), dtype=np.int64), np.zeros(len(counters), dtype=bool)
        for at, (value, t_s) in enumerate(zip(counters.tolist(), times_s.tolist(), strict=True)):
            found = self._unwrap_one(value, t_s, rate_hz, real_time)
            if found is not None:
                indices[at], good[at] = found, True
        return indices, good

    def _unwrap_one(self, value: int, t_s: float, rate_hz: float, real_time: bool) -> int | None:
        assert self._last is not None
        last, index, last_s = self._last
        delta = self._delta(value - last)
        silent = t_s - last_s > self._silent_s(rate_hz)
        suspect = self._suspect
        unbroken = self.bits and delta == self.stride and suspect is None
        if self._near(delta) and (unbroken or not silent):
            if suspect is not None:
                self.stray += suspect.frames
                self._suspect = None
            index += delta
        elif not self.bits:
            index += self._jump(0, t_s - last_s, rate_hz, real_time)
        else:
            follows = self._delta(value - suspect.last) if suspect else 0
            if suspect is None or not self._near(follows):
                self.stray += suspect.frames if suspect else 0
                needed = 1 if delta >= 0 or silent else max(1, round(rate_hz / self.stride))
                self._suspect = _Suspect(value, t_s, value, 0, needed)
                return None
            moved = suspect.moved + follows
            if suspect.needed > 1:
                self._suspect = replace(
                    suspect, last=value, moved=moved, needed=suspect.needed - 1, frames=suspect.frames + 1
                )
                return None
            self._suspect = None
            index += self._jump(suspect.first - last, suspect.t_s - last_s, rate_hz, real_time) + moved
        self._last = (value, index, t_s if np.isfinite(t_s) else last_s)
        return index

    def _jump(self, difference: int, wait_s: float, rate_hz: float, real_time: bool) -> int:
        """How much was lost, by the counter as far as it goes, by time beyond."""
        forward = difference % (1 << self.bits)
        if not (real_time and np.isfinite(wait_s)):
            return forward or self.stride
        waited = wait_s * rate_hz
        if self.bits:
            wraps = max(0, round((waited - forward) / (1 << self.bits)))
            forward += wraps << self.bits
            if forward and abs(forward - waited) <= TOLERANCE_S * rate_hz:
                return forward
            self.restarts += 1
        # Beyond whatever may still be put in order.
        return max(REORDER + 1 if self.bits else 1, round(waited / self.stride)) * self.stride

    def _delta(self, difference: Any) -> Any:
        """The least change of the counter, either way, that gives this difference."""
        if not self.bits:
            return 0 * difference + self.stride
        half = 1 << (self.bits - 1)
        return (difference + half) % (2 * half) - half

    def _near(self, delta: int) -> bool:
        return abs(delta) <= REORDER * self.stride and delta % self.stride == 0

    def _silent_s(self, rate_hz: float) -> float:
        return max(_SILENT_S, (1 << self.bits) / (2 * rate_hz)) if self.bits else _SILENT_S
