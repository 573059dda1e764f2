"""Alignment of sample blocks: runs without gaps in the structure's channel order, and the gaps between them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import ceil
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from drivers.base import UNIT_OF, SampleBlock
from monitor.core import CLOCK, Array, BadInputError, Gap
from monitor.signals import lone_readings
from monitor.signals.lone_readings import Shown
from monitor.signals.stream_clock import StreamClock

_MAX_CLOCK_OFFSET_S = 1.0
"""Jump of the clock, from one block to the next in sequence, from which samples may have been lost. [s; judgement]"""
_MAX_DRIFT = 1e-3
"""Largest drift of a clock: a stream that is further off has another rate than it says. [ratio; crystal oscillators are
ten times better]"""
_RELABEL_NS = 250_000_000
"""Smallest step by which the times of samples follow the clock; less is jitter. [ns; judgement]"""
_PATIENCE_S = 60.0
"""Length of late data after which the clock was set back rather than blocks delayed. [s; judgement]"""
_MAX_CHANNELS = 1024
"""Most channels of a block. [channels; cost]"""
_MAX_RATE_HZ = 1e6
"""Highest rate of a block. [Hz; cost]"""
_MAX_READING = 2.0**31
"""Largest magnitude of a reading; what exceeds it in some channels alone is lost. [unit of the topic; definition: a converter of
32 bits counts no further]"""
_MAX_INT = 1 << 62
"""Largest time and count that are accepted. [1; definition: half of the largest 64-bit integer]"""


@dataclass(frozen=True, slots=True)
class AlignState:
    """State of the stream between blocks."""

    t_run_ns: int
    """UTC of the current run's first sample."""
    n_run: int
    """Samples in the current run; 0 before the first."""
    next_sequence: int
    rate_hz: float
    dropped: int
    """Number of samples dropped: repeated, late or not finite."""
    offset_ns: int = 0
    """Drift of the clock in this run: the latest block's time minus the time counted from the run's first sample."""
    label_ns: int = 0
    """Part of the drift that the times of samples already include."""
    late: int = 0
    """Number of consecutive samples dropped because they came late."""
    clock: StreamClock = field(default_factory=StreamClock)
    """The stream's rate by its timestamps."""
    shown: Shown = field(default_factory=Shown)
    """What the channels have shown, where instants are kept that only some of them have (`step`)."""

    def t_next_ns(self) -> int:
        """Return the UTC at which the next sample of the run is due."""
        return self.t_run_ns + round(self.n_run / self.rate_hz * 1e9) + self.label_ns

    @property
    def is_at_odds(self) -> bool:
        """Whether the timestamps contradict the stated rate by more than a clock drifts."""
        return abs(self.clock.ratio - 1.0) > _MAX_DRIFT


def start() -> AlignState:
    """Return the state before the first sample."""
    return AlignState(t_run_ns=0, n_run=0, next_sequence=0, rate_hz=1.0, dropped=0)


@dataclass(frozen=True, eq=False, slots=True)
class Piece:
    """Consecutive samples, with the gap before them, if any."""

    t_ns: int
    values: Annotated[Array, "n c"]
    """In the unit of the topic."""
    gap: Gap | None
    rate_hz: float
    shift_ns: int = 0
    """Correction of the times of samples from this piece on, for the drift of the clock."""
    lost: Annotated[NDArray[np.bool_], "n c"] | None = None
    """Which samples are not finite (`step`); None where all are finite."""


def select(block: SampleBlock, channels: tuple[str, ...]) -> Annotated[Array, "n c"]:
    """Select the structure's channels of a block, in the unit of its topic.

    Raises
    ------
    BadInputError
        If a channel is missing, the unit is not that of the topic, or a number is absurd.
    """
    if len(block.channels) > _MAX_CHANNELS:
        raise BadInputError(f"{block.topic}: {len(block.channels)} channels, {_MAX_CHANNELS} are the most")
    if block.sample_rate_hz > _MAX_RATE_HZ:
        raise BadInputError(f"{block.topic}: a rate of {block.sample_rate_hz:g} Hz, {_MAX_RATE_HZ:g} Hz is the most")
    if not (0 <= block.t_ns < _MAX_INT and block.sequence < _MAX_INT):
        raise BadInputError(f"{block.topic}: time {block.t_ns} ns or sequence {block.sequence} is absurd")
    missing = [name for name in channels if name not in block.channels]
    if missing:
        raise BadInputError(
            f"{block.topic}: channel {', '.join(missing)} of the structure file is not in the data, which has "
            f"{', '.join(block.channels)}; name the channels alike, or take what was not measured out of the structure file"
        )
    unit = UNIT_OF.get(block.topic, "m/s^2")
    if block.unit != unit:
        raise BadInputError(f"{block.topic}: unit {block.unit!r}, expected {unit!r}")
    columns = [block.channels.index(name) for name in channels]
    with np.errstate(invalid="ignore"):  # a signalling NaN is a missing sample like any other
        if block.channels == channels:
            return np.asarray(block.samples, dtype=np.float64)
        return block.samples[:, columns].astype(np.float64)


def step(
    state: AlignState, block: SampleBlock, channels: tuple[str, ...], *, keep_partial: bool = False
) -> tuple[AlignState, list[Piece]]:
    """Append a block to the stream and cut it at gaps and non-finite samples; there are no pieces if nothing of it is new.

    With `keep_partial` instants at which only some of the channels are finite are kept (`Piece.lost`); without it they are a gap.
    Numbers that no sensor gives, as loggers write in the place of a reading, are then not finite either, nor are lone readings
    that no structure gives.
    Blocks in sequence form one run as long as the clock does not jump between two of them: a clock error of some parts in a
    million makes no gap.  Times of samples are counted from the run's first sample.  When the clock differs from that count by
    a quarter of a second, the times are corrected in one step.  A source whose times are exact is never corrected.
    """
    values = select(block, channels)
    if keep_partial:
        absurd = np.abs(values) > _MAX_READING
        if absurd.any():
            values = np.where(absurd & ~absurd.all(axis=1, keepdims=True), np.nan, values)
        shown, lone = lone_readings.step(state.shown, values, block.sample_rate_hz)
        state = state if shown == state.shown else replace(state, shown=shown)
        if lone is not None:
            values = np.where(lone & ~lone.all(axis=1, keepdims=True), np.nan, values)
    if np.isfinite(values).all():
        return _place(state, block, values, 0)
    finite = np.isfinite(values)
    finite = np.asarray(finite.any(axis=1) if keep_partial else finite.all(axis=1))
    pieces: list[Piece] = []
    edges = np.flatnonzero(np.diff(finite)) + 1
    for begin, end in zip([0, *edges], [*edges, len(finite)], strict=True):
        if finite[begin]:
            state, new = _place(state, block, values[begin:end], int(begin))
            pieces.extend(_with_lost(piece) for piece in new)
        else:
            state = replace(state, dropped=state.dropped + int(end - begin))
    return state, pieces


def _with_lost(piece: Piece) -> Piece:
    """Note which samples of a piece are not finite."""
    lost = ~np.isfinite(piece.values)
    return replace(piece, lost=lost) if lost.any() else piece


def _place(state: AlignState, block: SampleBlock, values: Array, offset: int) -> tuple[AlignState, list[Piece]]:
    """Append one run of samples that begins `offset` samples into the block."""
    rate, n = block.sample_rate_hz, values.shape[0]
    t_ns, sequence = block.t_ns + round(offset / rate * 1e9), block.sequence + offset
    if n == 0:
        return state, []
    clock = state.clock if rate == state.rate_hz else StreamClock()
    begun = AlignState(t_ns, n, sequence + n, rate, state.dropped, clock=clock.begin(), shown=state.shown)
    if state.n_run == 0:
        return begun, [Piece(t_ns, values, None, rate)]
    due_ns = state.t_next_ns()
    late_s = (t_ns - due_ns) * 1e-9
    if rate != state.rate_hz:
        reason = f"sample rate changed from {state.rate_hz:g} to {rate:g} Hz"
        return begun, [Piece(t_ns, values, Gap(due_ns, max(late_s, 0.0), reason), rate)]
    offset_ns = t_ns - due_ns + state.label_ns
    jump_s = (offset_ns - state.offset_ns) * 1e-9
    drifted_s = abs(offset_ns) * 1e-9 - _MAX_DRIFT * state.n_run / rate
    follows = (sequence == state.next_sequence and abs(jump_s) < _MAX_CLOCK_OFFSET_S) or abs(jump_s) * rate <= 0.5
    if follows and drifted_s < _MAX_CLOCK_OFFSET_S:
        shift_ns = offset_ns - state.label_ns if abs(offset_ns - state.label_ns) >= _RELABEL_NS else 0
        state = replace(
            state,
            n_run=state.n_run + n,
            next_sequence=sequence + n,
            offset_ns=offset_ns,
            label_ns=state.label_ns + shift_ns,
            late=0,
            clock=state.clock.add(state.n_run / rate, offset_ns * 1e-9, n / rate),
        )
        return state, [Piece(due_ns + shift_ns, values, None, rate, shift_ns)]
    patience = ceil(_PATIENCE_S * rate) - state.late
    if not follows and jump_s < 0 and sequence < state.next_sequence and patience > 0:
        # Repeated or late: keep only new samples.  The sequence number identifies them, unless it restarted with another file.
        behind = state.next_sequence - sequence
        if abs(jump_s + behind / rate) >= _MAX_CLOCK_OFFSET_S:
            behind = min(behind, round(-jump_s * rate))
        known = min(n, max(1, behind), patience)  # in samples: the patience ends at the same sample for any block size
        state = replace(state, dropped=state.dropped + known, late=state.late + known)
        return _place(state, block, values[known:], offset + known)
    if follows:
        reason = f"{CLOCK}: {offset_ns * 1e-9:+.3f} s in {state.n_run / rate:.0f} s"
    elif sequence > state.next_sequence and jump_s > 0:
        reason = f"{sequence - state.next_sequence} samples missing"
    else:
        reason = f"the clock jumped by {late_s:+.3f} s"
    return begun, [Piece(t_ns, values, Gap(due_ns, max(late_s, 0.0), reason), rate)]
