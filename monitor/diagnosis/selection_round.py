"""One round of stepwise selection: candidates are ranked, fitted, simulated where their laws are nonlinear, and compared."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from monitor.core import parallel_map
from monitor.diagnosis.ambiguity import tied_candidates
from monitor.diagnosis.missing_modes import is_credible
from monitor.diagnosis.parameter_uncertainty import is_significant
from monitor.diagnosis.plan import plan_of
from monitor.diagnosis.score_test import (
    Candidate,
    Key,
    Ranked,
    best_first,
    best_of_each,
    fit_candidate,
    fit_roughly,
    key_of,
    rank_by_score,
    with_tone_evidence,
)
from monitor.diagnosis.settings import DiagnosisSettings
from monitor.diagnosis.simulation_refit import Effort, RefittedCandidate, refit_by_simulation
from monitor.inference import (
    CorrectedPosterior,
    MapEstimate,
    MeasuredMoments,
    Moments,
    Posterior,
    join_coordinates,
    measure_moments,
    tried,
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
    excluded = [key_of(e) for e in (*persistent, *fit.effects)]
    starts = rank_by_score(posterior, fit, excluded, settings.favourites)
    ranked = [item for item in best_of_each(starts) if item[0] > min_gain]
    if plan_of(posterior).knows_input:
        rough = _fit_driven_roughly(posterior, fit, ranked, [effect for _, effect in starts])
        fitted = fit_fully(posterior, fit, _shortlist_driven(ranked, rough, settings), rough, -np.inf)
        valid = [c for c in fitted.values() if is_valid_cause(posterior, c)]
    else:
        valid = fit_ambient(posterior, fit, ranked, settings)
    contenders = simulate_contenders(posterior, fit, best_first(valid), added, settings)
    return sorted(contenders, key=lambda p: -p.candidate.log_evidence)


def is_valid_cause(posterior: Posterior, candidate: Candidate) -> bool:
    """Decide if a linear cause is valid: its size is significant and plausible.

    An oscillator must move within the band and must not be damped at once, since a heavy mass that hardly moves acts as a damper.
    """
    effect = candidate.effect
    if not candidate.fit.is_possible:
        return False
    if not (effect.is_plausible(posterior.observed.band.hz) and is_credible(posterior, candidate.fit)):
        return False
    std = np.sqrt(np.maximum(np.diag(candidate.fit.covariance)[posterior.layout.effects], 0.0))
    return effect.nonlinear or is_significant(effect, std[std.size - len(effect.parameters) :])


def fit_ambient(posterior: Posterior, fit: MapEstimate, ranked: Ranked, settings: DiagnosisSettings) -> list[Candidate]:
    """Fit the best effects fully, and return those that are valid causes.

    A rough fit that turns out to be no valid cause keeps no other effect out: the effects that it outdid are fitted too.
    """
    rough = fit_roughly(posterior, fit, [e for _, e in ranked[: settings.ranked]])
    fitted: dict[Key, Candidate] = {}
    while True:
        chosen, min_log_evidence = _shortlist_ambient(ranked, rough, settings)
        new = {key: effect for key, effect in chosen.items() if key not in fitted}
        fitted |= fit_fully(posterior, fit, new, rough, min_log_evidence)
        valid = {key: c for key, c in fitted.items() if is_valid_cause(posterior, c)}
        invalid = fitted.keys() - valid.keys()
        if not rough or rough[0].key not in invalid:
            return list(valid.values())
        rough = [c for c in rough if c.key not in invalid]


def fit_fully(
    posterior: Posterior, fit: MapEstimate, effects: dict[Key, Effect], rough: list[Candidate], min_log_evidence: float
) -> dict[Key, Candidate]:
    """Fit effects, given by name and place, from their rough fits."""
    rough_by_key = {c.key: c for c in rough}

    def fit_chosen(key: Key) -> Candidate:
        found = fit_candidate(
            posterior, fit, effects[key], min_log_evidence=min_log_evidence, rough=rough_by_key.get(key)
        )
        return with_tone_evidence(posterior, found)

    return dict(zip(effects, parallel_map(fit_chosen, effects), strict=True))


def _shortlist_ambient(
    ranked: Ranked, rough: list[Candidate], settings: DiagnosisSettings
) -> tuple[dict[Key, Effect], float]:
    """Choose the effects that are fitted fully; return them and the evidence below which a cause does not matter, nats."""
    min_log_evidence = max(rough[0].log_evidence - settings.rival, settings.margin) if rough else 0.0
    near = [c for c in rough if c.may_reach(min_log_evidence)]
    # The rivals of a small effect gain nearly as much, so all of them are fitted.
    small = len(ranked) > 0 and ranked[0][0] < _SMALL_EFFECT_NATS
    chosen = {c.key: c.effect for c in (near if small else near[: settings.tried])}
    # A rough fit may fail from far away, so the best candidates of the score test are fitted too.
    return {key_of(e): e for _, e in ranked[: settings.favourites]} | chosen, min_log_evidence


def _fit_driven_roughly(
    posterior: Posterior, fit: MapEstimate, ranked: Ranked, starts: list[Effect]
) -> list[Candidate]:
    """Fit roughly, where the ground is measured, the best few effects of all kinds, and the best kinds at every place.

    For nonlinear laws the score test does not tell which start leads to the law's best fit, so the second best is fitted too.
    """
    kinds = list(dict.fromkeys(effect.name for _, effect in ranked))
    firsts = {effect.name: effect for _, effect in reversed(ranked) if effect.name in kinds[:_N_KINDS]}
    near = [
        e
        for i, (_, e) in enumerate(ranked)
        if i < _N_BEST_SCORES or e.name in kinds[:_N_KINDS_EVERYWHERE] or e is firsts.get(e.name)
    ]
    laws, known = {e.name for e in near if e.nonlinear}, [e for _, e in ranked]
    seconds = best_of_each([(0.0, e) for e in starts if e.name in laws and e not in known])
    best: dict[Key, Candidate] = {}
    for candidate in fit_roughly(posterior, fit, near + [e for _, e in seconds]):
        best.setdefault(candidate.key, candidate)
    return list(best.values())


def _shortlist_driven(ranked: Ranked, rough: list[Candidate], settings: DiagnosisSettings) -> dict[Key, Effect]:
    """Choose as `_shortlist_ambient` where the ground is measured: the best few rough fits, and the best kind at every place.

    A response separates kinds so clearly that few need a closer look, but its score test predicts too much gain for most.
    A rough fit that explains less than none has failed, and says nothing of a favourite of the score test.
    """
    same = [e for _, e in ranked if rough and e.name == rough[0].effect.name]
    found = [c.effect for i, c in enumerate(rough) if i < _N_FULL_FITS or c.effect.name == rough[0].effect.name]
    explains = {c.key for c in rough if c.delta_log_posterior > 0.0}
    failed = [e for _, e in ranked[: settings.favourites] if key_of(e) not in explains]
    return {key_of(e): e for e in (*same, *found, *failed)}


def simulate_contenders(
    posterior: Posterior, fit: MapEstimate, candidates: list[Candidate], added: Moments, settings: DiagnosisSettings
) -> list[RefittedCandidate]:
    """Simulate the nonlinear laws among the best candidates, and compare all candidates with the measured moments.

    A law whose simulation diverges has no finite evidence, and is no candidate any more.
    """
    contenders = [RefittedCandidate(c, posterior, added) for c in candidates]
    laws = _laws_in_doubt(posterior, candidates, settings)
    if not laws:
        return contenders
    measured = measure_moments(posterior.observed.segments.values, posterior, fit)
    contenders = _simulated(fit, contenders, laws, "rough")
    finite = best_first(p.candidate for p in contenders)
    contenders = [p for p in contenders if p.candidate in finite]
    simulated = [p.candidate for p in contenders if p.candidate.key in laws]
    if not simulated:
        return contenders
    error = {c.key: _ROUGH_GAIN_ERROR * max(c.delta_log_posterior, _SMALL_EFFECT_NATS) for c in simulated}
    near = [c.key for c in simulated if c.log_evidence > finite[0].log_evidence - error[c.key]]
    contenders = _simulated(fit, contenders, near, "fine")
    compared = _compare_moments(contenders, added, measured)
    tied = tied_candidates(compared, settings.rival)
    noisy = [p.candidate.key for p in tied if p.log_evidence_std > _SIMULATION_NATS and len(tied) > 1]
    return _compare_moments(_simulated(fit, contenders, noisy, "finest"), added, measured) if noisy else compared


def _laws_in_doubt(posterior: Posterior, candidates: list[Candidate], settings: DiagnosisSettings) -> list[Key]:
    """List the nonlinear laws, by name and place, that may prove to be the best of the candidates, best first."""
    if not candidates or candidates[0].log_evidence < settings.margin:
        return []
    best = candidates[0]
    reach = best.log_evidence - max(settings.rival, settings.linearization * best.delta_log_posterior)
    return [c.key for c in candidates if c.log_evidence > reach and posterior.linearizes((c.effect,))]


def _simulated(
    fit: MapEstimate, contenders: list[RefittedCandidate], keys: list[Key], effort: Effort
) -> list[RefittedCandidate]:
    """Refit some of the contenders with their laws simulated."""
    known = {p.candidate.key: p for p in contenders}
    chosen = [known[key] for key in keys]
    refitted = parallel_map(
        lambda p: tried(
            lambda: refit_by_simulation(p.posterior, fit, p.candidate, effort),
            replace(p, candidate=replace(p.candidate, log_evidence=-np.inf)),
        ),
        chosen,
    )
    return list((known | {p.candidate.key: p for p in refitted}).values())


def _compare_moments(
    contenders: list[RefittedCandidate], before: Moments, measured: MeasuredMoments
) -> list[RefittedCandidate]:
    """Add to every candidate's evidence the likelihood of the measured moments, relative to that of the best fit to the spectra.

    `before` is what the causes accepted before add to the moments of a normal process.
    """
    oriented = [
        (p, likelihood)
        for p, likelihood in (choose_orientation(p, before, measured) for p in contenders)
        if np.isfinite(p.candidate.log_evidence + likelihood)
    ]
    if not oriented:
        return []
    first = max(oriented, key=lambda pair: pair[0].candidate.log_evidence)[1]
    return [
        replace(p, candidate=replace(p.candidate, log_evidence=p.candidate.log_evidence + (nats - first)))
        for p, nats in oriented
    ]


def choose_orientation(
    refitted: RefittedCandidate, before: Moments, measured: MeasuredMoments
) -> tuple[RefittedCandidate, float]:
    """Choose the orientation of a candidate's law that fits the measured moments best; return candidate and log likelihood."""
    unchanged = measured.log_likelihood(refitted.moments, refitted.variance_ratio)
    mirror = refitted.candidate.effect.mirrored()
    if mirror is None:
        return refitted, unchanged
    mirrored_moments = refitted.moments.mirrored(before)
    mirrored_likelihood = measured.log_likelihood(mirrored_moments, refitted.variance_ratio)
    if mirrored_likelihood <= unchanged:
        return refitted, unchanged
    old = refitted.candidate.fit
    x = join_coordinates(old.x[: -len(mirror.parameters)], (mirror,))
    candidate = replace(refitted.candidate, effect=mirror, fit=replace(old, effects=(*old.effects[:-1], mirror), x=x))
    posterior = refitted.posterior
    if isinstance(posterior, CorrectedPosterior):
        posterior = posterior.mirrored(mirror)
    return replace(refitted, candidate=candidate, posterior=posterior, moments=mirrored_moments), mirrored_likelihood
