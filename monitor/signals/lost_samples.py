"""Lost samples of single channels: what stands in their place before the filters, and which conditioned samples they reach."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array
from monitor.signals.alignment import Piece
from monitor.signals.resampling import Conditioner, ConditionState


@dataclass(frozen=True, eq=False, slots=True)
class LostState:
    """State between pieces of a run."""

    held: Annotated[Array, "c"]
    """Latest finite sample of each channel, m/s^2; 0 before the first."""
    pending: Annotated[NDArray[np.bool_], "c"]
    """Whether a sample since the latest conditioned one was lost."""


def start(n_channels: int) -> LostState:
    """Return the state before the first sample of a run."""
    return LostState(np.zeros(n_channels), np.zeros(n_channels, dtype=bool))


def step(
    state: LostState, piece: Piece, conditioner: Conditioner, condition: ConditionState
) -> tuple[LostState, Annotated[Array, "n c"], Annotated[NDArray[np.bool_], "out c"] | None]:
    """Hold the latest finite sample of a channel in the place of those lost, so that its offset makes no step.

    `condition` is the filters' state before the piece.  The piece's samples, all finite, are returned with the mask of the
    conditioned samples that it completes and that hold a lost one; None where none does.
    """
    values, lost = piece.values, piece.lost
    if lost is None and not state.pending.any():
        return LostState(values[-1] if len(values) else state.held, state.pending), values, None
    if lost is None:
        lost = np.zeros(values.shape, dtype=bool)
    extended = np.concatenate([state.held[None], values])
    latest = np.where(lost, 0, np.arange(1, len(extended))[:, None])
    values = np.take_along_axis(extended, np.maximum.accumulate(latest, axis=0), axis=0)
    # Conditioned sample k is complete with source sample floor(k p / q): it takes in the samples since the one before it.
    p, q = conditioner.step.numerator, conditioner.step.denominator
    n_in = condition.n_in + len(values)
    ends = np.arange(condition.n_out, -(-n_in * q // p), dtype=np.int64) * p // q - condition.n_in
    owner = np.searchsorted(ends, np.arange(len(values)))
    out = np.zeros((len(ends) + 1, values.shape[1]), dtype=bool)
    np.logical_or.at(out, owner, lost)
    out[0] |= state.pending
    complete = out[:-1]
    return LostState(values[-1], out[-1]), values, complete if complete.any() else None
