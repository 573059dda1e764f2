"""Start of a first fit from the recording's own modes, for a drawing that is far off or lacks modes that the recording has."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import Annotated

import numpy as np
from scipy.optimize import least_squares

from monitor.core import Array, ComplexArray, LagSums, Skipped, Window, parallel_map
from monitor.diagnosis.initial_fit import first_guess
from monitor.diagnosis.missing_modes import is_distinct, mac
from monitor.diagnosis.plan import FAR
from monitor.diagnosis.score_test import log_evidence
from monitor.identification import SelectionSettings, SsiSettings, identify
from monitor.inference import MapEstimate, ObservedSpectra, Posterior, maximize_posterior, tried
from monitor.model import EFFECTS, Effect, Modes, Peak

_RATE = 2.2
"""Sampling rate of the correlation functions, over the band's upper end. [ratio; Nyquist's 2, and a little more]"""
_BLOCK_ROWS = 40
"""Block rows of the subspace identification; lags of twice as many samples span two periods of the lowest frequency of the band.
[count; the band begins at a twentieth of the lowpass's cutoff]"""
_MAX_ORDER = 60
"""Largest order: thirty modes. [count; cost]"""
_FREQUENCY_STD = 0.005
"""Standard deviation of the logarithm of a frequency that averaged spectra give. [1; bias of the taper: half a bin]"""
_SHAPE_STD = 0.05
"""Standard deviation of a component of a shape whose largest component is 1. [1; judgement]"""
_MISSING_COST = 8.0
"""Cost of a mode of the model that the recording does not show. [nats; judgement]"""
_MIN_MAC = 0.3
"""Least modal assurance criterion of a mode with one of the model, whose stiffnesses may be far off. [1; judgement]"""
_MAX_LOG_RATIO = 0.5
"""Largest logarithm of the ratio of their frequencies. [1; judgement: a factor of 1.65]"""
_N_ASSIGNMENTS = 12
"""Assignments of modes that are followed to fitted stiffnesses. [count; cost]"""
_N_SPECTRAL_FITS = 3
"""Fitted stiffnesses from which the spectra are fitted. [count; cost]"""
_LEAST_POWER = 0.1
"""Least share of the measured power at its peak with which a mode that the model lacks begins. [ratio; judgement]"""
_SAME_STIFFNESS = 0.02
"""Largest difference of the logarithms of two starts' stiffnesses that count as one. [1; judgement]"""


@dataclass(frozen=True, eq=False, slots=True)
class ModalStart:
    """Stiffnesses and masses with which the model has some of the recording's modes, and the modes that the model lacks."""

    structure: Annotated[Array, "p+n"]
    """Logarithms of stiffnesses, then of masses."""
    cost: float
    """Half the sum of squared deviations from the modes and from the prior, nats."""
    damping: Annotated[Array, "n"]
    """Logarithms of the damping ratios of all modes of the model."""
    missing: tuple[Effect, ...]
    """Modes that the model lacks, at their first sizes."""


@dataclass(frozen=True, eq=False, slots=True)
class IdentifiedMode:
    """Mode of a recording, with its real shape."""

    frequency_hz: float
    damping_ratio: float
    shape: Annotated[Array, "c"]
    """The largest component is 1."""


def identify_modes(
    observed: ObservedSpectra, drawn: Modes, sensors: Annotated[Array, "c n"]
) -> tuple[IdentifiedMode, ...]:
    """Identify the modes of a recording in its averaged spectra, lowest frequency first.

    The correlation functions, inverse transforms of the spectra, take the place of lag sums in the subspace identification.
    """
    window = _window(observed)
    ssi = SsiSettings(uncertainty=False, block_rows=_BLOCK_ROWS, max_order=_MAX_ORDER)
    select = SelectionSettings(min_frequency_hz=float(observed.band.hz[0]), max_modes=drawn.frequencies_hz.size)
    past = tuple(range(sensors.shape[0]))
    found = identify(window, past, drawn, sensors, ssi, select, cutoff_hz=float(observed.band.hz[-1]))
    if isinstance(found, Skipped):
        return ()
    rows = chain(
        zip(found.frequencies_hz.tolist(), found.damping_ratio.tolist(), found.shapes, strict=True),
        ((m.frequency_hz, m.damping_ratio, m.shape) for m in found.others),
    )
    modes = (IdentifiedMode(hz, ratio, np.asarray(shape.real, dtype=float)) for hz, ratio, shape in rows)
    return tuple(sorted(modes, key=lambda m: m.frequency_hz))


def _window(observed: ObservedSpectra) -> Window:
    """Transform the mean spectra of all classes to correlation functions, in the form of a window's lag sums."""
    band, n = observed.band, observed.segments.samples
    spectra = np.tensordot(observed.counts / observed.counts.sum(), observed.spectra, axes=1) / band.gain[:, None, None]
    rate_hz, lags = _RATE * float(band.hz[-1]), 2 * _BLOCK_ROWS
    waves = np.exp(2.0j * np.pi * np.outer(np.arange(lags) / rate_hz, band.hz))
    # The first factor of a lag sum is the earlier one: the transpose of the correlation.
    total = 2.0 * band.bin_hz * n * np.einsum("fab,tf->tba", spectra, waves).real
    c = total.shape[1]
    ends = np.zeros((lags - 1, c))
    sums = LagSums(total[None], np.zeros((1, lags, c)), np.zeros(c), np.array([n]), ends, ends, total)
    return Window(0, 0, n / rate_hz, rate_hz, sums, 0, (), band.bin_hz, 0)


def find_modal_starts(posterior: Posterior) -> tuple[ModalStart, ...]:
    """Find the stiffnesses and masses with which the model has as many of the recording's modes as it can, best first.

    Which of the recording's modes are the model's is not known: torsion may have the shapes of the modes that the model has.
    So several assignments are tried.  A mode of the model is not exchanged for one that it lacks: where some mode of the model
    has no counterpart, the model lacks none.
    """
    context, prior = posterior.context, posterior.prior
    modes = identify_modes(posterior.observed, prior.model.modes(), context.sensors)
    costs = _assignment_costs(posterior, modes)
    starts: list[ModalStart] = []
    for assignment in _best_assignments(costs):
        start = _fit_structure(posterior, modes, assignment)
        known = [s for s in starts if np.abs(s.structure - start.structure).max() < _SAME_STIFFNESS]
        starts += [] if known else [start]
    return tuple(sorted(starts, key=lambda s: s.cost)[:_N_SPECTRAL_FITS])


def fit_from_modes(posterior: Posterior) -> tuple[tuple[MapEstimate, float], ...]:
    """Fit the spectra from every start by the recording's modes, best first.

    Return each fit, with the modes that the model lacks as effects, and its log evidence: the log posterior less the cost of the
    effects' parameters, nats.
    """

    def fitted(start: ModalStart) -> MapEstimate:
        return maximize_posterior(posterior, *_scaled_to_power(posterior, start), iterations=FAR)

    starts = find_modal_starts(posterior)
    whole = parallel_map(lambda start: tried(lambda: fitted(start), None), starts)
    found = parallel_map(partial(_with_evidence, posterior), [fit for fit in whole if fit and fit.is_possible])
    return tuple(sorted(found, key=lambda pair: -pair[1]))


def has_same_structure(posterior: Posterior, one: MapEstimate, other: MapEstimate) -> bool:
    """Decide if two fits have the same stiffnesses and masses."""
    both = slice(posterior.layout.stiffness.start, posterior.layout.masses.stop)
    return bool(np.abs(one.x[both] - other.x[both]).max() < _SAME_STIFFNESS)


def _with_evidence(posterior: Posterior, fit: MapEstimate) -> tuple[MapEstimate, float]:
    """Refit with those modes only that can be told from the model's, unless all of them explain more.

    A structure may turn and sway at nearly the same frequencies, and without its torsion no stiffness explains the spectra.
    Return the fit and its log evidence, nats.
    """
    kept = tuple(e for i, e in enumerate(fit.effects) if is_distinct(posterior, fit, i))
    whole = fit, log_evidence(posterior, fit)
    if kept == fit.effects:
        return whole
    fit = maximize_posterior(posterior, fit.x, kept, iterations=FAR)
    return max((fit, log_evidence(posterior, fit)), whole, key=lambda pair: pair[1])


def _scaled_to_power(posterior: Posterior, start: ModalStart) -> tuple[Annotated[Array, "p"], tuple[Effect, ...]]:
    """Guess the excitation of a start, and scale the modes that the model lacks to the measured power."""
    layout, mean = posterior.layout, posterior.prior.mean.copy()
    mean[: layout.masses.stop], mean[layout.damping] = start.structure, start.damping
    x = first_guess(replace(posterior, prior=replace(posterior.prior, mean=mean)))
    counts, hz = posterior.observed.counts, posterior.observed.band.hz

    def power(spectra: ComplexArray, at: int) -> float:
        return float(np.einsum("k,kaa->", counts, spectra[:, at]).real)

    without, scaled = posterior.scatter(x, ()), []
    for effect in start.missing:
        at = int(np.abs(hz - effect.extra_modes(posterior.context)[0].frequency_hz).argmin())
        measured, base = power(posterior.observed.spectra, at), power(without, at)
        own = power(posterior.scatter(x, (effect,)), at) - base
        if not own > 0.0:
            continue  # it moves no channel by more than rounding
        factor = np.sqrt(max(measured - base, _LEAST_POWER * measured) / own)
        scaled.append(effect.at(np.r_[effect.coordinates[:2], factor * effect.coordinates[2:]]))
    return x, tuple(scaled)


def _assignment_costs(posterior: Posterior, modes: tuple[IdentifiedMode, ...]) -> Annotated[Array, "model identified"]:
    """Compute the cost, nats, of each identified mode as counterpart of each mode of the model in the band; maybe infinite."""
    drawn, prior, band = posterior.prior.model.modes(), posterior.prior, posterior.observed.band
    n = int(np.count_nonzero(drawn.frequencies_hz < band.hz[-1]))
    shapes = (posterior.context.sensors @ drawn.shapes[:, :n]).T
    stiffness = posterior.layout.stiffness
    # Stories that are off by chance move a frequency less than one story's stiffness moves: all of them together count.
    ln_std = 0.5 * np.sqrt(1.0 / np.diag(prior.precision)[stiffness].mean())
    out = np.full((n, len(modes)), np.inf)
    for j in range(n):
        for i, mode in enumerate(modes):
            ratio, alike = np.log(mode.frequency_hz / drawn.frequencies_hz[j]), mac(mode.shape, shapes[j])
            if abs(ratio) < _MAX_LOG_RATIO and alike > _MIN_MAC:
                out[j, i] = 0.5 * (ratio / ln_std) ** 2 + _MISSING_COST * (1.0 - alike)
    return out


def _best_assignments(costs: Annotated[Array, "model identified"]) -> list[tuple[int | None, ...]]:
    """List the cheapest assignments of identified modes to the model's, in the order of frequencies; some modes may have none."""
    kept: list[tuple[float, tuple[int | None, ...]]] = [(0.0, ())]
    for row in costs:
        longer: list[tuple[float, tuple[int | None, ...]]] = []
        for cost, assigned in kept:
            last = max((i for i in assigned if i is not None), default=-1)
            longer.append((cost + _MISSING_COST, (*assigned, None)))
            longer += [(cost + row[i], (*assigned, i)) for i in range(last + 1, row.size) if np.isfinite(row[i])]
        kept = sorted(longer, key=lambda item: item[0])[:_N_ASSIGNMENTS]
    return [assigned for _, assigned in kept]


def _fit_structure(
    posterior: Posterior, modes: tuple[IdentifiedMode, ...], assignment: tuple[int | None, ...]
) -> ModalStart:
    """Fit stiffnesses and masses to the assigned modes by least squares, beside their prior."""
    layout, prior, context = posterior.layout, posterior.prior, posterior.context
    both = slice(layout.stiffness.start, layout.masses.stop)
    mean, root = prior.mean[both], np.linalg.cholesky(prior.precision[both, both]).T
    pairs = [(j, modes[i]) for j, i in enumerate(assignment) if i is not None]

    def residuals(structure: Array) -> Array:
        k = layout.stiffness.stop - layout.stiffness.start
        model = prior.model.with_stiffness(np.exp(structure[:k])).with_masses(np.exp(structure[k:]))
        found = tried(model.modes, None)
        if found is None:
            return np.full(structure.size + len(pairs) * (1 + len(context.channels)), 1e6)
        rows = [root @ (structure - mean)]
        for j, mode in pairs:
            shape = context.sensors @ found.shapes[:, j]
            scaled = shape * (shape @ mode.shape) / (shape @ shape)
            rows += [np.log(found.frequencies_hz[[j]] / mode.frequency_hz) / _FREQUENCY_STD]
            rows += [(scaled - mode.shape) / _SHAPE_STD]
        return np.concatenate(rows)

    fit = least_squares(residuals, mean, x_scale=1.0 / np.sqrt(np.diag(prior.precision)[both]), max_nfev=30)
    damping = prior.mean[layout.damping].copy()
    for j, mode in pairs:
        damping[j] = np.log(mode.damping_ratio)
    assigned = {i for i in assignment if i is not None}
    others = [mode for i, mode in enumerate(modes) if i not in assigned and None not in assignment]
    missing = tuple(_as_effect(posterior, mode) for mode in others)
    n_none = sum(i is None for i in assignment)
    return ModalStart(fit.x, float(fit.cost) + n_none * _MISSING_COST, damping, missing)


def _as_effect(posterior: Posterior, mode: IdentifiedMode) -> Effect:
    """Make the effect of a mode that the model lacks, at its first size."""
    context = posterior.context
    typical = posterior.conditions[posterior.n_classes // 2]
    (kind,) = (kind for kind in EFFECTS.values() if kind.repeatable)
    effect = kind.at_peak("frame", Peak(mode.frequency_hz, mode.shape), context, typical)
    assert effect is not None
    return effect.at(np.r_[effect.coordinates[0], np.log(mode.damping_ratio), effect.coordinates[2:]])
