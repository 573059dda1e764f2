"""Modes that the model lacks, added peak by peak: a structure in space has three times as many as its model in a plane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from scipy.linalg import eigh
from scipy.optimize import linear_sum_assignment

from monitor.core import Array, ComplexArray, parallel_map
from monitor.diagnosis.parameter_uncertainty import is_significant
from monitor.diagnosis.plan import FAR, LONG
from monitor.diagnosis.score_test import (
    Candidate,
    at_peak,
    best_first,
    best_of_each_kind,
    find_excess_peaks,
    fit_candidate,
    fit_roughly,
    log_evidence,
    parameter_cost,
    refine_rough_fit,
    score_candidate,
    with_tone_evidence,
)
from monitor.diagnosis.settings import DiagnosisSettings
from monitor.identification import SelectionSettings
from monitor.inference import (
    MapEstimate,
    Posterior,
    extra_mode_spectra,
    join_coordinates,
    maximize_posterior,
    require_finite,
    tried,
)
from monitor.model import EFFECTS, Effect, ExtraMode, Peak

_RESOLUTION_BINS = 2.0
"""Distance of two peaks that the segments resolve. [bins; half-width of the taper's main lobe]"""
_PEAK_BINS = 3.0
"""Bins about a peak whose power `Peak.amplitude` sums. [count; definition]"""
CERTAIN = 10.0
"""Log evidence of a mode, over that which a cause needs, from which rough fits are enough. [ratio; judgement]"""
_RELATIVE_STEP = 1e-5
"""Finite difference of a coordinate, over its unit. [ratio; rounding]"""
MAX_DAMPING = SelectionSettings().max_damping_ratio
"""Damping ratio from which a mode of the model has no peak any more. [1; as of the poles that identification accepts]"""


@dataclass(frozen=True, eq=False, slots=True)
class Resonance:
    """Mode of a fitted model with all its effects."""

    mode: ExtraMode
    """Frequency, damping and shape on the channels, under all forces that drive the mode: the floors' and its own."""
    owner: int | None
    """Index of the extra effect whose mode it is; None for a mode of the model before these effects."""


def resonances(posterior: Posterior, x: Annotated[Array, "p"], effects: Sequence[Effect]) -> list[Resonance]:
    """List the modes of a fitted model: its own, coupled ones and others.

    Of the modes of a coupled system one belongs to every mode of the uncoupled system: that with most of its motion in it.
    """
    everything, context = posterior.effects(x, effects), posterior.context_at(x)
    n_before, condition = len(everything) - len(effects), posterior.conditions[posterior.n_classes // 2]
    system = posterior.system(x, everything)
    shapes, n = eigh(system.stiffness, system.mass)[1], system.mass.shape[0]
    own: list[int | None] = [None] * n
    for i, effect in enumerate(everything):
        moved = effect.extend(system, context, condition)
        if len(moved.coupled) > len(system.coupled):
            system, own = moved, [*own, i - n_before if i >= n_before else None]
    require_finite(system.mass, system.stiffness)
    uncoupled = np.eye(system.mass.shape[0])
    uncoupled[:n, :n] = shapes
    eigenvalues, shapes = eigh(system.stiffness, system.mass)
    norms = np.sqrt(np.diag(uncoupled.T @ system.mass @ uncoupled))
    share = np.abs(uncoupled.T @ system.mass @ shapes) / norms[:, None]
    belongs = linear_sum_assignment(share, maximize=True)[1]
    forces = np.r_[np.ones(n), [mode.force_ratio for mode in system.coupled]]  # over the floors' mean
    acting = system.forced(n)
    sensors, found = system.sensors(context.sensors), []
    for i, k in enumerate(belongs):
        omega, shape = float(np.sqrt(max(eigenvalues[k], 0.0))), shapes[:, k]
        ratio = float(shape @ system.damping @ shape) / (2.0 * omega) if omega > 0.0 else np.inf
        by_forces = (sensors @ shape) * np.copysign(np.sqrt(forces @ (shape @ acting) ** 2), shape[i])
        found.append(Resonance(ExtraMode(omega / (2.0 * np.pi), ratio, by_forces), own[i]))
    for i, effect in enumerate(everything):
        owner = i - n_before if i >= n_before else None
        found += [Resonance(mode, owner) for mode in effect.extra_modes(context)]
    return found


def as_seen(
    posterior: Posterior, fit: MapEstimate, i: int, std: Annotated[Array, "p"]
) -> tuple[Effect, Annotated[Array, "q"]]:
    """Return effect i of a fit as the recording shows it, and the standard deviations of its coordinates; `std` are its own ones.

    A coupled mode is stated by the frequency, damping and shape of the coupled system's mode.
    """
    effects = fit.effects

    def seen(effect: Effect) -> Effect:
        found = resonances(posterior, fit.x, (*effects[:i], effect, *effects[i + 1 :]))
        return effect.uncoupled(next(r.mode for r in found if r.owner == i))

    effect, these = effects[i], fit.coordinates_of(i)
    if not effect.is_coupled(posterior.context):  # it is seen as it is
        return effect, std
    here = seen(effect)
    steps = np.diag(_RELATIVE_STEP * effect.units)
    moved = [seen(effect.at(effect.coordinates + step)).coordinates - here.coordinates for step in steps]
    slopes = np.array(moved) / steps.sum(axis=1)[:, None]
    own = fit.covariance[these, these]
    alone = np.sqrt(np.diag(own))
    slopes *= np.divide(std, alone, out=np.ones_like(alone), where=alone > 0.0)[:, None]
    covariance = slopes.T @ own @ slopes
    return here, np.sqrt(np.maximum(np.diag(covariance), 0.0))


def effects_at_peak(posterior: Posterior, fit: MapEstimate, peak: Peak) -> list[Effect]:
    """List the effects that a peak which the model lacks may have as its cause, at their first sizes."""
    context = posterior.context
    places = ((kind, place) for kind in EFFECTS.values() for place in kind.places_in(context))
    near = (at_peak(kind, place, peak, posterior) for kind, place in places)
    found = [_scaled_to_peak(posterior, fit, effect, peak) for effect in near if effect is not None]
    return found + [c for c in (effect.coupled(context) for effect in found) if c is not None]


def _scaled_to_peak(posterior: Posterior, fit: MapEstimate, effect: Effect, peak: Peak) -> Effect:
    """Scale the shape of a mode so that its power at a peak is the power that the model lacks there; leave other effects."""
    modes = effect.extra_modes(posterior.context)
    if not modes:
        return effect
    counts, nearest = posterior.observed.counts, int(np.abs(posterior.observed.band.hz - peak.hz).argmin())
    level = float(counts @ posterior.forces(fit.x).mean(axis=1) / counts.sum())
    own = float(np.einsum("aa->", _spectra_of(posterior, fit, modes, level)[nearest]).real)
    factor = np.sqrt(float(peak.amplitude @ peak.amplitude) / _PEAK_BINS / own)
    return (
        effect.at(np.r_[effect.coordinates[:2], factor * effect.coordinates[2:]]) if 0.0 < factor < np.inf else effect
    )


def _spectra_of(
    posterior: Posterior, fit: MapEstimate, modes: Sequence[ExtraMode], force: float
) -> Annotated[ComplexArray, "bins c c"]:
    """Compute the cross-spectra of modes under forces of a density, N^2/Hz, in the middle class."""
    everything, band = posterior.effects(fit.x, fit.effects), posterior.observed.band
    condition = posterior.conditions[posterior.n_classes // 2]
    return extra_mode_spectra(modes, everything, force, band, posterior.context_at(fit.x), condition)


def _has_peak(posterior: Posterior, fit: MapEstimate, mode: ExtraMode) -> bool:
    """Decide if a recording of a fitted model shows the peak of a mode: if the peak is worth its own parameters.

    Half the squared norm of the whitened peak is the gain of log likelihood that the peak alone brings.
    """
    middle = posterior.n_classes // 2
    force = float(posterior.forces(fit.x)[middle].mean())
    peak = _spectra_of(posterior, fit, [mode], force)
    of_class = posterior.relative_levels(fit.x)[:, None, None, None] * peak
    prediction = posterior.predict(fit.x, fit.effects)
    whitened, _ = posterior.whitened(prediction.spectra, of_class[None], prediction.data)
    return 0.5 * float(np.sum(whitened**2)) > parameter_cost(posterior, 2 + mode.shape.size)


def find_missing_modes(
    posterior: Posterior, fit: MapEstimate, settings: DiagnosisSettings, threshold: float
) -> list[list[Candidate]]:
    """Find the causes of the highest peaks that the model lacks, as long as the causes are modes of the structure.

    A mode is compared with a machine and with something that swings on a floor, at every floor.  Modes that rough fits show
    beyond doubt are found at several peaks, and fitted together; any other is fitted alone, with its rivals.  A mode needs the
    log evidence `threshold`, nats.  Return for every mode the candidates at its peak, the mode first; the last mode's fit has all
    of them.  Empty where no mode is the cause of the highest peak, or a rival may be.
    """
    looked: list[list[Candidate]] = []
    highest: list[Candidate] | None = None
    stories = posterior.layout.stiffness.stop - posterior.layout.stiffness.start
    for _ in range(stories):
        (peak,) = find_excess_peaks(posterior, fit, 1, [rough[0].fit for rough in looked])
        rough = fit_roughly(posterior, fit, likely_causes(posterior, fit, peak))
        highest = rough if highest is None else highest
        if not _is_beyond_doubt(rough, settings):
            break
        if any(_is_one_peak(posterior, rough[0].effect, others[0].effect) for others in looked):
            break  # a mode explains that peak only in part
        looked.append(rough)
    found = [rough for rough in looked if rough[0].log_evidence > threshold]
    together = _fit_together(posterior, fit, found)
    if together:
        return together
    alone = find_missing_mode(posterior, fit, settings, threshold, highest)
    return [alone] if alone else []


def likely_causes(posterior: Posterior, fit: MapEstimate, peak: Peak) -> list[Effect]:
    """List the modes that a peak which the model lacks may be, and of each other kind of cause the most likely one."""
    starts = effects_at_peak(posterior, fit, peak)
    others = best_of_each_kind(posterior, fit, [effect for effect in starts if not effect.repeatable])
    return [effect for effect in starts if effect.repeatable] + others


def _is_beyond_doubt(rough: list[Candidate], settings: DiagnosisSettings) -> bool:
    """Decide by rough fits, best first, if the cause of a peak is a mode of the structure, and nothing else can be."""
    if not (rough and rough[0].effect.repeatable):
        return False
    best = rough[0].log_evidence
    rivals = (c for c in rough if not c.effect.repeatable)
    return best > CERTAIN * settings.margin and not any(c.may_reach(best) for c in rivals)


def _is_one_peak(posterior: Posterior, one: Effect, other: Effect) -> bool:
    """Decide if the modes of two effects are one peak."""
    a, b, resolution_hz = _as_mode(one), _as_mode(other), _RESOLUTION_BINS * posterior.observed.band.bin_hz
    return a is not None and b is not None and _overlap(a, b, resolution_hz)


def _fit_together(posterior: Posterior, fit: MapEstimate, found: list[list[Candidate]]) -> list[list[Candidate]]:
    """Fit modes of several peaks together, and return those that remain plausible, with that fit."""
    while found:
        effects = (*fit.effects, *(rough[0].effect for rough in found))
        x = join_coordinates(fit.x[posterior.layout.nuisances], effects)
        whole = maximize_posterior(posterior, x, effects, iterations=LONG)
        n = len(fit.effects)
        modes = [score_candidate(posterior, fit, whole, n + i) for i in range(len(found))]
        plausible = [_is_plausible_mode(posterior, c, n + i) for i, c in enumerate(modes)]
        if all(plausible):
            return [[mode, *rough[1:]] for mode, rough in zip(modes, found, strict=True)]
        found = [rough for rough, stays in zip(found, plausible, strict=True) if stays]
    return []


def _is_plausible_mode(posterior: Posterior, candidate: Candidate, i: int) -> bool:
    """Decide if a mode, effect i of its fit, has a plausible and significant size, and may be there."""
    fit, effect = candidate.fit, candidate.effect
    std = np.sqrt(fit.covariance.diagonal()[fit.coordinates_of(i)])
    is_sized = effect.is_plausible(posterior.observed.band.hz) and is_significant(effect, std)
    return fit.is_possible and is_sized and is_credible(posterior, fit, i)


def find_missing_mode(
    posterior: Posterior,
    fit: MapEstimate,
    settings: DiagnosisSettings,
    threshold: float,
    rough: list[Candidate] | None = None,
) -> list[Candidate]:
    """Find the cause of the highest peak, if it is a mode of the structure, by full fits, as `find_missing_modes`.

    `rough` are the fits of the peak's likely causes, if they are known.
    """
    (peak,) = find_excess_peaks(posterior, fit, 1)
    rough = fit_roughly(posterior, fit, likely_causes(posterior, fit, peak)) if rough is None else rough
    if any(not c.effect.repeatable and c.may_reach(rough[0].log_evidence - settings.rival) for c in rough):
        rough = fit_roughly(posterior, fit, effects_at_peak(posterior, fit, peak))  # of every kind at all places
    if not rough or not (rough[0].effect.repeatable or lacks_modes(posterior, fit)):
        return []
    near = [c for c in rough if c.may_reach(rough[0].log_evidence - settings.rival)]
    fitted = parallel_map(lambda c: refine_rough_fit(posterior, fit, c), near)
    found = best_first(with_tone_evidence(posterior, c) for c in fitted)
    if not any(c.effect.repeatable for c in found):
        return []
    best = next(c for c in found if c.effect.repeatable)
    rivals = [c for c in found if not c.effect.repeatable]
    lead = -settings.rival if lacks_modes(posterior, fit) else settings.rival
    is_alone = not rivals or rivals[0].log_evidence < best.log_evidence - lead
    if is_alone and best.log_evidence > threshold and _is_plausible_mode(posterior, best, -1):
        return [best, *(c for c in found if c is not best)]
    return []


def lacks_modes(posterior: Posterior, fit: MapEstimate) -> bool:
    """Decide if the model of a fit has modes that its structure lacks, so that a further peak which ties is one more of them."""
    return any(e.repeatable for e in posterior.effects(fit.x, fit.effects))


def cost_of_weak_modes(posterior: Posterior, fit: MapEstimate, effect: Effect) -> float:
    """Compute the gain that a further mode, too weak to be found, may leave to another cause, nats.

    A mode is found only where it gains more than its own parameters cost.  Where a recording shows modes that the model lacks,
    others are there whose gain is less, and whatever else resembles such a mode takes it.  Modes that were missing at
    calibration are in the baseline with all that they left there.
    """
    if effect.repeatable or not any(e.repeatable for e in fit.effects):
        return 0.0
    return parameter_cost(posterior, 2 + len(posterior.context.channels))


def is_beyond_weak_modes(
    posterior: Posterior, fit: MapEstimate, effect: Effect, evidence: float, needed: float
) -> bool:
    """Decide if the log evidence of a cause is more than a further mode, too weak to be found, may leave to it.

    Beside a baseline the structure is known, and the cause is compared with such modes themselves: it must have its evidence
    beside any mode at the highest peaks left.  The fit is without the cause; a cause needs the log evidence `needed`, nats.
    """
    if evidence < needed or evidence >= needed + cost_of_weak_modes(posterior, fit, effect):
        return evidence >= needed
    return posterior.prior.is_baseline and _least_evidence_beside_a_mode(posterior, fit, effect) >= needed


def _least_evidence_beside_a_mode(posterior: Posterior, fit: MapEstimate, effect: Effect) -> float:
    """Compute the least log evidence of a cause beside one further mode at the highest peaks that a fit lacks, nats."""
    at_peaks = (e for peak in find_excess_peaks(posterior, fit) for e in effects_at_peak(posterior, fit, peak))

    def beside(mode: Effect) -> float:
        with_mode = fit_candidate(posterior, fit, mode).fit
        return fit_candidate(posterior, with_mode, effect).log_evidence if with_mode.is_possible else np.inf

    return min(parallel_map(beside, [e for e in at_peaks if e.repeatable]), default=-np.inf)


def is_distinct(posterior: Posterior, fit: MapEstimate, i: int = -1) -> bool:
    """Decide if the mode that effect i of a fit adds can be told from the other modes; any other effect can.

    A mode whose half-power band is not within the band judged shows no peak.  Two modes whose half-power bands overlap are one
    peak.  Much else distorts a peak of the model: forces that are not white, laws that depend on the level, crosstalk between
    channels.  Nor is a mode of the model exchanged for one that it lacks.  A coupled mode whose peak no channel shows is a force
    on the floors.
    """
    i = range(len(fit.effects))[i]
    if not fit.effects[i].repeatable:
        return True
    if np.exp(fit.x[posterior.layout.damping]).max() > MAX_DAMPING:
        return False
    found = tried(lambda: resonances(posterior, fit.x, fit.effects), ())
    if not found:  # there is no structure
        return False
    own, others = [r.mode for r in found if r.owner == i], [r.mode for r in found if r.owner != i]
    band = posterior.observed.band
    resolution_hz = _RESOLUTION_BINS * band.bin_hz

    def is_seen_apart(one: ExtraMode) -> bool:
        half_width_hz = one.damping_ratio * one.frequency_hz + resolution_hz
        if not band.hz[0] + half_width_hz < one.frequency_hz < band.hz[-1] - half_width_hz:
            return False
        if any(_overlap(one, other, resolution_hz) for other in others):
            return False
        seen = fit.effects[i].uncoupled(one).extra_modes(posterior.context)
        return all(_has_peak(posterior, fit, mode) for mode in seen)

    return all(is_seen_apart(one) for one in own)


def is_credible(posterior: Posterior, fit: MapEstimate, i: int = -1) -> bool:
    """Decide if the mode that effect i of a fit adds may be there; any other effect may.

    A mode that cannot be told from one of the model's imitates much else that distorts a peak, as crosstalk does.  It is credible
    in a structure that has other modes which its model lacks, and then explains the recording without being stated.
    """
    i = range(len(fit.effects))[i]
    others = posterior.effects(fit.x, (*fit.effects[:i], *fit.effects[i + 1 :]))
    return any(e.repeatable for e in others) or is_distinct(posterior, fit, i)


def is_stated(posterior: Posterior, fit: MapEstimate, i: int) -> bool:
    """Decide if effect i of a fit is stated: any effect but a mode that is no news, or what cannot be told from another mode.

    Which modes of a structure in space a recording shows depends on the forces.  So a mode that calibration did not see is no
    news beside a baseline.  What swings on a floor at the frequency of such a mode is not told from a change of the mode.
    Without a baseline it is not told from one more mode at any frequency: a mode that is coupled to one floor alone is an
    oscillator on that floor.
    """
    effect, before = fit.effects[i], posterior.prior.effects(fit.x)
    if effect.repeatable:
        return not posterior.prior.is_baseline and is_distinct(posterior, fit, i)
    own = _as_mode(effect)
    lacking = [_as_mode(e) for e in (*before, *fit.effects) if e.repeatable]
    if own is None or not lacking:
        return True
    if not posterior.prior.is_baseline:
        return False
    resolution_hz = _RESOLUTION_BINS * posterior.observed.band.bin_hz
    return not any(mode is not None and _overlap(own, mode, resolution_hz) for mode in lacking)


def _as_mode(effect: Effect) -> ExtraMode | None:
    """Return the frequency and the damping of an effect that has both, with no shape; None for any other."""
    values = effect.values()
    if not {"frequency_hz", "damping_ratio"} <= values.keys():
        return None
    return ExtraMode(values["frequency_hz"], values["damping_ratio"], np.zeros(0))


def couple_modes(posterior: Posterior, fit: MapEstimate) -> MapEstimate | None:
    """Couple the modes that the model lacks to the floors; return None where that explains the spectra no better."""
    context = posterior.context_at(fit.x)
    coupled = [effect.coupled(context) for effect in fit.effects]
    if all(effect is None for effect in coupled):
        return None
    effects = tuple(old if new is None else new for old, new in zip(fit.effects, coupled, strict=True))
    found = _better_orientation(posterior, maximize_posterior(posterior, fit.x, effects, iterations=FAR))
    kept = []
    for i, (old, now) in enumerate(zip(fit.effects, found.effects, strict=True)):
        n, own = len(old.parameters), found.coordinates_of(i)
        std, own = now.pattern_std[n:], slice(own.start + n, own.stop)
        size, covariance = found.x[own] / std, found.covariance[own, own] / np.outer(std, std)
        # Odds of the coupling against none, of a normal posterior (J. Dickey, Annals of Mathematical Statistics 42 (1971) 204).
        odds = 0.5 * float(size @ np.linalg.solve(covariance, size) + np.linalg.slogdet(covariance)[1])
        kept.append(now if odds > 0.0 or not std.size else old)
    if any(a is not b for a, b in zip(kept, found.effects, strict=True)):
        found = maximize_posterior(posterior, found.x, tuple(kept), iterations=FAR)
    is_better = log_evidence(posterior, found) > log_evidence(posterior, fit)
    return found if found.n_effect > fit.n_effect and is_better else None


def uncouple_modes(posterior: Posterior, fit: MapEstimate, start: Annotated[Array, "nuisances"]) -> MapEstimate | None:
    """Refit the modes that the model lacks without coupling, as they are seen; return None where that cannot be.

    None of them may be coupled, or no structure be near without the couplings.  The fit starts from `start`, parameters of the
    model and of the excitation: those of the coupled fit have followed the coupling.
    """
    is_coupled = [e.is_coupled(posterior.context) for e in fit.effects]
    if not any(is_coupled):
        return None
    seen = {r.owner: r.mode for r in resonances(posterior, fit.x, fit.effects)}
    effects = tuple(e.uncoupled(seen[i]) if is_coupled[i] else e for i, e in enumerate(fit.effects))
    apart = maximize_posterior(posterior, join_coordinates(start, effects), effects, iterations=FAR)
    return apart if apart.is_possible else None


def _better_orientation(posterior: Posterior, found: MapEstimate) -> MapEstimate:
    """Return the better of a fit of couplings and of one that starts with every coupling reversed.

    A mode has the same peak whether its own motion adds to that of the floors or opposes it.  So both orientations have a
    best fit, and which of the two a fit from no coupling reaches is a matter of rounding.
    """
    other = tuple(e.reversed_coupling() for e in found.effects)
    return max(found, maximize_posterior(posterior, found.x, other, iterations=FAR), key=lambda fit: fit.log_posterior)


def _overlap(one: ExtraMode, other: ExtraMode, resolution_hz: float) -> bool:
    """Decide if the half-power bands of two modes overlap, as seen with a resolution in Hz."""
    half_widths = one.damping_ratio * one.frequency_hz + other.damping_ratio * other.frequency_hz
    return abs(one.frequency_hz - other.frequency_hz) < half_widths + resolution_hz


def mac(one: Annotated[Array, "c"], other: Annotated[Array, "c"]) -> float:
    """Compute the modal assurance criterion of two real shapes."""
    return float((one @ other) ** 2 / ((one @ one) * (other @ other)))
