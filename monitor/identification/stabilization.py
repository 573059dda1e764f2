"""Selection of modes among the poles: stabilisation over model orders, and match to the model's modes.

References
----------
S.-K. Au, Uncertainty law in ambient modal identification, part I, Mechanical Systems and Signal Processing 48 (2014) 15-33.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import ceil, log
from statistics import median
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from monitor.core import Array, ComplexArray, ModalEstimate, OtherMode, Settings, Skipped, Window
from monitor.identification.association import KnownModes, associated
from monitor.identification.ssi import PoleTable, Realisation, SsiSettings, poles as all_poles, realise, state_space
from monitor.identification.ssi_uncertainty import mode_deviations
from monitor.model import Modes

BAND = 0.45
"""Share of the sampling rate up to which modes are looked for. [ratio; the lowpass: 0.4 of the rate, and a little
more]"""
LEAST_RECORD_S = 20.0
"""Shortest stretch of data from which modes are stated whose interval is the scatter of its blocks. [s; convention: fewer blocks
tell none]"""
LEAST_PERIODS = 10.0
"""Fewest periods of a mode in the data with which it is stated. [count; convention]"""
WITHOUT_INTERVAL = "the scatter of a mode cannot be told from so few blocks of data, and so no interval: record longer"
"""Why modes without an interval are not stated. [text; definition]"""
ORDERS_PER_MODE = 6
"""Least largest order for each mode looked for. [count; a mode needs two, and must be stable in half of the orders that
have room]"""
_RATE_STEPS = 0.7
"""Advised rate, in steps of 5 Hz, for each Hz of the highest mode looked for. [1; the lowpass: a cutoff of 1.4 times
the highest mode is 0.4 of the rate]"""
_IMPOSSIBLE = 1e3
"""Cost of a match that is not allowed. [1; definition: above any cost that occurs]"""
_NEAR = 3.0
"""Distance up to which a mode may be one that was learned though its pole is uncertain. [standard deviations; convention: three
sigma]"""
_SPLIT = 4.0
"""Standard deviation of a frequency, over what ambient vibration allows, from which the order is taken to split the
mode. [ratio; simulation: white and coloured forces give 1 to 3.5; measured frames: earthquakes give 3 to 43]"""


class SelectionSettings(Settings):
    """``[selection]``: criteria by which a pole is accepted as a mode, and as the counterpart of a model's mode."""

    min_frequency_hz: float = Field(default=0.2, gt=0)
    """Poles of lower frequency are rejected."""
    max_damping_ratio: float = Field(default=0.15, gt=0, lt=1)
    """Poles of higher damping ratio are rejected."""
    stable_frequency: float = Field(default=0.01, gt=0)
    """Largest relative change of frequency from one order to the next for a stable pole."""
    stable_mac: float = Field(default=0.95, gt=0, lt=1)
    """Least modal assurance criterion from one order to the next for a stable pole."""
    min_stable_share: float = Field(default=0.5, gt=0, le=1)
    """Share of the orders with room for all modes in the band in which a mode must be stable."""
    max_frequency_ratio: float = Field(default=1.5, gt=1)
    """Largest ratio of a mode's frequency to that of its counterpart in the model, or the inverse."""
    min_model_mac: float = Field(default=0.5, ge=0, lt=1)
    """Least modal assurance criterion between a mode and its counterpart in the model."""
    max_modes: int = Field(default=8, ge=1)
    """Number of the model's lowest modes to identify; of a building three times `required_modes`, unless the file says
    another number."""
    required_modes: int = Field(default=4, ge=1)
    """Number of the baseline's lowest modes without which the damage index is not judged.  Higher modes, and without a baseline
    all, are used where they are found."""


def expected_modes(reference: Modes, highest_hz: float, select: SelectionSettings) -> tuple[int, ...]:
    """List the model's modes (0 = lowest) that a recording up to `highest_hz` should contain.

    Examples
    --------
    >>> modes = Modes((2.0 * np.pi * np.array([2.0, 6.0, 9.0])) ** 2, np.eye(3))
    >>> expected_modes(modes, highest_hz=8.0, select=SelectionSettings())
    (0, 1)
    """
    n = min(int(np.count_nonzero(reference.frequencies_hz < highest_hz)), select.max_modes)
    return tuple(range(n))


def advice(
    reference: Modes, rate_hz: float, cutoff_hz: float, ssi: SsiSettings, select: SelectionSettings
) -> str | None:
    """Advise on settings if the lags do not span the lowest mode's period, else return None.

    With shorter lags the lowest mode is identified late and with a large uncertainty.
    """
    span_s, lowest = 2 * ssi.block_rows / rate_hz, float(reference.frequencies_hz[0])
    wanted = expected_modes(reference, cutoff_hz, select)
    if not wanted or span_s * lowest >= 1.0:
        return None
    enough = min(rate_hz, 5.0 * ceil(_RATE_STEPS * float(reference.frequencies_hz[wanted[-1]])))
    rows = ceil(0.5 * enough / lowest)
    better = [f"rate_hz = {enough:g}, cutoff_hz = {0.4 * enough:g} in [processing]"] if enough < rate_hz else []
    better += [f"block_rows = {rows} in [identification]"] if rows > ssi.block_rows else []
    period_s = 1.0 / lowest
    return (
        f"lags of {span_s:.3g} s do not span the lowest mode's period of {period_s:.3g} s: set {' and '.join(better)}"
    )


def identify(
    window: Window,
    past: tuple[int, ...],
    reference: Modes,
    sensors: Annotated[Array, "c n"],
    ssi: SsiSettings,
    select: SelectionSettings,
    wanted: tuple[int, ...] | None = None,
    cutoff_hz: float | None = None,
    refiner: Callable[[ModalEstimate], ModalEstimate] | None = None,
    known: str = "by the model",
    *,
    measured: bool = False,
    learned: KnownModes | None = None,
) -> ModalEstimate | Skipped:
    """Identify the modes of a window: poles of all orders, stabilisation, and match to the model's modes.

    The estimate may lack modes of the model, even all; it says why, and which modes are in the data beside those of the model.
    Skipped where there is no stable pole at all.  `past` are the numbers of the reference channels; `reference` are the model's
    modes, or those of an earlier time, and `known` says in words where they are from.

    Parameters
    ----------
    wanted : tuple of int, optional
        The model's modes to identify (0 = lowest), in the order of the estimate; by default those in the band.
    cutoff_hz : float, optional
        Cutoff of the lowpass of the samples, Hz.
    refiner : callable, optional
        Refines an estimate without deviations, and computes its deviations (`refine`).  If the refiner returns the estimate
        unchanged, the deviations are those of the subspace identification; their costly covariance is computed only then.
    measured : bool
        Whether the reference was measured on the structure.  Modes that then lie at one another's places are exchanged, as few
        channels do where they see both modes alike, and are no reading.
    learned : KnownModes, optional
        How healthy windows showed the reference's modes.  A mode is then known by its likelihood, and where it is not surely one
        of the reference's, it is among the others.
    """
    if wanted is None:
        wanted = expected_modes(reference, BAND * window.rate_hz, select)
    if not wanted:
        return Skipped("every mode of the model lies beyond the band; check the units of masses and stiffness")
    shapes = (sensors @ reference.shapes[:, list(wanted)]).T
    cutoff = 0.5 if cutoff_hz is None else cutoff_hz / window.rate_hz
    marked = MarkedPoles.of(window, ssi, select, past, len(wanted), cutoff, BAND * window.rate_hz)
    poles = marked.table
    in_band = int(np.count_nonzero(reference.frequencies_hz < cutoff * window.rate_hz))
    frequencies = reference.frequencies_hz[list(wanted)]
    modes, rest = _match(marked, frequencies, shapes, select, in_band, learned, in_places=measured)
    if learned is not None and ssi.uncertainty:
        near = _NEAR * np.hypot(learned.ln_f_std, select.stable_frequency)
        modes = [
            m if m is None or abs(log(_median_hz(poles, m) / f)) <= most or _is_certain(marked, m, select) else None
            for m, f, most in zip(modes, frequencies.tolist(), near.tolist(), strict=True)
        ]
    clusters = [m for m in modes if m is not None]
    # Canonical correlations rank all modes alike, also those not wanted, which need room; by energy the strong ones come first.
    crowd = min(in_band, ssi.max_order // 2 - 2) if ssi.used(window.sums.head.shape[1]) in ("CVA", "UPC") else 0
    enough = 2 * max(len(clusters), crowd) + 4
    chosen = _common_order(poles, clusters, enough)
    if chosen is None:
        return Skipped("no order shows every mode")
    beside = [
        row
        for cluster in distinct(poles, clusters, rest, select)
        for row in _common_order(poles, [cluster], enough) or []
        if poles.frequency[row] < cutoff * window.rate_hz
    ]
    others = _other_modes(marked, beside, select, with_std=ssi.uncertainty)
    missing = tuple(
        (i, _why_missing(i, f, shape, others, select, known, by_shape=learned is None))
        for i, f, shape, m in zip(wanted, frequencies.tolist(), shapes, modes, strict=True)
        if m is None
    )
    if not clusters and not others and learned is None:
        return Skipped("; ".join(why for _, why in missing))
    found = tuple(i for i, m in zip(wanted, modes, strict=True) if m is not None)
    estimate = _estimate(marked, chosen, found, refiner, ssi, select)
    if not has_intervals(estimate):
        return Skipped(WITHOUT_INTERVAL)
    return replace(estimate, others=others, missing=missing)


def has_intervals(estimate: ModalEstimate) -> bool:
    """Test that no mode is stated without scatter: a single block, or samples without noise, show none, which is no certainty."""
    return not len(estimate.deviations) or bool((estimate.frequencies_std_hz > 0.0).all())


def _median_hz(poles: PoleTable, cluster: list[int]) -> float:
    """Return the frequency of a mode, the median over its poles."""
    return float(median(poles.frequency[cluster].tolist()))


def _is_certain(marked: MarkedPoles, cluster: list[int], select: SelectionSettings) -> bool:
    """Test that a mode's middle pole is more certain than stable poles may differ: others are chance, or forces."""
    deviations = marked.deviations([cluster[len(cluster) // 2]])
    return bool((deviations[:, 0, 0] ** 2).sum() <= select.stable_frequency**2)


@dataclass(frozen=True, eq=False, slots=True)
class MarkedPoles:
    """Poles of a window for all orders, and which of them are stable."""

    window: Window
    realisation: Realisation
    table: PoleTable
    stable: Annotated[Array, "poles"]
    """1 for each pole that recurs from the next lower order, else 0."""

    @classmethod
    def of(
        cls, window: Window, ssi: SsiSettings, select: SelectionSettings, past: tuple[int, ...], n_modes: int,
        cutoff: float, highest_hz: float,
    ) -> Self:  # fmt: skip
        """Identify the poles of all orders with room for so many modes; `cutoff` is the lowpass's, in cycles per sample.

        If the orders cover all states of the data, all poles of the last one are stable.
        """
        from monitor.identification.kernels import recurring  # compiled code takes a while to load

        max_order = max(ssi.max_order, ORDERS_PER_MODE * n_modes)
        realisation = realise(window.sums, ssi, past, max_order, cutoff)
        band_hz, damping = (select.min_frequency_hz, highest_hz), (0.0, select.max_damping_ratio)
        poles = all_poles(realisation, range(2, max_order + 1, 2), window.rate_hz, band_hz, damping)
        stable = recurring(poles.space, poles.frequency, poles.shape, select.stable_frequency, select.stable_mac)
        if realisation.singular_values.size < max_order:
            stable[poles.space == len(poles.orders) - 1] = 1.0
        return cls(window, realisation, poles, stable)

    def estimate(self, rows: list[int], model_mode: NDArray[np.int64]) -> ModalEstimate:
        """Form the estimate of the poles `rows`, without deviations."""
        poles = self.table
        orders = np.array(poles.orders, float)[poles.space]
        return ModalEstimate(
            frequencies_hz=poles.frequency[rows],
            damping_ratio=poles.damping[rows],
            shapes=normalize(poles.shape[rows]),
            model_mode=model_mode,
            deviations=np.zeros((0, len(rows), 2 + 2 * poles.shape.shape[1])),
            first=self.window.first_block,
            order=int(orders[rows].max(initial=0.0)),
            poles=np.stack([orders, poles.frequency, poles.damping, self.stable], axis=1),
        )

    def deviations(self, rows: list[int]) -> Array:
        """Compute the deviations (`mode_deviations`) of modes whose poles (`rows`) are all of one order."""
        poles, window = self.table, self.window
        space = state_space(self.realisation, poles.orders[poles.space[rows[0]]])
        columns = [int(np.abs(space.poles - pole).argmin()) for pole in poles.value[rows]]
        shapes = normalize(poles.shape[rows])
        return mode_deviations(window.sums, self.realisation, space, columns, shapes, window.rate_hz)


def group_poles(marked: MarkedPoles, select: SelectionSettings, in_band: int) -> Annotated[NDArray[np.intp], "poles"]:
    """Group the stable poles of all orders into modes: the number of each pole's mode, -1 for none.

    A mode must be stable in the share `min_stable_share` of the orders with room for `in_band` modes.  At least a third of all
    orders count as such.
    """
    from monitor.identification.kernels import grouped  # compiled code takes a while to load

    poles, stable = marked.table, marked.stable
    roomy = sum(order >= 2 * in_band for order in poles.orders)
    enough = max(1.0, select.min_stable_share * min(len(poles.orders) - 1, max(roomy, len(poles.orders) // 3)))
    rows = np.flatnonzero(stable)
    group = np.full(stable.size, -1)
    near, alike = 2.0 * select.stable_frequency, select.stable_mac
    group[rows] = grouped(poles.space[rows], poles.frequency[rows], poles.shape[rows], near, alike, enough)
    return group


def _match(
    marked: MarkedPoles, frequencies: Array, shapes: Array, select: SelectionSettings, in_band: int,
    learned: KnownModes | None, *, in_places: bool,
) -> tuple[list[list[int] | None], list[list[int]]]:  # fmt: skip
    """Find for each of the model's modes the stable poles of its counterpart, None where there is none, and the other modes'.

    A model's counterparts may be as far away as drawings err; the share of orders in which a mode was found is then a better
    criterion than its frequency.  With `in_places` modes that lie at one another's places are put each at its own, or left out
    where their shapes do not allow it.
    """
    from scipy.optimize import linear_sum_assignment  # takes a third of a second to load

    from monitor.identification.kernels import compared

    poles, group = marked.table, group_poles(marked, select, in_band)
    away, mac, share = compared(group, poles.frequency, poles.shape, len(poles.orders), np.log(frequencies), shapes)
    reach = log(select.max_frequency_ratio)
    found: list[list[int] | None] = [None] * len(frequencies)
    rest = {j: np.flatnonzero(group == j).tolist() for j in range(share.size)}
    possible = (away <= reach) & (mac >= select.min_model_mac)
    if learned is not None:
        least = select.stable_frequency, 1.0 - select.stable_mac, select.min_model_mac
        matched = associated(away, mac, learned, shapes.shape[1], reach, least)
    else:
        cost = np.where(possible, 0.5 * away / reach + 2.0 * (1.0 - mac) + (1.0 - share), _IMPOSSIBLE)
        pairs = zip(*linear_sum_assignment(cost), strict=True)
        matched = {int(i): int(j) for i, j in pairs if possible[i, j]}
    for moves, is_ring in _moves(matched, group, poles.frequency, frequencies, select) if in_places else ():
        own = {place: matched[i] for i, place in moves.items()}
        is_possible = all(possible[i, j] for i, j in own.items())
        if is_ring or is_possible:
            matched = {i: j for i, j in matched.items() if i not in moves} | (own if is_possible else {})
    for i, j in matched.items():
        found[i] = rest.pop(j)
    return found, list(rest.values())


def _moves(
    matched: dict[int, int], group: NDArray[np.intp], pole_hz: Array, frequencies: Array, select: SelectionSettings
) -> list[tuple[dict[int, int], bool]]:
    """Find the modes each of which was found where the reference has the next, farther away than one mode scatters.

    They end in a ring, as no change of stiffness makes, or at a place of which no mode was found.  Where the last one was found
    at its own place, a mode has moved past another.  `matched` holds the mode of the data for each of the reference's.  Each
    result is the mode of the reference at whose place each was found, and whether they are a ring.
    """
    known = np.log(frequencies)
    places = {i: int(np.abs(known - np.log(median(pole_hz[group == j].tolist()))).argmin()) for i, j in matched.items()}
    moved = {i: p for i, p in places.items() if abs(known[i] - known[p]) > 2.0 * select.stable_frequency}
    found: list[tuple[dict[int, int], bool]] = []
    for first in sorted(moved, key=lambda i: (i in moved.values(), i)):  # a chain from its beginning
        moves, at = {}, first
        while at in moved and at not in moves and not any(at in other for other, _ in found):
            moves[at] = moved[at]
            at = moved[at]
        if moves and (at == first or at not in matched):
            found.append((moves, at == first))
    return found


def distinct(
    poles: PoleTable, clusters: list[list[int]], rest: list[list[int]], select: SelectionSettings
) -> list[list[int]]:
    """Select from `rest`, by frequency, the modes that are no second finding of another one: its frequency and shape."""
    kept: list[list[int]] = []
    for cluster in sorted(rest, key=lambda c: (-len(c), c)):
        middle = cluster[len(cluster) // 2]
        known = [one[len(one) // 2] for one in (*clusters, *kept)]
        near = np.abs(poles.frequency[known] / poles.frequency[middle] - 1.0) < 2.0 * select.stable_frequency
        alike = np.abs(poles.shape[known] @ poles.shape[middle].conj()) ** 2 > select.min_model_mac
        if not (near & alike).any():
            kept.append(cluster)
    return sorted(kept, key=lambda c: median(poles.frequency[c].tolist()))


def _why_missing(
    mode: int, frequency_hz: float, shape: Array, others: tuple[OtherMode, ...], select: SelectionSettings, known: str,
    *, by_shape: bool,
) -> str:  # fmt: skip
    """State why a mode of the model has no counterpart beside `others`."""
    says = f"mode {mode + 1} ({frequency_hz:.3g} Hz {known}): "
    nearest = min(others, key=lambda other: abs(log(other.frequency_hz / frequency_hz)), default=None)
    if nearest is None or abs(log(nearest.frequency_hz / frequency_hz)) > log(select.max_frequency_ratio):
        return says + "no stable pole near it"
    if not by_shape:
        return says + f"no mode that surely is this one; the nearest is at {nearest.frequency_hz:.3g} Hz"
    power = float(shape @ shape) * float(np.linalg.norm(nearest.shape)) ** 2
    there = f"{nearest.frequency_hz:.3g} Hz, MAC {abs(nearest.shape @ shape) ** 2 / max(power, 1e-300):.2f}"
    return says + f"no stable pole of its shape, but a mode of another one ({there}): another direction, or torsion?"


def _other_modes(
    marked: MarkedPoles, rows: list[int], select: SelectionSettings, *, with_std: bool
) -> tuple[OtherMode, ...]:
    """Form the estimates of the modes, given by one pole each, that have no counterpart in the model.

    A pole that is less certain than stable poles may differ is left out: forces that change split modes into such poles.
    """
    poles, relative = marked.table, dict.fromkeys(rows, float("nan"))
    for space in sorted(set(poles.space[rows].tolist())) if with_std else ():
        alike = [row for row in rows if poles.space[row] == space]
        squares = (marked.deviations(alike)[:, :, 0] ** 2).sum(axis=0)
        relative |= dict(zip(alike, np.sqrt(squares).tolist(), strict=True))
    return tuple(
        OtherMode(
            frequency_hz=float(poles.frequency[row]),
            frequency_std_hz=float(poles.frequency[row]) * relative[row],
            damping_ratio=float(poles.damping[row]),
            shape=normalize(poles.shape[[row]])[0],
        )
        for row in rows
        if not relative[row] > select.stable_frequency
    )


def _common_order(poles: PoleTable, clusters: list[list[int]], enough: int) -> list[int] | None:
    """Select one pole for each mode, all from the lowest order of at least `enough` that has a pole for every mode.

    At the exact order data-driven identification is biased in frequency and damping.  Two more pairs of poles remove the bias,
    and higher orders only add variance.  Noise-free data have no such orders: the highest order below is used then.
    """
    shown = [dict(zip(poles.space[c].tolist(), c, strict=True)) for c in clusters]
    above = [s for s, order in enumerate(poles.orders) if order >= enough]
    below = [s for s, order in enumerate(poles.orders) if order < enough]
    for s in above + below[::-1]:
        if all(s in pole for pole in shown):
            return [pole[s] for pole in shown]
    return None


def _estimate(
    marked: MarkedPoles,
    rows: list[int],
    wanted: tuple[int, ...],
    refiner: Callable[[ModalEstimate], ModalEstimate] | None,
    ssi: SsiSettings,
    select: SelectionSettings,
) -> ModalEstimate:
    """Form the estimate of the chosen poles (`rows`), refine it if possible, and compute its deviations."""
    estimate = marked.estimate(rows, np.array(wanted, dtype=np.int64))
    better = estimate if refiner is None or not rows else refiner(estimate)
    if better is not estimate or not ssi.uncertainty or not rows:
        return better
    estimate = replace(estimate, deviations=marked.deviations(rows))
    return replace_split_modes(marked, rows, estimate, select)


def normalize(shapes: Annotated[ComplexArray, "m c"]) -> ComplexArray:
    """Scale shapes so that the largest component of each is exactly 1."""
    every, largest = np.arange(len(shapes)), np.abs(shapes).argmax(axis=1)
    scaled = shapes / shapes[every, largest][:, None]
    scaled[every, largest] = 1.0
    return np.asarray(scaled)


def replace_split_modes(
    marked: MarkedPoles, rows: list[int], found: ModalEstimate, select: SelectionSettings
) -> ModalEstimate:
    """Take each mode that is far more uncertain than ambient vibration implies from the order of least uncertainty.

    Nonstationary forces, for example an earthquake's, split one mode into two poles in most orders that have room for both.
    The two poles scatter about the mode, each with an uncertainty of percents.
    """
    window, poles = marked.window, marked.table
    cycles = found.frequencies_hz * window.sums.counts.sum() / window.rate_hz
    # Au, for a well-separated mode.
    allowed = found.frequencies_hz * np.sqrt(found.damping_ratio / (2.0 * np.pi * cycles))
    split = np.flatnonzero(found.frequencies_std_hz > _SPLIT * allowed)
    if not split.size:
        return found
    deviations, chosen = found.deviations.copy(), np.array(rows)
    for m in split:
        near = np.abs(poles.frequency / poles.frequency[rows[m]] - 1.0) < 2.0 * select.stable_frequency
        alike = np.abs(poles.shape @ poles.shape[rows[m]].conj()) ** 2 > select.stable_mac
        same = np.flatnonzero(near & alike)
        candidates = [marked.deviations([row])[:, 0] for row in same.tolist()]
        best = int(np.argmin([(d[:, 0] ** 2).sum() for d in candidates]))
        chosen[m], deviations[:, m] = same[best], candidates[best]
    return replace(
        found,
        frequencies_hz=poles.frequency[chosen],
        damping_ratio=poles.damping[chosen],
        shapes=normalize(poles.shape[chosen]),
        deviations=deviations,
    )
