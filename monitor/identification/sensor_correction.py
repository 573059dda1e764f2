"""Correction of identified modes for the known effects of sensors and acquisition: gains, signs, swaps, lags, the clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated

import numpy as np

from monitor.core import Array, ComplexArray, ModalEstimate
from monitor.model import Condition, Context, Effect


def response(effects: Sequence[Effect], hz: float, context: Context) -> Annotated[ComplexArray, "c c"]:
    """Compute the frequency response of the linear sensor effects at `hz`: true channels to measured ones."""
    n, c = context.structure.n_stories, len(context.channels)
    anywhere = Condition(np.ones(n), np.ones(n), np.ones(context.structure.n_dofs), np.ones(c))
    out = np.eye(c, dtype=complex)
    for effect in effects:
        factor = None if effect.nonlinear else effect.response(np.array([hz]), context, anywhere)
        if factor is not None:
            out = factor[0] @ out
    return out


def seen_by_sensors(effects: Sequence[Effect], context: Context) -> Annotated[Array, "c n"]:
    """Apply the sensor effects at 0 Hz to the sensor matrix: measured shapes are matched by the result."""
    return np.asarray(response(effects, 0.0, context).real @ context.sensors)


def true_channels(effects: Sequence[Effect], context: Context, rows: tuple[int, ...]) -> tuple[int, ...]:
    """Find the channels (0 = first) whose motion the measured channels `rows` hold: others where two cables are swapped."""
    return tuple(np.abs(response(effects, 0.0, context)[list(rows)]).argmax(axis=1).tolist())


def correct_modes(
    modes: ModalEstimate,
    effects: Sequence[Effect],
    context: Context,
    rows: tuple[int, ...] | None = None,
    true_channels: tuple[int, ...] | None = None,
) -> ModalEstimate:
    """Remove the sensor effects and the clock error from identified modes; the largest component of each shape is 1 again.

    The shapes hold the channels `rows`, and without the effects `true_channels`; by default all.
    """
    clock = float(np.prod([e.clock_factor for e in effects]))
    shapes, deviations = modes.shapes.copy(), modes.deviations.copy()
    factor = None if modes.weight_factor is None else modes.weight_factor.copy()

    def back_at(hz: float) -> ComplexArray:
        """Compute the inverse of the response at a frequency of the wrong clock."""
        forward = response(effects, hz * clock, context)
        return np.asarray(np.linalg.inv(forward if rows is None else forward[np.ix_(rows, true_channels or rows)]))

    for i, hz in enumerate(modes.frequencies_hz):
        back = back_at(hz)
        true = back @ modes.shapes[i]
        largest = int(np.abs(true).argmax())
        shapes[i] = true / true[largest]
        for part in (deviations, factor):
            if part is not None:
                part[:, i, 2:] = _propagate(part[:, i, 2:], back, true, largest)
    others = []
    for mode in modes.others:
        true = back_at(mode.frequency_hz) @ mode.shape
        f, std = clock * mode.frequency_hz, clock * mode.frequency_std_hz
        others.append(replace(mode, frequency_hz=f, frequency_std_hz=std, shape=true / true[np.abs(true).argmax()]))
    return replace(
        modes,
        frequencies_hz=clock * modes.frequencies_hz,
        shapes=shapes,
        deviations=deviations,
        weight_factor=factor,
        others=tuple(others),
    )


def _propagate(rows: Annotated[Array, "rows 2c"], back: ComplexArray, true: ComplexArray, largest: int) -> Array:
    """Propagate deviations of a shape, real then imaginary parts, through `back` and the normalization."""
    c = true.size
    moved = (rows[:, :c] + 1j * rows[:, c:]) @ back.T
    moved = (moved - moved[:, [largest]] * (true / true[largest])) / true[largest]
    return np.hstack([moved.real, moved.imag])
