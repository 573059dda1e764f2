"""Stretches in which no channel changes: the logger repeats its last sample, or nothing moves by the channels' resolution.

One channel that holds its value while others move is `sensor_health`'s.  Here all channels repeat at once.  In a quiet night they
do so too, the oftener the coarser their resolution is.  So a run of repetitions is judged by the quietest stretch of the window:
where each sample repeats the one before with the probability p, n samples hold a run of L repetitions with a chance of at most
n p^L.  A run that a step of the resolution ends was rest, and tells p as well: the longest run of n samples has n p^L = 1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import isfinite, log
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import STILL, Array, Skipped, utc
from monitor.signals.alignment import Piece
from monitor.signals.neighbours import FALSE_RATE_A_SPAN


@dataclass(frozen=True, slots=True)
class Stretch:
    """What repeated in one stretch of samples, the length of a step of windows and hops."""

    t_ns: int
    """UTC of the first sample."""
    t_end_ns: int
    """Exclusive end, UTC."""
    n: int
    """Samples."""
    rate_hz: float
    repeating: float
    """Probability that a sample repeats the one before in all channels (rule of succession), by those outside the longest run."""
    rest: int
    """Length of the longest run of repetitions that steps of the resolution ended in the stretch; 0 without one."""
    hold: int
    """Length of the longest run that larger steps ended; 0 without one."""
    lasting: int
    """Length of the run of repetitions that lasts at the end of the stretch."""
    resolution: float
    """Largest resolution of the channels: least change of each so far, m/s^2; infinite where one never changed."""

    @property
    def chance(self) -> float:
        """Probability that a sample repeats the one before."""
        return max(self.repeating, (self.n + 1.0) ** (-1.0 / self.rest) if self.rest else 0.0)


@dataclass(frozen=True, eq=False, slots=True)
class StillState:
    """The stretch that is being filled, and those that a window may still need."""

    last: Annotated[Array, "rows c"]
    """The latest sample, in a row; no row before the first."""
    resolution: Annotated[Array, "c"]
    """Least change of each channel so far, m/s^2."""
    origin_ns: int | None = None
    """UTC of the first sample of all."""
    rate_hz: float = 1.0
    t_ns: int = 0
    """UTC of the stretch's first sample."""
    n: int = 0
    repeated: int = 0
    """Samples of the stretch that repeat the one before."""
    longest: int = 0
    """Repetitions within the stretch that belong to its longest run."""
    here: int = 0
    """Repetitions within the stretch that belong to the present run."""
    run: int = 0
    """Length of the present run of repetitions."""
    rest: int = 0
    hold: int = 0
    stretches: tuple[Stretch, ...] = ()


def start(n_channels: int) -> StillState:
    """Return the state before the first sample."""
    return StillState(np.zeros((0, n_channels)), np.full(n_channels, np.inf))


def step(state: StillState, piece: Piece, step_s: float, keep_s: float) -> StillState:
    """Add samples, of which those that are not finite say nothing.

    Parameters
    ----------
    step_s
        Step that divides windows and hops: stretches end where windows end.
    keep_s
        Length of data for which stretches are kept for `check`.
    """
    t_ns, values, rate = piece.t_ns, piece.values, piece.rate_hz
    if piece.gap is not None and state.n:
        state = _close(state, t_ns)
    origin_ns = t_ns if state.origin_ns is None else state.origin_ns
    kept = tuple(s for s in state.stretches if abs(t_ns - s.t_end_ns) <= keep_s * 1e9)
    if (rate, origin_ns, kept) != (state.rate_hz, state.origin_ns, state.stretches):
        state = replace(state, rate_hz=rate, origin_ns=origin_ns, stretches=kept)
    while len(values):
        begin_ns = t_ns - round(state.n / rate * 1e9)
        since_s = (begin_ns - origin_ns) * 1e-9
        end_s = (np.floor(since_s / step_s + 1e-6) + 1.0) * step_s
        room = max(1, round((end_s - since_s) * rate) - state.n)
        part, values = values[:room], values[room:]
        state = _count(state if state.n else replace(state, t_ns=begin_ns), part)
        t_ns += round(len(part) / rate * 1e9)
        if len(part) == room:
            state = _close(state, t_ns)
    return state


def check(
    state: StillState, begin_ns: int, end_ns: int, saturated: Callable[[int, int], NDArray[np.bool_]]
) -> Skipped | None:
    """Tell of a run of repetitions in the window from `begin_ns` to `end_ns` (UTC) that chance does not explain.

    `saturated` finds the channels that reached the ends of their ranges between two times.

    Examples
    --------
    >>> from monitor.signals.alignment import Piece
    >>> moving = np.random.default_rng(1).normal(size=(1000, 2)).round(1)
    >>> dead = np.concatenate([moving, np.zeros((200, 2))])
    >>> state = step(start(2), Piece(10**9, dead, None, 100.0), 1.0, 60.0)
    >>> check(state, 10**9, 13 * 10**9, lambda begin_ns, end_ns: np.zeros(2, dtype=bool)).reason[:42]
    'no reading changes: the logger is dead, or'
    """
    inside = [s for s in state.stretches if begin_ns <= s.t_ns and s.t_end_ns <= end_ns + 1000]  # times are rounded
    if not inside:
        return None
    last, n = inside[-1], sum(s.n for s in inside)
    least = log(FALSE_RATE_A_SPAN / n) / log(max(s.chance for s in inside))
    if last.lasting > least:
        notes = [f"since {utc(last.t_end_ns - last.lasting / last.rate_hz * 1e9)} UTC"]
        notes += [f"resolution {last.resolution:.2g} m/s^2"] if isfinite(last.resolution) else []
        words = f"{STILL}: the logger is dead, or nothing moves by the channels' resolution"
        return Skipped(f"{words} ({'; '.join(notes)})")
    longest = max(inside, key=lambda s: s.hold / s.rate_hz)
    if longest.hold > least:
        ends = saturated(begin_ns, end_ns)
        other = ", or all sensors were at the ends of their ranges" if ends.size and ends.all() else ""
        return Skipped(
            f"no reading changed for a while ({longest.hold / longest.rate_hz:.3g} s): the logger stood still{other}"
        )
    return None


def _count(state: StillState, part: Annotated[Array, "n c"]) -> StillState:
    """Count the repetitions in the next samples of the stretch."""
    from monitor.signals.kernels import count_repetitions  # compiled code takes a while to load

    before = state.repeated, state.longest, state.here, state.run, state.rest, state.hold
    resolution, (repeated, longest, here, run, rest, hold) = count_repetitions(
        state.last, np.ascontiguousarray(part), state.resolution, before
    )
    return replace(
        state,
        last=part[-1:].copy(),
        resolution=resolution,
        n=state.n + len(part),
        repeated=repeated,
        longest=longest,
        here=here,
        run=run,
        rest=rest,
        hold=hold,
    )


def _close(state: StillState, t_end_ns: int) -> StillState:
    """Complete the stretch and begin the next."""
    others = state.n - state.longest
    found = Stretch(
        t_ns=state.t_ns,
        t_end_ns=t_end_ns,
        n=state.n,
        rate_hz=state.rate_hz,
        repeating=(state.repeated - state.longest + 1) / (others + 2),
        rest=state.rest,
        hold=state.hold,
        lasting=state.run,
        resolution=float(state.resolution.max()),
    )
    kept = (*state.stretches, found)
    return StillState(state.last, state.resolution, state.origin_ns, state.rate_hz, run=state.run, stretches=kept)
