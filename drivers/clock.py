"""Clock of a sensor node: offset and drift of its sample counter against timestamps, and conversion of counters to UTC.

The functions are pure: time arrives as data.  A timestamp says when a frame arrived, which is never before its sample was
taken.  The smallest offset of each second of data is therefore an upper bound of the node's clock offset, and a straight
line through these bounds gives offset and drift.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from drivers.base import Floats, Ints

KEEP = 600
"""Seconds of data that the fit uses."""
STEP_S = 0.1
"""Jump of the timestamps, s, beyond which they have stepped, if it lasts for two consecutive seconds of data."""
REAL_TIME_PPM = 1000.0
"""Deviation from the nominal rate within which a stream runs in real time; the time of any other stream is its counter."""
REANCHOR_S = 0.25
"""Offset, s, beyond which block times follow the timestamps."""
MAX_SHIFT_S = 0.5
"""Greatest shift of the block times at once, s, so that the shift loses no sample."""
LOST_S = 10.0
"""Offset, s, that is too large for drift: block times take it over in one step, which is a gap."""
_SETTLED = 5
"""Seconds of data before block times may follow the timestamps, and of the median that is the recent offset."""
_PACE = 60
"""Seconds of data over which the pace of a stream is judged."""
_JITTER_S = 0.02
"""Jitter of arrival, s, that the judgement of the pace allows."""


@dataclass(frozen=True, slots=True)
class ClockState:
    """State of one node's clock; an offset is a timestamp minus the counted time, s."""

    index: int = 0
    """Index of the sample at which counted time begins."""
    t_s: float = 0.0
    """Timestamp of that sample, s."""
    second: int = -1
    """Number of the second of data that is not yet complete; -1 before the first sample."""
    least: float = np.inf
    """Smallest offset in that second, s."""
    seconds: tuple[int, ...] = ()
    """Numbers of the complete seconds."""
    offsets: tuple[float, ...] = ()
    """Smallest offset of each complete second, s."""
    strayed: tuple[tuple[int, float], ...] = ()
    """Latest second with its offset, if off by more than `STEP_S`; the next second decides between an outlier and a step."""
    steps: int = 0
    """Number of clock steps so far."""
    real_time: bool = False
    """True if timestamps tell how much was lost."""


@dataclass(frozen=True, slots=True)
class ClockFit:
    """Offset and drift of a clock at the last complete second of data."""

    offset_s: float
    """Timestamp minus counted time."""
    drift_ppm: float
    """Excess of the node's sample rate over the nominal rate."""
    drift_std_ppm: float
    """Standard deviation of `drift_ppm`; infinite if unknown."""


def step(
    state: ClockState,
    line: Timeline | None,
    indices: Annotated[Ints, "n"],
    times_s: Annotated[Floats, "n"],
    rate_hz: float,
) -> tuple[ClockState, Timeline | None]:
    """Update the state of a clock with the timestamps of some samples; re-anchor the timeline if the timestamps have left it."""
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
            state = replace(_close_second(state), second=second, least=least)
            # One second ahead, so that the new anchor begins at the same sample however frames are cut into batches.
            line = line and reanchor(line, state, state.index + (second + 1) * length)
    return state, line


def _close_second(state: ClockState) -> ClockState:
    """Complete the present second of data: keep its smallest offset, and detect a clock step."""
    new = (state.second, state.least)
    if not state.real_time or abs(state.least - _recent_offset_s(state)) <= STEP_S:
        seconds, offsets = (*state.seconds, new[0])[-KEEP:], (*state.offsets, new[1])[-KEEP:]
        state = replace(state, seconds=seconds, offsets=offsets, strayed=())
    elif not state.strayed:
        return replace(state, strayed=(new,))
    else:
        old = state.strayed[0]
        stepped = abs(new[1] - old[1]) <= STEP_S / 2  # otherwise the pace has changed
        state = replace(state, seconds=(old[0], new[0]), offsets=(old[1], new[1]), strayed=())
        return replace(state, steps=state.steps + stepped, real_time=stepped)
    if len(state.offsets) < 3:
        return state
    real_time = _runs_in_real_time(state)
    if real_time and not state.real_time:  # earlier offsets say nothing about the present pace
        state = replace(state, seconds=state.seconds[-_PACE:], offsets=state.offsets[-_PACE:])
    return replace(state, real_time=real_time)


def _recent_offset_s(state: ClockState) -> float:
    """Compute the median of the latest `_SETTLED` offsets, s."""
    return float(np.median(state.offsets[-_SETTLED:]))


def _runs_in_real_time(state: ClockState) -> bool:
    """Test whether counter and timestamps agree over the latest `_PACE` seconds, apart from the jitter of arrival."""
    first = max(-_PACE, -len(state.offsets))
    span, moved = state.seconds[-1] - state.seconds[first], state.offsets[-1] - state.offsets[first]
    return abs(moved) <= REAL_TIME_PPM * 1e-6 * span + _JITTER_S


def fit(state: ClockState, rate_hz: float) -> ClockFit:
    """Fit a straight line through the smallest offsets of the seconds.

    Offsets far above the line, as of a second in which all frames were late, are left out.
    """
    n = len(state.offsets)
    if n < 3:
        least = min((*state.offsets, state.least))
        return ClockFit(least if np.isfinite(least) else 0.0, 0.0, np.inf)
    t = np.array(state.seconds, dtype=np.float64) * (max(1, round(rate_hz)) / rate_hz)
    y = np.array(state.offsets)
    t = t - t[-1]
    keep = np.ones(n, dtype=bool)
    for _ in range(3):
        mean, slope, std = _fit_line(t[keep], y[keep])
        residuals = y - (mean + slope * t)
        keep = residuals <= max(3.0 * 1.4826 * float(np.median(np.abs(residuals))), 1e-6)
        if keep.sum() < 3:
            break
    if slope <= -1.0:  # timestamps that stand still or run backwards say nothing about the rate
        return ClockFit(mean, 0.0, np.inf)
    drift = 1.0 / (1.0 + slope) - 1.0
    return ClockFit(mean, 1e6 * drift, 1e6 * std)


def _fit_line(t: Floats, y: Floats) -> tuple[float, float, float]:
    """Fit a line by least squares: its value at t = 0, its slope, and the standard deviation of the slope."""
    n, middle = len(t), t.mean()
    sxx = float(((t - middle) ** 2).sum()) or 1.0
    slope = float(((t - middle) * (y - y.mean())).sum()) / sxx
    value = float(y.mean() - slope * middle)
    residual = float(np.sqrt(((y - value - slope * t) ** 2).sum() / max(1, n - 2)))
    return value, slope, residual / float(np.sqrt(sxx))


@dataclass(frozen=True, slots=True)
class Timeline:
    """Conversion of sample indices to UTC: whole nominal periods from an anchor, independent of the times of arrival."""

    index: int
    """Sample index of the anchor."""
    t_ns: int
    """UTC of the anchor, ns."""
    rate_hz: float
    """Nominal sample rate, Hz."""
    shifts: tuple[tuple[int, int], ...] = ()
    """Latest re-anchorings: index of the first sample, and its delay against the first anchor, ns."""

    def at(self, index: int) -> int:
        """Compute the UTC of a sample, ns."""
        shift = next((ns for first, ns in reversed(self.shifts) if index >= first), 0)
        return self.counted(index) + shift

    def counted(self, index: int) -> int:
        """Compute the UTC of a sample by the first anchor alone, ns."""
        return self.t_ns + round((index - self.index) / self.rate_hz * 1e9)

    def next_shift(self, index: int) -> int | None:
        """Return the first sample beyond `index` that has another anchor; None if there is none."""
        return next((first for first, _ in self.shifts if first > index), None)

    @property
    def shift_ns(self) -> int:
        """Delay of the latest re-anchoring against the first anchor, ns."""
        return self.shifts[-1][1] if self.shifts else 0


def reanchor(line: Timeline, state: ClockState, first: int) -> Timeline:
    """Shift the timeline towards the timestamps from sample `first` on, if they differ by more than `REANCHOR_S`.

    A stream that does not run in real time keeps the time of its counter.
    """
    if not (state.real_time and len(state.offsets) >= _SETTLED and not state.strayed):
        return line
    off = _recent_offset_s(state) + origin_s(line, state)
    if abs(off) <= REANCHOR_S:
        return line
    change = off if abs(off) > LOST_S else float(np.clip(off, -MAX_SHIFT_S, MAX_SHIFT_S))
    # Earlier re-anchorings still apply to samples that are not yet released.
    return replace(line, shifts=(*line.shifts[-3:], (first, line.shift_ns + round(change * 1e9))))


def origin_s(line: Timeline, state: ClockState) -> float:
    """Compute what is added to an offset of the clock to give the timestamp minus the time by `line`, s."""
    return state.t_s - (line.counted(state.index) + line.shift_ns) * 1e-9
