"""Which poles are modes: stabilisation over orders, and the match to the model's modes.

References
----------
S.-K. Au, Uncertainty law in ambient modal identification, part I, Mechanical Systems and Signal Processing 48 (2014) 15-33.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import ceil, log

import numpy as np
from pydantic import Field

from monitor.core import Array, ComplexArray, ModalEstimate, Settings, Skipped, Window
from monitor.identification.ssi import PoleTable, Realisation, SsiSettings, realise, state_space
from monitor.identification.ssi import poles as all_poles
from monitor.identification.ssi_uncertainty import mode_deviations
from monitor.model import Modes

_BAND = 0.45
"""Share of the sampling rate up to which modes are looked for. [ratio; the lowpass: 0.4 of the rate, and a little
more]"""
_ORDERS_PER_MODE = 6
"""Least largest order for each mode looked for. [count; a mode needs two, and must be stable in half of the orders that
have room]"""
_RATE_STEPS = 0.7
"""Advised rate, in steps of 5 Hz, for each Hz of the highest mode looked for. [1; the lowpass: a cutoff of 1.4 times
the highest mode is 0.4 of the rate]"""
_SPLIT = 4.0
"""Standard deviation of a frequency, over what ambient vibration allows, from which the order is taken to split the
mode. [ratio; simulation: white and coloured forces give 1 to 3.5; measured frames: earthquakes give 3 to 43]"""


class SelectionSettings(Settings):
    """What makes a pole a mode."""

    min_frequency_hz: float = Field(default=0.2, gt=0)
    """Poles below are no modes."""
    max_damping_ratio: float = Field(default=0.15, gt=0, lt=1)
    """Poles damped more are no modes."""
    stable_frequency: float = Field(default=0.01, gt=0)
    """Largest relative change of frequency from one order to the next for a stable pole."""
    stable_mac: float = Field(default=0.95, gt=0, lt=1)
    """Least modal assurance criterion between the two."""
    min_stable_share: float = Field(default=0.5, gt=0, le=1)
    """Share of the orders with room for all modes in the band in which a mode must be stable."""
    max_frequency_ratio: float = Field(default=1.5, gt=1)
    """A mode farther than this factor from the model's is not its counterpart."""
    min_model_mac: float = Field(default=0.5, ge=0, lt=1)
    """A mode less like the model's shape than this is not its counterpart."""
    max_modes: int = Field(default=8, ge=1)
    """So many of the model's lowest modes are looked for."""
    required_modes: int = Field(default=4, ge=1)
    """So many of the lowest must be found; higher ones are used where they show."""


def expected_modes(reference: Modes, highest_hz: float, select: SelectionSettings) -> tuple[int, ...]:
    """Which of the model's modes (0 = lowest) a recording up to `highest_hz` should show."""
    n = min(int(np.count_nonzero(reference.frequencies_hz < highest_hz)), select.max_modes)
    return tuple(range(n))


def advice(
    reference: Modes, rate_hz: float, cutoff_hz: float, ssi: SsiSettings, select: SelectionSettings
) -> str | None:
    """What to set where the lags do not span the lowest mode's period, which then comes out late and uncertain; else None."""
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
        f"lags of {span_s:.2g} s do not span the lowest mode's period of {period_s:.2g} s: set {' and '.join(better)}"
    )


def identify(
    window: Window,
    past: tuple[int, ...],
    reference: Modes,
    sensors: Array,
    ssi: SsiSettings,
    select: SelectionSettings,
    wanted: tuple[int, ...] | None = None,
    cutoff_hz: float | None = None,
    refiner: Callable[[ModalEstimate], ModalEstimate] | None = None,
) -> ModalEstimate | Skipped:
    """Modes of a window: every order, stabilisation, and the model's counterparts.

    Parameters
    ----------
    past : tuple of int
        Reference columns.
    reference : Modes
        The model's modes, to which the identified ones are matched.
    sensors : ndarray, shape (c, n)
        Picks the sensors out of the model's floors.
    wanted : tuple of int, optional
        The model's modes to look for, in the order that the estimate is to have; by default those in the band.
    cutoff_hz : float, optional
        Of the lowpass that the samples went through.
    refiner : callable, optional
        Betters an estimate that has no deviations yet and gives it its own; where it hands the same back, they follow from the
        subspace identification, whose costly covariance is formed then alone.

    Returns
    -------
    ModalEstimate or Skipped
        Skipped names the model's required modes that no stable pole matches.
    """
    if wanted is None:
        wanted = expected_modes(reference, _BAND * window.rate_hz, select)
    if not wanted:
        return Skipped("every mode of the model lies beyond the band; check the units of masses and stiffness")
    max_order = max(ssi.max_order, _ORDERS_PER_MODE * len(wanted))
    shapes = (sensors @ reference.shapes[:, list(wanted)]).T
    band_hz, damping = (select.min_frequency_hz, _BAND * window.rate_hz), (0.0, select.max_damping_ratio)
    cutoff = 0.5 if cutoff_hz is None else cutoff_hz / window.rate_hz
    realisation = realise(window.sums, ssi, past, max_order, cutoff)
    poles = all_poles(realisation, range(2, max_order + 1, 2), window.rate_hz, band_hz, damping)
    stable = _stable(poles, select, realisation.singular_values.size < max_order)
    in_band = int(np.count_nonzero(reference.frequencies_hz < cutoff * window.rate_hz))
    modes = _match(poles, stable, reference.frequencies_hz[list(wanted)], shapes, select, in_band)
    missing = [str(i + 1) for i, m in zip(wanted[: select.required_modes], modes, strict=False) if m is None]
    if missing:
        return Skipped(
            f"no stable pole for mode {', '.join(missing)} of the model (frequency and shape; "
            "check floors, signs and units of the channels, and what `check` says of the lags)"
        )
    wanted = tuple(i for i, m in zip(wanted, modes, strict=True) if m is not None)
    clusters = [m for m in modes if m is not None]
    # Canonical correlations rank all modes alike, those that are not looked for too; energy ranks those that matter first.
    crowd = min(in_band, ssi.max_order // 2 - 2) if ssi.used(window.sums.head.shape[1]) in ("CVA", "UPC") else 0
    chosen = _common_order(poles, clusters, 2 * max(len(clusters), crowd) + 4)
    if chosen is None:
        return Skipped("no order shows every mode")
    return _estimate(window, realisation, poles, stable, chosen, wanted, refiner, ssi, select)


def _stable(poles: PoleTable, select: SelectionSettings, complete: bool) -> Array:
    """1 for each pole that the order below has too.  With all states of the data seen (`complete`) the last order is believed."""
    from monitor.identification.kernels import recurring  # compiled code takes a while to load

    stable = recurring(poles.space, poles.frequency, poles.shape, select.stable_frequency, select.stable_mac)
    if complete:
        stable[poles.space == len(poles.orders) - 1] = 1.0
    return stable


def _match(
    poles: PoleTable, stable: Array, frequencies: Array, shapes: Array, select: SelectionSettings, in_band: int
) -> list[list[int] | None]:
    """For every model mode, the stable poles of its counterpart; None where there is none.

    A mode must be stable in its share of the orders that have room for all modes in the band, in a third of all at least.
    """
    from monitor.identification.kernels import IMPOSSIBLE, grouped, unlikeness

    roomy = sum(order >= 2 * in_band for order in poles.orders)
    enough = max(1.0, select.min_stable_share * min(len(poles.orders) - 1, max(roomy, len(poles.orders) // 3)))
    from scipy.optimize import linear_sum_assignment  # takes a third of a second to load

    rows = np.flatnonzero(stable)
    group = np.full(stable.size, -1)
    group[rows] = grouped(
        poles.space[rows],
        poles.frequency[rows],
        poles.shape[rows],
        2.0 * select.stable_frequency,
        select.stable_mac,
        enough,
    )
    cost = unlikeness(
        group,
        poles.frequency,
        poles.shape,
        len(poles.orders),
        np.log(frequencies),
        shapes,
        log(select.max_frequency_ratio),
        select.min_model_mac,
    )
    found: list[list[int] | None] = [None] * len(frequencies)
    for i, j in zip(*linear_sum_assignment(cost), strict=True):
        if cost[i, j] < IMPOSSIBLE:
            found[i] = np.flatnonzero(group == j).tolist()
    return found


def _common_order(poles: PoleTable, clusters: list[list[int]], enough: int) -> list[int] | None:
    """One pole a mode, all from the lowest order, from `enough` on, that shows them all with room for what is no mode.

    The exact order is a trap for data-driven identification (bias in frequency and damping); two more pairs remove
    it, and higher orders only add variance.  Noise-free data have no such orders: then the highest below.
    """
    shown = [dict(zip(poles.space[c].tolist(), c, strict=True)) for c in clusters]
    above = [s for s, order in enumerate(poles.orders) if order >= enough]
    below = [s for s, order in enumerate(poles.orders) if order < enough]
    for s in above + below[::-1]:
        if all(s in pole for pole in shown):
            return [pole[s] for pole in shown]
    return None


def _estimate(
    window: Window,
    realisation: Realisation,
    poles: PoleTable,
    stable: Array,
    rows: list[int],
    wanted: tuple[int, ...],
    refiner: Callable[[ModalEstimate], ModalEstimate] | None,
    ssi: SsiSettings,
    select: SelectionSettings,
) -> ModalEstimate:
    estimate = ModalEstimate(
        frequencies_hz=poles.frequency[rows],
        damping_ratio=poles.damping[rows],
        shapes=_scaled(poles.shape[rows]),
        model_mode=np.array(wanted, dtype=np.int64),
        deviations=np.zeros((0, len(rows), 2 + 2 * poles.shape.shape[1])),
        first=window.first_block,
        order=poles.orders[poles.space[rows[0]]],
        poles=np.stack([np.array(poles.orders, float)[poles.space], poles.frequency, poles.damping, stable], axis=1),
    )
    better = estimate if refiner is None else refiner(estimate)
    if better is not estimate or not ssi.uncertainty:
        return better
    estimate = replace(estimate, deviations=_deviations(window, realisation, poles, rows))
    return _unsplit(window, realisation, poles, rows, estimate, select)


def _scaled(shapes: ComplexArray) -> ComplexArray:
    """Shapes whose largest entries are one."""
    every, largest = np.arange(len(shapes)), np.abs(shapes).argmax(axis=1)
    scaled = shapes / shapes[every, largest][:, None]
    scaled[every, largest] = 1.0
    return np.asarray(scaled)


def _deviations(window: Window, realisation: Realisation, poles: PoleTable, rows: list[int]) -> Array:
    """Of the modes that poles of one order are."""
    space = state_space(realisation, poles.orders[poles.space[rows[0]]])
    columns = [int(np.abs(space.poles - pole).argmin()) for pole in poles.value[rows]]
    return mode_deviations(window.sums, realisation, space, columns, _scaled(poles.shape[rows]), window.rate_hz)


def _unsplit(
    window: Window,
    realisation: Realisation,
    poles: PoleTable,
    rows: list[int],
    found: ModalEstimate,
    select: SelectionSettings,
) -> ModalEstimate:
    """Each mode that is far less certain than ambient vibration allows, from the order in which it is most certain.

    Forces that are not steady, an earthquake's say, make two poles of one mode in most orders that have room for both; they
    lie somewhere about the mode, each uncertain by percents.
    """
    cycles = found.frequencies_hz * window.sums.counts.sum() / window.rate_hz
    allowed = found.frequencies_hz * np.sqrt(
        found.damping_ratio / (2.0 * np.pi * cycles)
    )  # Au, of a mode that stands alone
    split = np.flatnonzero(found.frequencies_std_hz > _SPLIT * allowed)
    if not split.size:
        return found
    deviations, chosen = found.deviations.copy(), np.array(rows)
    for m in split:
        near = np.abs(poles.frequency / poles.frequency[rows[m]] - 1.0) < 2.0 * select.stable_frequency
        alike = np.abs(poles.shape @ poles.shape[rows[m]].conj()) ** 2 > select.stable_mac
        same = np.flatnonzero(near & alike)
        told = [_deviations(window, realisation, poles, [row])[:, 0] for row in same.tolist()]
        best = int(np.argmin([(d[:, 0] ** 2).sum() for d in told]))
        chosen[m], deviations[:, m] = same[best], told[best]
    return replace(
        found,
        frequencies_hz=poles.frequency[chosen],
        damping_ratio=poles.damping[chosen],
        shapes=_scaled(poles.shape[chosen]),
        deviations=deviations,
    )
