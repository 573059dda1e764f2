"""Modes that the model lacks, added peak by peak: a structure in space has three times as many as its model in a plane."""

from __future__ import annotations

from functools import partial

import numpy as np

from monitor.core import Array, parallel_map
from monitor.diagnosis.parameter_uncertainty import is_significant
from monitor.diagnosis.score_test import (
    Candidate,
    best_first,
    find_excess_peaks,
    fit_candidate,
    refine_rough_fit,
    with_tone_evidence,
)
from monitor.diagnosis.settings import DiagnosisSettings
from monitor.identification import SelectionSettings
from monitor.inference import MapEstimate, Posterior
from monitor.model import EFFECTS, Effect, ExtraMode, Peak, locations

_RESOLUTION_BINS = 2.0
"""Distance of two peaks that the segments resolve. [bins; half-width of the taper's main lobe]"""
MAX_DAMPING = SelectionSettings().max_damping_ratio
"""Damping ratio from which a mode of the model has no peak any more. [1; as of the poles that identification accepts]"""


def effects_at_peak(posterior: Posterior, peak: Peak) -> list[Effect]:
    """List the effects that a peak which the model lacks may have as its cause, at their first sizes."""
    typical, context = posterior.conditions[posterior.n_classes // 2], posterior.context
    near = (
        kind.at_peak(place, peak, context, typical)
        for kind in EFFECTS.values()
        for of in kind.places
        for place in locations(of, context)
    )
    return [effect for effect in near if effect is not None]


def find_missing_mode(
    posterior: Posterior, fit: MapEstimate, settings: DiagnosisSettings, threshold: float
) -> list[Candidate]:
    """Find the cause of the highest peak that the model lacks, if the cause is a mode of the structure.

    A mode is compared with a machine and with something that swings on a floor, at every floor.

    Parameters
    ----------
    posterior : Posterior
    fit : MapEstimate
        With the causes found so far.
    settings : DiagnosisSettings
    threshold : float
        Log evidence that the mode needs, nats.

    Returns
    -------
    list of Candidate
        The mode, then its rivals at the same peak; empty where no mode is the cause, or a rival may be.
    """
    (peak,) = find_excess_peaks(posterior, fit, 1)
    starts = effects_at_peak(posterior, peak)
    rough = best_first(parallel_map(partial(fit_candidate, posterior, fit, quick=True), starts))
    if not rough or not rough[0].effect.repeatable:
        return []
    near = [c for c in rough if c.may_reach(rough[0].log_evidence - settings.rival)]
    fitted = parallel_map(lambda c: refine_rough_fit(posterior, fit, c.effect), near)
    found = best_first(with_tone_evidence(posterior, c) for c in fitted)
    best = found[0]
    is_alone = len(found) == 1 or found[1].log_evidence < best.log_evidence - settings.rival
    std = best.fit.covariance.diagonal()[posterior.layout.effects][-len(best.effect.parameters) :] ** 0.5
    plausible = (
        best.effect.is_plausible(posterior.observed.band.hz)
        and is_significant(best.effect, std)
        and is_distinct(posterior, best.fit)
    )
    if best.effect.repeatable and plausible and is_alone and best.log_evidence > threshold:
        return found
    return []


def is_distinct(posterior: Posterior, fit: MapEstimate, i: int = -1) -> bool:
    """Decide if the mode that effect i of a fit adds can be told from the other modes; any other effect can.

    Two modes whose half-power bands overlap are one peak.  Much else distorts a peak of the model: forces that are not white,
    laws that depend on the level, crosstalk between channels.  Nor is a mode of the model exchanged for one that it lacks.
    """
    context, effect = posterior.context_at(fit.x), fit.effects[i]
    own = effect.extra_modes(context)
    if not own:
        return True
    others = (*posterior.prior.effects(fit.x), *(e for e in fit.effects if e is not effect))
    ratios = np.exp(fit.x[posterior.layout.damping])
    if ratios.max() > MAX_DAMPING:
        return False
    frequencies = posterior.model(fit.x, others).modes().frequencies_hz
    known = list(zip(frequencies[: ratios.size].tolist(), ratios.tolist(), strict=True))
    known += [(m.frequency_hz, m.damping_ratio) for other in others for m in other.extra_modes(context)]
    resolution_hz = _RESOLUTION_BINS * posterior.observed.band.bin_hz
    return not any(_overlap(mode, hz, ratio, resolution_hz) for mode in own for hz, ratio in known)


def _overlap(mode: ExtraMode, hz: float, damping_ratio: float, resolution_hz: float) -> bool:
    """Decide if the half-power bands of two modes overlap, as seen with a resolution in Hz."""
    half_widths = mode.damping_ratio * mode.frequency_hz + damping_ratio * hz
    return abs(mode.frequency_hz - hz) < half_widths + resolution_hz


def mac(one: Array, other: Array) -> float:
    """Compute the modal assurance criterion of two real shapes, shape (c,) each."""
    return float((one @ other) ** 2 / ((one @ one) * (other @ other)))
