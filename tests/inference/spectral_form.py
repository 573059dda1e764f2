"""The cross-spectra that are expected of a system under white forces."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from monitor.core import ComplexArray
from monitor.inference.cross_spectra import Band, Excitation, cross_spectra
from monitor.model import Condition, Context, Effect, System


def expected(
    system: System, effects: Sequence[Effect], force: float, band: Band, context: Context, condition: Condition
) -> ComplexArray:
    """Of forces of one density on every floor, N^2/Hz, seen by channels without noise."""
    forces = Excitation(np.full(context.structure.n_dofs, force), np.zeros(len(context.channels)))
    return cross_spectra(system, effects, forces, band, context, condition)
