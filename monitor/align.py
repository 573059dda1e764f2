"""Blocks to one gapless run of samples in the structure's channel order; everything else is a gap."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from drivers.base import SampleBlock
from monitor.errors import BadInputError
from monitor.results import Array, Gap

_MAX_CLOCK_OFFSET_S = 1.0


@dataclass(frozen=True, slots=True)
class AlignState:
    """Where the stream stands."""

    t_run_ns: int
    """UTC of the current run's first sample."""
    n_run: int
    """Samples in the current run; 0 before the first."""
    next_sequence: int
    rate_hz: float
    dropped: int
    """Samples thrown away: repeated, late or not finite."""

    def t_next_ns(self) -> int:
        """When the next sample of the run is due."""
        return self.t_run_ns + round(self.n_run / self.rate_hz * 1e9)


def start() -> AlignState:
    """State before the first sample."""
    return AlignState(t_run_ns=0, n_run=0, next_sequence=0, rate_hz=1.0, dropped=0)


@dataclass(frozen=True, eq=False, slots=True)
class Piece:
    """Consecutive finite samples; `gap` tells what was lost before them, if anything."""

    t_ns: int
    values: Array
    """Shape (n_samples, c), m/s^2, float64."""
    gap: Gap | None
    rate_hz: float


def select(block: SampleBlock, channels: tuple[str, ...]) -> Array:
    """The structure's channels of a block, shape (n_samples, c), m/s^2.

    Raises
    ------
    BadInputError
        If a channel is missing or the unit is not m/s^2.
    """
    missing = [name for name in channels if name not in block.channels]
    if missing:
        raise BadInputError(
            f"{block.topic}: channel {', '.join(missing)} of the structure file is not in the data, which has "
            f"{', '.join(block.channels)}; name the channels alike"
        )
    if block.unit != "m/s^2":
        raise BadInputError(f"{block.topic}: unit {block.unit!r}, expected 'm/s^2'")
    columns = [block.channels.index(name) for name in channels]
    if block.channels == channels:
        return np.asarray(block.samples, dtype=np.float64)
    return block.samples[:, columns].astype(np.float64)


def step(state: AlignState, block: SampleBlock, channels: tuple[str, ...]) -> tuple[AlignState, list[Piece]]:
    """Place a block in the stream.

    Returns
    -------
    state : AlignState
    pieces : list of Piece
        In order; empty if nothing of the block is new.
    """
    values = select(block, channels)
    if np.isfinite(values).all():
        return _place(state, block, values, 0)
    finite = np.asarray(np.isfinite(values).all(axis=1))
    pieces: list[Piece] = []
    edges = np.flatnonzero(np.diff(finite)) + 1
    for begin, end in zip([0, *edges], [*edges, len(finite)], strict=True):
        if finite[begin]:
            state, new = _place(state, block, values[begin:end], int(begin))
            pieces.extend(new)
        else:
            state = replace(state, dropped=state.dropped + int(end - begin))
    return state, pieces


def _place(state: AlignState, block: SampleBlock, values: Array, offset: int) -> tuple[AlignState, list[Piece]]:
    """One run of finite samples that begins `offset` samples into the block."""
    rate, n = block.sample_rate_hz, values.shape[0]
    t_ns, sequence = block.t_ns + round(offset / rate * 1e9), block.sequence + offset
    if n == 0:
        return state, []
    begun = AlignState(t_ns, n, sequence + n, rate, state.dropped)
    if state.n_run == 0:
        return begun, [Piece(t_ns, values, None, rate)]
    late_s = (t_ns - state.t_next_ns()) * 1e-9
    if rate != state.rate_hz:
        reason = f"sample rate changed from {state.rate_hz:g} to {rate:g} Hz"
        return begun, [Piece(t_ns, values, Gap(state.t_next_ns(), max(late_s, 0.0), reason), rate)]
    in_sequence = sequence == state.next_sequence
    if (in_sequence and abs(late_s) < _MAX_CLOCK_OFFSET_S) or abs(late_s) * rate <= 0.5:
        t_ns = state.t_next_ns()
        state = replace(state, n_run=state.n_run + n, next_sequence=sequence + n)
        return state, [Piece(t_ns, values, None, rate)]
    if late_s < 0 and sequence < state.next_sequence:  # repeated or late: keep only what is new
        known = min(n, max(1, round(-late_s * rate)))
        state = replace(state, dropped=state.dropped + known)
        return _place(state, block, values[known:], offset + known)
    if sequence > state.next_sequence and late_s > 0:
        reason = f"{sequence - state.next_sequence} samples missing"
    else:
        reason = f"the clock jumped by {late_s:+.3f} s"
    return begun, [Piece(t_ns, values, Gap(state.t_next_ns(), max(late_s, 0.0), reason), rate)]
