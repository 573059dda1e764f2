"""One round of stepwise selection: candidates are ranked, fitted, simulated where their laws are nonlinear, and compared."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from monitor.core import parallel_map
from monitor.diagnosis.ambiguity import tied_candidates
from monitor.diagnosis.missing_modes import is_credible
from monitor.diagnosis.parameter_uncertainty import is_significant
from monitor.diagnosis.score_test import (
    Candidate,
    best_first,
    best_of_each,
    fit_candidate,
    fit_roughly,
    rank_by_score,
    with_tone_evidence,
)
from monitor.diagnosis.settings import DiagnosisSettings
from monitor.diagnosis.simulation_refit import RefittedCandidate, refit_by_simulation
from monitor.inference import (
    CorrectedPosterior,
    MapEstimate,
    MeasuredMoments,
    Moments,
    Posterior,
    join_coordinates,
    measure_moments,
)
from monitor.model import Effect

_SMALL_EFFECT_NATS = 200.0
"""Predicted gain up to which an effect counts as small. [nats; judgement]"""
_N_KINDS = 7
"""With a measured ground: kinds of effects that are fitted roughly. [count; cost]"""
_N_KINDS_EVERYWHERE = 2
"""With a measured ground: those of these kinds that are fitted at every place. [count; cost]"""
_N_FULL_FITS = 2
"""With a measured ground: effects that are fitted to the end. [count; cost]"""
_N_BEST_SCORES = 12
"""With a measured ground: effects of the best scores that are fitted roughly, of any kind. [count; cost]"""
_ROUGH_GAIN_ERROR = 0.1
"""Relative error of a gain from a rough simulation. [ratio; judgement]"""
_SIMULATION_NATS = 1.0
"""Random error of simulated gains from which competing effects are simulated again. [nats; judgement]"""


def run_selection_round(
    posterior: Posterior, fit: MapEstimate, added: Moments, settings: DiagnosisSettings, min_gain: float
) -> list[RefittedCandidate]:
    """Find the best further causes, by evidence, among the candidates with a predicted gain above `min_gain`, nats.

    `added` is what the accepted causes add to the moments of a normal process.
    """
    # A persistent effect may have changed, so it is tried again; a nonlinear one is not, as one law a place is simulated.
    persistent = [e for e in posterior.prior.effects(fit.x) if e.nonlinear or not e.parameters]
    excluded = [(e.name, e.location) for e in (*persistent, *fit.effects)]
    starts = rank_by_score(posterior, fit, excluded, settings.favourites)
    ranked = [item for item in best_of_each(starts) if item[0] > min_gain]
    if posterior.observed.drive is None:
        valid = fit_ambient(posterior, fit, ranked, settings)
    else:
        valid = _fit_driven(posterior, fit, ranked, [effect for _, effect in starts], settings)
    return sorted(
        simulate_contenders(posterior, fit, best_first(valid), added, settings),
        key=lambda p: -p.candidate.log_evidence,
    )


def is_valid_cause(posterior: Posterior, candidate: Candidate) -> bool:
    """Decide if a linear cause is valid: its size is significant and plausible.

    An oscillator must move within the band and must not be damped at once, since a heavy mass that hardly moves acts as a damper.
    """
    effect = candidate.effect
    if not np.isfinite(candidate.fit.log_posterior):
        return False
    if not (effect.is_plausible(posterior.observed.band.hz) and is_credible(posterior, candidate.fit)):
        return False
    std = np.sqrt(np.maximum(np.diag(candidate.fit.covariance)[posterior.layout.effects], 0.0))
    return effect.nonlinear or is_significant(effect, std[std.size - len(effect.parameters) :])


def fit_ambient(
    posterior: Posterior, fit: MapEstimate, ranked: list[tuple[float, Effect]], settings: DiagnosisSettings
) -> list[Candidate]:
    """Fit the best effects fully, and return those that are valid causes.

    A rough fit that turns out to be no valid cause keeps no other effect out: the effects that it outdid are fitted too.
    """
    rough = fit_roughly(posterior, fit, [e for _, e in ranked[: settings.ranked]])
    fitted: dict[tuple[str, str], Candidate] = {}
    while True:
        chosen, min_log_evidence = _shortlist_ambient(ranked, rough, settings)
        new = {key: effect for key, effect in chosen.items() if key not in fitted}
        fitted |= fit_fully(posterior, fit, new, rough, min_log_evidence)
        valid = {key: c for key, c in fitted.items() if is_valid_cause(posterior, c)}
        invalid = fitted.keys() - valid.keys()
        if not rough or rough[0].key not in invalid:
            return list(valid.values())
        rough = [c for c in rough if c.key not in invalid]


def _fit_driven(
    posterior: Posterior,
    fit: MapEstimate,
    ranked: list[tuple[float, Effect]],
    starts: list[Effect],
    settings: DiagnosisSettings,
) -> list[Candidate]:
    """Fit the best effects fully where the ground is measured, and return those that are valid causes."""
    chosen, rough = _shortlist_driven(posterior, fit, ranked, starts, settings)
    fitted = fit_fully(posterior, fit, chosen, rough, -np.inf)
    return [c for c in fitted.values() if is_valid_cause(posterior, c)]


def fit_fully(
    posterior: Posterior,
    fit: MapEstimate,
    effects: dict[tuple[str, str], Effect],
    rough: list[Candidate],
    min_log_evidence: float,
) -> dict[tuple[str, str], Candidate]:
    """Fit effects, given by name and place, from their rough fits."""
    rough_by_key = {c.key: c for c in rough}

    def fit_chosen(key: tuple[str, str]) -> Candidate:
        found = fit_candidate(
            posterior, fit, effects[key], min_log_evidence=min_log_evidence, rough=rough_by_key.get(key)
        )
        return with_tone_evidence(posterior, found)

    return dict(zip(effects, parallel_map(fit_chosen, effects), strict=True))


def _shortlist_ambient(
    ranked: list[tuple[float, Effect]], rough: list[Candidate], settings: DiagnosisSettings
) -> tuple[dict[tuple[str, str], Effect], float]:
    """Choose the effects that are fitted fully; return them and the evidence below which a cause does not matter, nats."""
    min_log_evidence = max(rough[0].log_evidence - settings.rival, settings.margin) if rough else 0.0
    near = [c for c in rough if c.may_reach(min_log_evidence)]
    # The rivals of a small effect gain nearly as much, so all of them are fitted.
    small = len(ranked) > 0 and ranked[0][0] < _SMALL_EFFECT_NATS
    chosen = {c.key: c.effect for c in (near if small else near[: settings.tried])}
    # A rough fit may fail from far away, so the best candidates of the score test are fitted too.
    return {(e.name, e.location): e for _, e in ranked[: settings.favourites]} | chosen, min_log_evidence


def _shortlist_driven(
    posterior: Posterior,
    fit: MapEstimate,
    ranked: list[tuple[float, Effect]],
    starts: list[Effect],
    settings: DiagnosisSettings,
) -> tuple[dict[tuple[str, str], Effect], list[Candidate]]:
    """Choose as `_shortlist_ambient` where the ground is measured: the best few of all kinds, and the best kind at every place.

    A response separates kinds so clearly that few need a closer look, but its score test predicts too much gain for most.  For
    nonlinear laws it does not even tell which start leads to the law's best fit, so the second best is fitted roughly too.
    A rough fit that explains less than none has failed, and says nothing of a favourite of the score test.
    """
    kinds = list(dict.fromkeys(effect.name for _, effect in ranked))
    first = {name: next(e for _, e in ranked if e.name == name) for name in kinds[:_N_KINDS]}
    near = [
        e
        for i, (_, e) in enumerate(ranked)
        if i < _N_BEST_SCORES or e.name in kinds[:_N_KINDS_EVERYWHERE] or e is first.get(e.name)
    ]
    laws = {e.name for e in near if e.nonlinear}
    others = [(0.0, e) for e in starts if e.name in laws and e not in [first for _, first in ranked]]
    more = [e for _, e in best_of_each(others)]
    best: dict[tuple[str, str], Candidate] = {}
    for candidate in fit_roughly(posterior, fit, near + more):
        best.setdefault(candidate.key, candidate)
    rough = list(best.values())
    same = [e for _, e in ranked if rough and e.name == rough[0].effect.name]
    found = [c.effect for i, c in enumerate(rough) if i < _N_FULL_FITS or c.effect.name == rough[0].effect.name]
    explains = {c.key for c in rough if c.delta_log_posterior > 0.0}
    failed = [e for _, e in ranked[: settings.favourites] if (e.name, e.location) not in explains]
    return {(e.name, e.location): e for e in (*same, *found, *failed)}, rough


def simulate_contenders(
    posterior: Posterior, fit: MapEstimate, candidates: list[Candidate], added: Moments, settings: DiagnosisSettings
) -> list[RefittedCandidate]:
    """Simulate the nonlinear laws among the best candidates, and compare all candidates with the measured moments.

    A law whose simulation diverges has no finite evidence, and is no candidate any more.
    """
    # A response to measured ground motion is computed with the exact laws.
    if not candidates or candidates[0].log_evidence < settings.margin or posterior.observed.drive is not None:
        return [RefittedCandidate(c, posterior, added) for c in candidates]
    best = candidates[0]
    reach = best.log_evidence - max(settings.rival, settings.linearization * best.delta_log_posterior)
    doubtful = [c for c in candidates if c.log_evidence > reach]
    if not any(c.effect.nonlinear for c in doubtful):
        return [RefittedCandidate(c, posterior, added) for c in candidates]
    measured = measure_moments(posterior.observed.segments.values, posterior, fit)
    nonlinear = [c for c in doubtful if c.effect.nonlinear]
    simulated = {p.candidate.key: p for p in parallel_map(partial(refit_by_simulation, posterior, fit), nonlinear)}
    alive = {c.key for c in best_first(simulated[c.key].candidate if c.key in simulated else c for c in candidates)}
    candidates = [c for c in candidates if c.key in alive]
    simulated = {key: p for key, p in simulated.items() if key in alive}
    if not simulated:
        return [RefittedCandidate(c, posterior, added) for c in candidates]
    first = max((simulated[c.key].candidate if c.key in simulated else c).log_evidence for c in candidates)
    near = [
        p
        for p in simulated.values()
        if p.candidate.log_evidence
        > first - _ROUGH_GAIN_ERROR * max(p.candidate.delta_log_posterior, _SMALL_EFFECT_NATS)
    ]
    finer = parallel_map(lambda p: refit_by_simulation(p.posterior, fit, p.candidate, "fine"), near)
    simulated |= {p.candidate.key: p for p in finer}
    compared = _compare_moments(posterior, candidates, simulated, added, measured)
    tied = tied_candidates(compared, settings.rival)
    noisy = [p.candidate.key for p in tied if p.log_evidence_std > _SIMULATION_NATS and len(tied) > 1]
    if not noisy:
        return compared
    finest = parallel_map(
        lambda key: refit_by_simulation(simulated[key].posterior, fit, simulated[key].candidate, "finest"), noisy
    )
    return _compare_moments(posterior, candidates, simulated | {p.candidate.key: p for p in finest}, added, measured)


def _compare_moments(
    posterior: Posterior,
    candidates: list[Candidate],
    simulated: dict[tuple[str, str], RefittedCandidate],
    before: Moments,
    measured: MeasuredMoments,
) -> list[RefittedCandidate]:
    """Add to every candidate's evidence the likelihood of the measured moments, relative to that of the best fit to the spectra.

    `before` is what the causes accepted before add to the moments of a normal process.
    """
    refitted = [simulated.get(c.key, RefittedCandidate(c, posterior, before)) for c in candidates]
    oriented = [
        (p, likelihood)
        for p, likelihood in (choose_orientation(p, before, measured) for p in refitted)
        if np.isfinite(p.candidate.log_evidence + likelihood)
    ]
    if not oriented:
        return []
    first = max(oriented, key=lambda pair: pair[0].candidate.log_evidence)[1]
    return [_add_evidence(p, likelihood - first) for p, likelihood in oriented]


def choose_orientation(
    refitted: RefittedCandidate, before: Moments, measured: MeasuredMoments
) -> tuple[RefittedCandidate, float]:
    """Choose the orientation of a candidate's law that fits the measured moments best; return candidate and log likelihood."""
    unchanged, mirror = (
        measured.log_likelihood(refitted.moments, refitted.variance_ratio),
        refitted.candidate.effect.mirrored(),
    )
    if mirror is None:
        return refitted, unchanged
    mirrored_moments = refitted.moments.mirrored(before)
    mirrored_likelihood = measured.log_likelihood(mirrored_moments, refitted.variance_ratio)
    if mirrored_likelihood <= unchanged:
        return refitted, unchanged
    old = refitted.candidate.fit
    x = join_coordinates(old.x[: -len(mirror.parameters)], (mirror,))
    candidate = replace(refitted.candidate, effect=mirror, fit=replace(old, effects=(*old.effects[:-1], mirror), x=x))
    posterior = (
        refitted.posterior.mirrored(mirror)
        if isinstance(refitted.posterior, CorrectedPosterior)
        else refitted.posterior
    )
    return replace(refitted, candidate=candidate, posterior=posterior, moments=mirrored_moments), mirrored_likelihood


def _add_evidence(refitted: RefittedCandidate, nats: float) -> RefittedCandidate:
    """Add `nats` to a candidate's evidence."""
    return replace(refitted, candidate=replace(refitted.candidate, log_evidence=refitted.candidate.log_evidence + nats))
