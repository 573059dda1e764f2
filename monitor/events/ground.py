"""The measured ground motion on its way to the events: aligned and filtered as the floors' samples are."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from drivers.base import SampleBlock
from monitor.core import Array
from monitor.signals import Conditioner, ConditionState, FrontEnd, alignment


@dataclass(frozen=True, eq=False, slots=True)
class GroundState:
    """State between blocks."""

    align: alignment.AlignState = field(default_factory=alignment.start)
    rate_hz: float = 0.0
    """Rate of the source; 0 before the first sample."""
    t0_ns: int = 0
    """UTC of the first sample since a gap."""
    condition: ConditionState | None = None


def step(
    state: GroundState, block: SampleBlock, front_end: FrontEnd
) -> tuple[GroundState, list[tuple[int, float, Array]]]:
    """Filter the first channel of a block of ground motion.

    Returns
    -------
    GroundState
    list of (int, float, ndarray)
        UTC of the first sample in ns, less the filter's delay; rate in Hz; samples of shape (n,) in m/s^2.

    Raises
    ------
    BadInputError
        If the unit is not that of the topic, or the rate is absurd.
    """
    align, pieces = alignment.step(state.align, block, block.channels[:1])
    rate_hz, t0_ns, condition, out = state.rate_hz, state.t0_ns, state.condition, []
    for piece in pieces:
        conditioner: Conditioner = front_end.conditioner(piece.rate_hz)
        if condition is None or piece.gap is not None or piece.rate_hz != rate_hz:
            rate_hz, t0_ns, condition = piece.rate_hz, piece.t_ns, conditioner.start(1)
        t0_ns += piece.shift_ns
        at_ns = t0_ns + round((condition.n_out / conditioner.rate_hz - conditioner.delay_s) * 1e9)
        condition, values = conditioner.step_block(condition, piece.values)
        if values.size:
            out.append((at_ns, conditioner.rate_hz, np.ascontiguousarray(values[:, 0])))
    return GroundState(align, rate_hz, t0_ns, condition), out
