"""A stream's samples through the filters, piece by piece: a run of filters begins at each gap."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from drivers.base import SampleBlock
from monitor.core import Array
from monitor.signals import alignment, lost_samples
from monitor.signals.alignment import Piece
from monitor.signals.front_end import FrontEnd
from monitor.signals.lost_samples import LostState
from monitor.signals.resampling import Conditioner, ConditionState


@dataclass(frozen=True, eq=False, slots=True)
class FilterRun:
    """State of the filters for the samples since the last gap."""

    t0_ns: int
    """UTC of the run's first sample, by the clock as it is set now."""
    conditioner: Conditioner
    condition: ConditionState
    lost: LostState


@dataclass(frozen=True, eq=False, slots=True)
class Conditioned:
    """What the filters make of one piece."""

    begins: bool
    """Whether a run begins with it."""
    t0_ns: int
    """UTC of the run's first sample."""
    conditioner: Conditioner
    first: int
    """Number of the run's conditioned samples before these."""
    values: Annotated[Array, "n c"]
    """In the unit of the topic."""
    lost: Annotated[NDArray[np.bool_], "n c"] | None
    """Values that are made up, as a sample was lost; None where none is."""


def step(run: FilterRun | None, piece: Piece, front_end: FrontEnd) -> tuple[FilterRun, Conditioned]:
    """Condition a piece, in a new run where there is none or the piece comes after a gap.

    Examples
    --------
    >>> from monitor.signals import ProcessingSettings
    >>> front_end = FrontEnd(("a1",), ProcessingSettings(), segment_s=5.0, n_lags=50)
    >>> run, part = step(None, Piece(0, np.ones((1000, 1)), None, 1000.0), front_end)
    >>> part.begins, part.values.shape
    (True, (100, 1))
    >>> step(run, Piece(10**9, np.ones((1000, 1)), None, 1000.0), front_end)[1].first
    100
    """
    begins = run is None or piece.gap is not None
    if run is None or begins:
        conditioner, c = front_end.conditioner(piece.rate_hz), piece.values.shape[1]
        run = FilterRun(piece.t_ns, conditioner, conditioner.start(c), lost_samples.start(c))
    t0_ns = run.t0_ns + (0 if begins else piece.shift_ns)
    held, finite, lost = lost_samples.step(run.lost, piece, run.conditioner, run.condition)
    condition, values = run.conditioner.step_block(run.condition, finite)
    part = Conditioned(begins, t0_ns, run.conditioner, run.condition.n_out, values, lost)
    return FilterRun(t0_ns, run.conditioner, condition, held), part


@dataclass(frozen=True, eq=False, slots=True)
class Run:
    """Conditioned samples without a gap."""

    t_ns: int
    """UTC of the first sample."""
    conditioner: Conditioner
    values: Annotated[Array, "n c"]
    """In the unit of the topic."""


class Stream:
    """Conditioned samples of a front end's channels, kept as numbers of one type, block by block."""

    conditioner: Conditioner
    """That of the latest run."""

    def __init__(self, front_end: FrontEnd, kept_as: type[np.floating[Any]] = np.float64) -> None:
        self.front_end, self._kept_as, self._align = front_end, kept_as, alignment.start()
        self._filters: FilterRun | None = None
        self._runs: list[tuple[int, Conditioner, list[Array]]] = []

    def push(self, block: SampleBlock) -> list[tuple[Piece, Conditioned]]:
        """Condition a block's samples; return what came of each piece.

        Raises
        ------
        BadInputError
            If the unit is not that of the topic, a channel is missing, or the rate cannot be conditioned.
        """
        self._align, pieces = self.front_end.align(self._align, block)
        out = []
        for piece in pieces:
            if self._filters is None or piece.gap is not None:
                self.front_end.check_rate(piece.rate_hz)
            self._filters, part = step(self._filters, piece, self.front_end)
            if part.begins:
                self.conditioner = part.conditioner
                self._runs.append((piece.t_ns, part.conditioner, []))
            self._runs[-1][2].append(part.values.astype(self._kept_as, copy=False))
            out.append((piece, part))
        return out

    def runs(self) -> list[Run]:
        """Join the samples of every run."""
        for _, _, parts in self._runs:
            parts[:] = [np.concatenate(parts)] if len(parts) > 1 else parts
        return [Run(t_ns, conditioner, parts[0]) for t_ns, conditioner, parts in self._runs]
