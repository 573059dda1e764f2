"""What the acquisition makes of the structure's motion, taken out of identified modes: gains, signs, swaps, lags, the clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from monitor.core import Array, ComplexArray, ModalEstimate
from monitor.model import Condition, Context, Effect


def response(effects: Sequence[Effect], hz: float, context: Context) -> ComplexArray:
    """What linear sensor effects make of the true channels at a frequency, shape (c, c)."""
    n, c = context.structure.n_stories, len(context.channels)
    anywhere = Condition(np.ones(n), np.ones(n), np.ones(context.structure.n_dofs), np.ones(c))
    out = np.eye(c, dtype=complex)
    for effect in effects:
        made = None if effect.nonlinear else effect.response(np.array([hz]), context, anywhere)
        if made is not None:
            out = made[0] @ out
    return out


def seen_by_sensors(effects: Sequence[Effect], context: Context) -> Array:
    """The sensor matrix as the channels show it, shape (c, n): what measured shapes are to be recognized by."""
    return np.asarray(response(effects, 0.0, context).real @ context.sensors)


def correct_modes(modes: ModalEstimate, effects: Sequence[Effect], context: Context) -> ModalEstimate:
    """The structure's modes from those that the channels show, shapes with their largest component 1 again."""
    clock = float(np.prod([e.clock_factor for e in effects]))
    shapes, deviations = modes.shapes.copy(), modes.deviations.copy()
    factor = None if modes.weight_factor is None else modes.weight_factor.copy()
    for i, hz in enumerate(modes.frequencies_hz):
        back: ComplexArray = np.asarray(np.linalg.inv(response(effects, hz * clock, context)))
        true = back @ modes.shapes[i]
        largest = int(np.abs(true).argmax())
        shapes[i] = true / true[largest]
        for rows in (deviations, factor):
            if rows is not None:
                rows[:, i, 2:] = _carried(rows[:, i, 2:], back, true, largest)
    return replace(
        modes, frequencies_hz=clock * modes.frequencies_hz, shapes=shapes, deviations=deviations, weight_factor=factor
    )


def _carried(rows: Array, back: ComplexArray, true: ComplexArray, largest: int) -> Array:
    """First-order changes (real parts, then imaginary ones) of a shape after `back` and its normalization."""
    c = true.size
    moved = (rows[:, :c] + 1j * rows[:, c:]) @ back.T
    moved = (moved - moved[:, [largest]] * (true / true[largest])) / true[largest]
    return np.hstack([moved.real, moved.imag])
