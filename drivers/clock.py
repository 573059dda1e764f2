"""A node's clock: its sample counter against timestamps, and from counters to UTC.  Pure: time arrives as data.

Timestamps say when a frame arrived, never before its sample was taken.  So the earliest of each second of data bounds
the node's clock from above, and a line through these is its offset and drift.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

KEEP = 600
"""Seconds of data that the fit remembers."""
STEP_S = 0.1
"""Timestamps that jump by more, for two seconds of data running, have stepped."""
REAL_TIME_PPM = 1000.0
"""A stream within this of its nominal rate runs in real time; of any other, only the counter is time."""
REANCHOR_S = 0.25
"""Offset beyond which block times follow the timestamps."""
MAX_SHIFT_S = 0.5
"""They follow by no more than this at a time, so that no sample is lost for it."""
LOST_S = 10.0
"""An offset beyond this is no drift: taken over whole, which is a gap."""
_SETTLED = 5
_PACE = 60
_JITTER_S = 0.02


@dataclass(frozen=True, slots=True)
class ClockState:
    """What is known of one node's clock; offsets in s, timestamp less counted time."""

    index: int = 0
    """Sample that counted time begins with."""
    t_s: float = 0.0
    """Its timestamp."""
    second: int = -1
    """Of data, the one not yet over; -1 before the first sample."""
    least: float = np.inf
    """The smallest offset in it."""
    seconds: tuple[int, ...] = ()
    offsets: tuple[float, ...] = ()
    """The smallest of each second gone by."""
    strayed: tuple[tuple[int, float], ...] = ()
    """A second that was off by more than `STEP_S`, until the next one tells what it was."""
    steps: int = 0
    real_time: bool = False
    """Whether timestamps tell how much was lost."""


@dataclass(frozen=True, slots=True)
class ClockFit:
    """Offset and drift as of the last full second of data."""

    offset_s: float
    """Timestamp less counted time."""
    drift_ppm: float
    """How much faster than nominal the node samples."""
    drift_std_ppm: float


def step(
    state: ClockState, line: Timeline | None, indices: Ints, times_s: Floats, rate_hz: float
) -> tuple[ClockState, Timeline | None]:
    """Take in the timestamps of some samples, both of shape (n,); `line`, if given, follows them where it must."""
    if not len(indices):
        return state, line
    if state.second < 0:
        state = replace(state, index=int(indices[0]), t_s=float(times_s[0]), second=0)
    counted, length = indices - state.index, max(1, round(rate_hz))
    offsets = (times_s - state.t_s) - counted / rate_hz
    seconds = counted // length
    order = np.argsort(seconds, kind="stable")
    edges = np.flatnonzero(np.diff(seconds[order])) + 1
    for part in np.split(order, edges):
        second, least = int(seconds[part[0]]), float(offsets[part].min())
        if second == state.second:
            state = replace(state, least=min(least, state.least))
        elif second > state.second:
            state = replace(_close(state), second=second, least=least)
            # One second ahead, so that it falls on the same sample however frames are cut into batches.
            line = line and reanchor(line, state, state.index + (second + 1) * length)
    return state, line


def _close(state: ClockState) -> ClockState:
    """A second of data is over."""
    new = (state.second, state.least)
    if not state.real_time or abs(state.least - _recent(state)) <= STEP_S:
        seconds, offsets = (*state.seconds, new[0])[-KEEP:], (*state.offsets, new[1])[-KEEP:]
        state = replace(state, seconds=seconds, offsets=offsets, strayed=())
    elif not state.strayed:
        return replace(state, strayed=(new,))
    else:
        old = state.strayed[0]
        stepped = abs(new[1] - old[1]) <= STEP_S / 2
        return replace(
            state,
            seconds=(old[0], new[0]),
            offsets=(old[1], new[1]),
            strayed=(),
            steps=state.steps + stepped,
            real_time=stepped,  # else its pace has changed
        )
    if len(state.offsets) < 3:
        return state
    real_time = _runs_true(state)
    if real_time and not state.real_time:  # what was before says nothing of the pace now
        state = replace(state, seconds=state.seconds[-_PACE:], offsets=state.offsets[-_PACE:])
    return replace(state, real_time=real_time)


def _recent(state: ClockState) -> float:
    return float(np.median(state.offsets[-_SETTLED:]))


def _runs_true(state: ClockState) -> bool:
    """Whether counter and timestamps ran alike of late, but for the jitter of arrival."""
    first = max(-_PACE, -len(state.offsets))
    span, moved = state.seconds[-1] - state.seconds[first], state.offsets[-1] - state.offsets[first]
    return abs(moved) <= REAL_TIME_PPM * 1e-6 * span + _JITTER_S


def fit(state: ClockState, rate_hz: float) -> ClockFit:
    """Straight line through the seconds' smallest offsets; those far above it (a second of late frames) are left out."""
    n = len(state.offsets)
    if n < 3:
        least = min((*state.offsets, state.least))
        return ClockFit(least if np.isfinite(least) else 0.0, 0.0, np.inf)
    t = np.array(state.seconds, dtype=np.float64) * (max(1, round(rate_hz)) / rate_hz)
    y = np.array(state.offsets)
    t = t - t[-1]
    keep = np.ones(n, dtype=bool)
    for _ in range(3):
        mean, slope, std = _line(t[keep], y[keep])
        miss = y - (mean + slope * t)
        keep = miss <= max(3.0 * 1.4826 * float(np.median(np.abs(miss))), 1e-6)
        if keep.sum() < 3:
            break
    if slope <= -1.0:  # times that stand still or run back say nothing of the rate
        return ClockFit(mean, 0.0, np.inf)
    drift = 1.0 / (1.0 + slope) - 1.0
    return ClockFit(mean, 1e6 * drift, 1e6 * std)


def _line(t: Floats, y: Floats) -> tuple[float, float, float]:
    """Value at t = 0, slope, and the slope's standard deviation."""
    n, middle = len(t), t.mean()
    sxx = float(((t - middle) ** 2).sum()) or 1.0
    slope = float(((t - middle) * (y - y.mean())).sum()) / sxx
    value = float(y.mean() - slope * middle)
    residual = float(np.sqrt(((y - value - slope * t) ** 2).sum() / max(1, n - 2)))
    return value, slope, residual / float(np.sqrt(sxx))


@dataclass(frozen=True, slots=True)
class Timeline:
    """Sample index to UTC: whole counts of the nominal period from an anchor, whatever frames arrived when."""

    index: int
    t_ns: int
    rate_hz: float
    shifts: tuple[tuple[int, int], ...] = ()
    """The last re-anchorings: from this sample on, this much later (ns) than by the first anchor."""

    def at(self, index: int) -> int:
        """UTC of a sample, nanoseconds."""
        shift = next((ns for first, ns in reversed(self.shifts) if index >= first), 0)
        return self.counted(index) + shift

    def counted(self, index: int) -> int:
        """UTC of a sample by the first anchor."""
        return self.t_ns + round((index - self.index) / self.rate_hz * 1e9)

    def next_shift(self, index: int) -> int | None:
        """The first sample beyond `index` with another anchor."""
        return next((first for first, _ in self.shifts if first > index), None)

    @property
    def shift_ns(self) -> int:
        """Of the last re-anchoring."""
        return self.shifts[-1][1] if self.shifts else 0


def reanchor(line: Timeline, state: ClockState, first: int) -> Timeline:
    """Follow the timestamps, from sample `first` on, if they have left the count.

    A stream faster or slower than the clock keeps the time of its counter.
    """
    if not (state.real_time and len(state.offsets) >= _SETTLED and not state.strayed):
        return line
    off = _recent(state) + origin_s(line, state)
    if abs(off) <= REANCHOR_S:
        return line
    change = off if abs(off) > LOST_S else float(np.clip(off, -MAX_SHIFT_S, MAX_SHIFT_S))
    # The entries before the last still hold for samples on their way.
    return replace(line, shifts=(*line.shifts[-3:], (first, line.shift_ns + round(change * 1e9))))


def origin_s(line: Timeline, state: ClockState) -> float:
    """What to add to the clock's offsets to make them timestamp less `line`, s."""
    return state.t_s - (line.counted(state.index) + line.shift_ns) * 1e-9
