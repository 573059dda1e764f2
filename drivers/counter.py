"""Unwraps frame counters of finite width to indices that do not wrap; frames may be lost, repeated or swapped.  No I/O.

The index of a frame depends only on the frames before it, not on how the frames are cut into batches.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from drivers.base import Floats, Ints

Contents = NDArray[np.bytes_]
REORDER = 32
"""Greatest delay, in frames, at which a late frame is still put in its place."""
TOLERANCE_S = 2.0
"""Greatest difference, s, between counter and timestamps about a loss; beyond it, the node has restarted its counter."""
_SILENCE_S = 1.0
"""Time without frames, s, after which the counter may have wrapped."""


@dataclass(frozen=True, slots=True)
class _UnconfirmedJump:
    """Jump of the counter that later frames must confirm: one frame if it goes forwards, a second of frames if backwards.

    A jump back among the latest frames, to a counter under which another frame came, is confirmed by the frame that follows it.
    """

    first: int
    """Counter of the first frame after the jump."""
    t_s: float
    """Timestamp of that frame, s."""
    last: int
    """Counter of the latest frame."""
    moved: int
    """Change of the counter from the first to the latest frame."""
    needed: int
    """Frames that must still follow."""
    frames: int = 1
    """Frames since the jump."""
    greatest: int | None = None
    """Greatest index before a jump back among the latest frames; None for any other jump."""


@dataclass(slots=True)
class Sequencer:
    """Unwrapped counter of the frames of one node."""

    bits: int
    """Width of the counter; 0 means none: frames are numbered in order of arrival, and only timestamps show losses."""
    stride: int = 1
    """Increment of the counter from frame to frame."""
    repeated: int = 0
    late: int = 0
    """Number of frames that arrived too late to be put in order."""
    stray: int = 0
    """Number of frames whose counter fits neither the frames before nor those after them."""
    restarts: int = 0
    ended: bool = False
    """True if no frame will follow."""
    _last: tuple[int, int, float] | None = None
    """Counter, index and time of the last frame in order of arrival."""
    _unconfirmed: _UnconfirmedJump | None = None
    _greatest: int = -1
    """Greatest index so far."""
    _first: int = 0
    """Index of the first frame."""
    _accepted: int = 0
    """Number of new frames so far."""
    _recent: Ints = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    """Recent indices that a repeated frame could have."""
    _contents: Contents = field(default_factory=lambda: np.empty(0, dtype="S1"))
    """Contents of the frames of these indices."""

    def number(
        self,
        counters: Annotated[Ints, "n"],
        times_s: Annotated[Floats, "n"],
        rate_hz: float,
        *,
        real_time: bool,
        contents: Annotated[Contents, "n"] | None = None,
    ) -> tuple[Annotated[Ints, "n"], Annotated[NDArray[np.bool_], "n"]]:
        """Unwrap the counters of frames in order of arrival, and mark those that have an index and are neither repeated nor late.

        An index is 0 after a jump of the counter that is not confirmed.  A timestamp is NaN where unknown; in `real_time`
        timestamps may decide how often the counter, which grows at `rate_hz`, wrapped.  The `contents` of frames, bytes, tell
        a frame that comes again from another one under the same counter, which is one of a counter that was set back.
        """
        if contents is None:
            contents = np.zeros(len(counters), dtype="S1")
        before = replace(self)
        indices, new, contradicts = self._number(counters, times_s, rate_hz, real_time, contents)
        if not contradicts:
            return indices, new
        for f in fields(self):
            setattr(self, f.name, getattr(before, f.name))
        if len(counters) == 1:
            self.stray += self._unconfirmed.frames if self._unconfirmed else 0
            value, t_s = int(counters[0]), float(times_s[0])
            self._unconfirmed = _UnconfirmedJump(value, t_s, value, 0, 1, greatest=self._greatest)
            return np.zeros(1, dtype=np.int64), np.zeros(1, dtype=bool)
        cuts = [slice(k, k + 1) for k in range(len(counters))]
        singles = [
            self.number(counters[k], times_s[k], rate_hz, real_time=real_time, contents=contents[k]) for k in cuts
        ]
        return np.concatenate([one[0] for one in singles]), np.concatenate([one[1] for one in singles])

    def _number(
        self, counters: Ints, times_s: Floats, rate_hz: float, real_time: bool, contents: Contents
    ) -> tuple[Ints, NDArray[np.bool_], bool]:
        """Number frames as `number`, and say whether one has the index of an earlier one of other contents."""
        if self._last is None and len(counters):
            self._last = (int(counters[0]) - self.stride, int(counters[0]) - self.stride, float(times_s[0]))
            self._greatest, self._first = self._last[1], int(counters[0])
        indices, good = self._unwrap(counters, times_s, rate_hz, real_time)
        greatest = np.maximum.accumulate(np.concatenate(([self._greatest], np.where(good, indices, self._greatest))))
        on_time = good & (indices > greatest[:-1] - REORDER * self.stride) & (indices >= self._first)
        self.late += int(np.count_nonzero(good & ~on_time))
        first = np.zeros(len(indices), dtype=bool)
        where = np.flatnonzero(on_time)
        first[where[np.unique(indices[where], return_index=True)[1]]] = True
        new = first & ~np.isin(indices, self._recent)
        again = on_time & ~new
        self.repeated += int(np.count_nonzero(again))
        self._greatest = int(greatest[-1])
        self._accepted += int(np.count_nonzero(new))
        recent, came = np.concatenate((self._recent, indices[new])), np.concatenate((self._contents, contents[new]))
        contradicts = False
        if again.any():
            known = dict(zip(recent.tolist(), came.tolist(), strict=True))
            contradicts = any(
                known[k] != content
                for k, content in zip(indices[again].tolist(), contents[again].tolist(), strict=True)
            )
        kept = recent > self._greatest - REORDER * self.stride
        self._recent, self._contents = recent[kept], came[kept]
        return indices, new, contradicts

    @property
    def horizon(self) -> int:
        """Smallest index that can still be accepted."""
        return self._greatest + 1 - (0 if self.ended else REORDER * self.stride)

    @property
    def lost(self) -> int:
        """Number of frames that are lost for good."""
        known = self._accepted - int(np.count_nonzero(self._recent >= self.horizon))
        return max(0, -((self._first - self.horizon) // self.stride) - known)

    def _unwrap(
        self, counters: Ints, times_s: Floats, rate_hz: float, real_time: bool
    ) -> tuple[Ints, NDArray[np.bool_]]:
        """Unwrap the counters; return the indices and which frames have one."""
        if self._last is None:
            return np.empty(0, np.int64), np.empty(0, bool)
        value, index, t_s = self._last
        deltas = self._delta(np.diff(counters, prepend=value))
        with np.errstate(invalid="ignore"):
            waits = np.diff(times_s, prepend=t_s)
            irregular = (np.abs(deltas) > REORDER * self.stride) | (deltas % self.stride != 0)
            irregular |= (waits > self._silence_limit_s(rate_hz)) & ((deltas != self.stride) | (self.bits == 0))
        if self._unconfirmed is None and not irregular.any() and np.isfinite(times_s).all():
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
        """Unwrap the counter of one frame; None while a jump of the counter is unconfirmed."""
        assert self._last is not None
        last, index, last_s = self._last
        delta = self._delta(value - last)
        is_silent = t_s - last_s > self._silence_limit_s(rate_hz)
        unconfirmed = self._unconfirmed
        is_consecutive = self.bits and delta == self.stride and unconfirmed is None
        if (
            unconfirmed is not None
            and unconfirmed.greatest is not None
            and self._delta(value - unconfirmed.last) == self.stride
            and not is_silent
        ):
            self._unconfirmed = None
            self.restarts += 1
            index = unconfirmed.greatest + (REORDER + 1) * self.stride  # as after any counter that began anew
        elif self._is_small_change(delta) and (is_consecutive or not is_silent):
            if unconfirmed is not None:
                self.stray += unconfirmed.frames
                self._unconfirmed = None
            index += delta
        elif not self.bits:
            index += self._lost_counts(0, t_s - last_s, rate_hz, real_time)
        else:
            follows = self._delta(value - unconfirmed.last) if unconfirmed else 0
            if unconfirmed is None or not self._is_small_change(follows):
                self.stray += unconfirmed.frames if unconfirmed else 0
                needed = 1 if delta >= 0 or is_silent else max(1, round(rate_hz / self.stride))
                self._unconfirmed = _UnconfirmedJump(value, t_s, value, 0, needed)
                return None
            moved = unconfirmed.moved + follows
            if unconfirmed.needed > 1:
                self._unconfirmed = replace(
                    unconfirmed, last=value, moved=moved, needed=unconfirmed.needed - 1, frames=unconfirmed.frames + 1
                )
                return None
            self._unconfirmed = None
            index += self._lost_counts(unconfirmed.first - last, unconfirmed.t_s - last_s, rate_hz, real_time) + moved
        self._last = (value, index, t_s if np.isfinite(t_s) else last_s)
        return index

    def _lost_counts(self, difference: int, wait_s: float, rate_hz: float, real_time: bool) -> int:
        """Return the advance of the index over a loss, from the counter within its width and from time beyond it."""
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
        # Farther ahead than any late frame that can still be put in order.
        return max(REORDER + 1 if self.bits else 1, round(waited / self.stride)) * self.stride

    def _delta(self, difference: Any) -> Any:
        """Return the smallest change of the counter, forwards or backwards, that explains a difference."""
        if not self.bits:
            return 0 * difference + self.stride
        half = 1 << (self.bits - 1)
        return (difference + half) % (2 * half) - half

    def _is_small_change(self, delta: int) -> bool:
        """Test whether a change is a whole number of frames, at most `REORDER` either way."""
        return abs(delta) <= REORDER * self.stride and delta % self.stride == 0

    def _silence_limit_s(self, rate_hz: float) -> float:
        """Return the time without frames, s, after which the counter may have wrapped."""
        return max(_SILENCE_S, (1 << self.bits) / (2 * rate_hz)) if self.bits else _SILENCE_S
