"""Automatic choice of modes without a model: groups of stable poles over the orders, and their uncertainty.

With a model, its modes say how many to look for, and which pole is whose (`stabilization`).  Without one the number of modes
and the choice depend on each other, and are found together.  The criteria are those of `SelectionSettings`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Annotated

import numpy as np

from monitor.core import Array, ModalEstimate, Skipped, Window
from monitor.identification.short_records import own_motion, stated, stated_refined
from monitor.identification.ssi import PoleTable, SsiSettings
from monitor.identification.stabilization import (
    BAND,
    WITHOUT_INTERVAL,
    MarkedPoles,
    SelectionSettings,
    distinct,
    group_poles,
    has_intervals,
    replace_split_modes,
)
from monitor.identification.whittle import RefinementSettings, refine

Refiner = Callable[[ModalEstimate], ModalEstimate]


def identify_modes(
    window: Window,
    ssi: SsiSettings,
    select: SelectionSettings,
    refinement: RefinementSettings,
    past: tuple[int, ...] = (),
    cutoff_hz: float | None = None,
) -> ModalEstimate | Skipped:
    """Identify the modes of a window without a model, in the order of frequency, with their deviations.

    `model_mode` numbers them from 0.  `past` are the numbers of the reference channels (0 = first); all when empty.  Modes beyond
    the cutoff of the lowpass of the samples are left out.  Skipped where there is no mode.
    """
    past = past or tuple(range(window.sums.head.shape[1]))
    highest_hz = BAND * window.rate_hz if cutoff_hz is None else cutoff_hz
    cutoff = 0.5 if cutoff_hz is None else cutoff_hz / window.rate_hz
    marked = MarkedPoles.of(window, ssi, select, past, select.max_modes, cutoff, highest_hz)
    clusters = _certain(marked, _clusters(marked, select), select)
    if not clusters:
        return Skipped("no mode is stable over the orders of identification and certain enough")
    refiner = partial(refine, window, settings=refinement)
    starts = _starts(marked.table, clusters)
    estimates = [marked.estimate(rows, np.arange(len(rows))) for rows in starts]
    refined = _refine(estimates, refiner)
    if refined is not None:
        return stated_refined(refined)
    own = _deviations(marked, starts[0])
    found = replace_split_modes(marked, starts[0], replace(estimates[0], deviations=own), select)
    if not has_intervals(found):
        return Skipped(WITHOUT_INTERVAL)
    if len(window.segments) >= refinement.min_segments:
        return found
    sums = own_motion(window, found, refinement.half_band)
    simulated = None if sums is None else _deviations(replace(marked, window=replace(window, sums=sums)), starts[0])
    return stated(found, found.deviations, simulated)


def _clusters(marked: MarkedPoles, select: SelectionSettings) -> list[list[int]]:
    """Group the stable poles into modes, by frequency: each a list of rows of the table, by order.

    In how many orders a mode must be stable depends on how many orders have room for all modes, and so on their number.  It is
    increased from 0 until it is that of the groups.
    """
    count = 0
    while True:
        group = group_poles(marked, select, count)
        found = [np.flatnonzero(group == k).tolist() for k in range(group.max(initial=-1) + 1)]
        kept = distinct(marked.table, [], found, select)
        if len(kept) <= count:
            return kept
        count = len(kept)


def _certain(marked: MarkedPoles, clusters: list[list[int]], select: SelectionSettings) -> list[list[int]]:
    """Select the clusters with a pole that is more certain than stable poles may differ: the others are chance, or forces."""
    rows = [row for cluster in clusters for row in cluster]
    squares = (_deviations(marked, rows)[:, :, 0] ** 2).sum(axis=0)
    square = dict(zip(rows, squares.tolist(), strict=True))
    return [cluster for cluster in clusters if min(square[row] for row in cluster) <= select.stable_frequency**2]


def _deviations(marked: MarkedPoles, rows: list[int]) -> Annotated[Array, "blocks rows 2+2c"]:
    """Compute the deviations of poles of any orders."""
    sums, space_of = marked.window.sums, marked.table.space[rows]
    out = np.zeros((len(sums.products), len(rows), 2 + 2 * sums.head.shape[1]))
    for space in np.unique(space_of):
        alike = np.flatnonzero(space_of == space)
        out[:, alike] = marked.deviations([rows[k] for k in alike])
    return out


def _starts(poles: PoleTable, clusters: list[list[int]]) -> list[list[int]]:
    """List choices of one pole for each cluster: by the lowest order with room for all modes, then by each higher one.

    The exact order is biased; two more pairs of poles remove the bias.
    """
    orders = np.array(poles.orders)[poles.space]
    choices: list[list[int]] = []
    for order in poles.orders:
        rows = [next((row for row in cluster if orders[row] >= order), cluster[-1]) for cluster in clusters]
        if order >= 2 * len(clusters) + 4 and rows not in choices:
            choices.append(rows)
    return choices or [[cluster[-1] for cluster in clusters]]


def _refine(starts: list[ModalEstimate], refiner: Refiner) -> ModalEstimate | None:
    """Refine all modes together from the first start that converges, else in two parts where they lie furthest apart."""
    for start in starts:
        refined = refiner(start)
        if refined is not start:
            return refined
    modes = starts[0].model_mode.tolist()
    if len(modes) == 1:
        return None
    cut = 1 + int(np.diff(np.log(starts[0].frequencies_hz)).argmax())
    lower = _refine([start.only(frozenset(modes[:cut])) for start in starts], refiner)
    upper = None if lower is None else _refine([start.only(frozenset(modes[cut:])) for start in starts], refiner)
    return None if lower is None or upper is None else _joined(lower, upper)


def _joined(a: ModalEstimate, b: ModalEstimate) -> ModalEstimate:
    """Join the estimates of two groups of modes from the same segments."""
    weights = None
    if a.weight_factor is not None and b.weight_factor is not None:  # of each group alone: no covariance between them
        weights = np.concatenate(
            [np.pad(a.weight_factor, ((0, 0), (0, len(b.model_mode)), (0, 0))),
             np.pad(b.weight_factor, ((0, 0), (len(a.model_mode), 0), (0, 0)))]
        )  # fmt: skip
    return replace(
        a,
        frequencies_hz=np.concatenate([a.frequencies_hz, b.frequencies_hz]),
        damping_ratio=np.concatenate([a.damping_ratio, b.damping_ratio]),
        shapes=np.concatenate([a.shapes, b.shapes]),
        model_mode=np.concatenate([a.model_mode, b.model_mode]),
        deviations=np.concatenate([a.deviations, b.deviations], axis=1),
        order=max(a.order, b.order),
        weight_factor=weights,
    )
