"""The measured ground motion on its way to the events: aligned and filtered as the floors' samples are."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from drivers.base import SampleBlock
from monitor.core import Array
from monitor.signals import Conditioner, ConditionState, FrontEnd, alignment


@dataclass(frozen=True, eq=False, slots=True)
class Ground:
    """Latest samples of the measured ground motion."""

    t_ns: int
    """UTC of the first sample, less the delay of its filter."""
    rate_hz: float
    values: Array
    """Shape (n,), m/s^2."""


@dataclass(frozen=True, eq=False, slots=True)
class GroundState:
    """State between blocks."""

    align: alignment.AlignState = field(default_factory=alignment.start)
    t0_ns: int = 0
    """UTC of the first sample since a gap."""
    conditioner: Conditioner | None = None
    """Filter of the samples; None before the first."""
    condition: ConditionState | None = None


def step(state: GroundState, block: SampleBlock, front_end: FrontEnd) -> tuple[GroundState, list[Ground]]:
    """Filter the first channel of a block of ground motion.

    Returns
    -------
    GroundState
    list of Ground

    Raises
    ------
    BadInputError
        If the unit is not that of the topic, or the rate is absurd.
    """
    align, pieces = alignment.step(state.align, block, block.channels[:1])
    t0_ns, before, condition, out = state.t0_ns, state.conditioner, state.condition, []
    for piece in pieces:
        conditioner: Conditioner = front_end.conditioner(piece.rate_hz)
        if condition is None or piece.gap is not None or before is None or piece.rate_hz != before.rate_in_hz:
            before, t0_ns, condition = conditioner, piece.t_ns, conditioner.start(1)
        t0_ns += piece.shift_ns
        at_ns = t0_ns + round((condition.n_out / conditioner.rate_hz - conditioner.delay_s) * 1e9)
        condition, values = conditioner.step_block(condition, piece.values)
        if values.size:
            out.append(Ground(at_ns, conditioner.rate_hz, np.ascontiguousarray(values[:, 0])))
    return GroundState(align, t0_ns, before, condition), out
