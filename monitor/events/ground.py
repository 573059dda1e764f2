"""The measured ground motion on its way to the events: aligned and filtered as the floors' samples are."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from drivers.base import SampleBlock
from monitor.core import Array
from monitor.signals import Conditioner, FilterRun, FrontEnd, alignment, conditioned


@dataclass(frozen=True, eq=False, slots=True)
class Ground:
    """Latest samples of the measured ground motion."""

    t_ns: int
    """UTC of the first sample, less the delay of its filter."""
    rate_hz: float
    values: Annotated[Array, "n"]
    """m/s^2."""


@dataclass(frozen=True, eq=False, slots=True)
class GroundState:
    """State between blocks."""

    align: alignment.AlignState = field(default_factory=alignment.start)
    filters: FilterRun | None = None
    """Filter of the samples; None before the first."""

    @property
    def conditioner(self) -> Conditioner | None:
        """The filter's design."""
        return None if self.filters is None else self.filters.conditioner


def step(state: GroundState, block: SampleBlock, front_end: FrontEnd) -> tuple[GroundState, list[Ground]]:
    """Filter the first channel of a block of ground motion.

    Raises
    ------
    BadInputError
        If the unit is not that of the topic, or the rate is absurd.
    """
    align, pieces = alignment.step(state.align, block, block.channels[:1])
    filters, out = state.filters, []
    for piece in pieces:
        filters, part = conditioned.step(filters, piece, front_end)
        rate_hz = part.conditioner.rate_hz
        if part.values.size:
            at_ns = part.t0_ns + round((part.first / rate_hz - part.conditioner.delay_s) * 1e9)
            out.append(Ground(at_ns, rate_hz, np.ascontiguousarray(part.values[:, 0])))
    return GroundState(align, filters), out
