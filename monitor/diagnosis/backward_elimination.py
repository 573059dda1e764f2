"""Backward elimination: accepted causes are tested again once later ones are known, as is the model without any cause."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Annotated

import numpy as np

from monitor.core import Array, parallel_map
from monitor.diagnosis.missing_modes import CERTAIN, effects_at_peak, is_beyond_weak_modes, likely_causes
from monitor.diagnosis.plan import FAR
from monitor.diagnosis.score_test import (
    Candidate,
    best_first,
    find_excess_peaks,
    fit_candidate,
    fit_roughly,
    fit_with,
    key_of,
    refine_rough_fit,
    score_candidate,
    with_tone_evidence,
)
from monitor.diagnosis.simulation_refit import RefittedCandidate, fit_persistent_effects
from monitor.inference import (
    CorrectedPosterior,
    MapEstimate,
    Posterior,
    join_coordinates,
    linearize,
    maximize_posterior,
    tried,
)
from monitor.model import Effect

_LOCAL_OPTIMUM_NATS = 3.0
"""Shortfall against the best fit of the same form from which a fit is repeated from another start. [nats; judgement]"""
_N_ALTERNATIVES = 3
"""Causes of the same round that are tried in place of one. [count; cost]"""


def find_better_null_fit(
    posterior: Posterior, fit: MapEstimate, candidates: Sequence[RefittedCandidate]
) -> tuple[Posterior, MapEstimate] | None:
    """Find a better fit without a further cause, which would get credit for it, from where the candidates' fits ended."""
    starts = [(p.candidate.fit.x[: fit.x.size], p.candidate.fit.effects[:-1]) for p in candidates]
    log_posteriors = [sum(posterior.score(*start)) for start in starts]
    if not starts or not max(log_posteriors) > fit.log_posterior + _LOCAL_OPTIMUM_NATS:
        return None
    found = maximize_posterior(posterior, *starts[int(np.argmax(log_posteriors))])
    return _followed(posterior, found)


def update_linearization(posterior: Posterior, fit: MapEstimate) -> Posterior:
    """Linearize nonlinear laws at the motion of a fit, unless simulation corrected the posterior, at its own motion."""
    if isinstance(posterior, CorrectedPosterior):
        return posterior
    return replace(posterior, conditions=tried(lambda: linearize(posterior, fit.x, fit.effects), posterior.conditions))


def _followed(posterior: Posterior, fit: MapEstimate) -> tuple[Posterior, MapEstimate]:
    """Linearize nonlinear laws at the motion of a fit and refit, unless that leads to no structure."""
    moved = update_linearization(posterior, fit)
    refitted = maximize_posterior(moved, fit.x, fit.effects)
    return (moved, refitted) if refitted.is_possible else (posterior, fit)


def eliminate_backward(
    posterior: Posterior,
    fit: MapEstimate,
    accepted: Sequence[Candidate],
    rounds: Sequence[Sequence[Candidate]],
    margin: float,
    lead: float,
) -> tuple[Posterior, MapEstimate, tuple[Candidate, ...]]:
    """Remove the causes that later ones made superfluous, and replace a cause where a rival fits better now.

    The fit has the accepted causes, in the order of their acceptance, then the most probable alternative where the answer is
    ambiguous.  `rounds` has for every cause the candidates among which it was accepted, then those of the alternatives.  A cause
    needs the log evidence `margin`, a rival `lead` beyond that of the cause which it replaces, nats.
    """
    later = rounds[len(accepted)] if len(fit.effects) > len(accepted) else ()
    kept, replaced = list(accepted), False
    for cause, candidates in zip(accepted, rounds, strict=False):
        is_last = cause is accepted[-1] and len(fit.effects) == len(kept) and not replaced
        if (len(fit.effects) == 1 or is_last) and not cause.effect.repeatable:
            break  # no later cause is in the model
        i = kept.index(cause)
        rivals = _rivals(cause, candidates, (*fit.effects[:i], *fit.effects[i + 1 :]), later)
        tested = _test_cause(posterior, fit, i, rivals, margin, lead)
        if tested is None:
            continue
        fit, rival = tested
        kept[i : i + 1] = [] if rival is None else [rival]
        replaced |= rival is not None
        if isinstance(posterior, CorrectedPosterior):
            posterior = replace(posterior, simulation_std=np.zeros(0))  # it held for the former causes
        posterior, fit = _followed(posterior, fit)
    if not any(e.nonlinear for e in fit.effects) and any(c.effect.nonlinear for c in accepted):
        posterior, fit, _ = fit_persistent_effects(posterior, fit)  # the simulated law was removed
    return posterior, fit, tuple(kept)


def _rivals(
    cause: Candidate, candidates: Sequence[Candidate], others: Sequence[Effect], later: Sequence[Candidate]
) -> list[Effect]:
    """List the effects that are tried in place of a cause: the best of its own round that are not among the others."""
    if cause.effect.nonlinear:  # a simulated correction holds for one law only
        return []
    known = {*map(key_of, others), cause.key, *(c.key for c in later)}
    return [c.effect for c in candidates if not c.effect.nonlinear and c.key not in known][:_N_ALTERNATIVES]


def _test_cause(
    posterior: Posterior, fit: MapEstimate, i: int, rivals: Sequence[Effect], margin: float, lead: float
) -> tuple[MapEstimate, Candidate | None] | None:
    """Test cause i of a fit: None where it is needed, else the fit with a better rival for it and this, or without both."""
    at_peak: list[Candidate] = []
    if fit.effects[i].repeatable:
        certain, at_peak = _test_roughly(posterior, fit, i, margin)
        if certain:
            return None
    without = fit_with(posterior, fit, (*fit.effects[:i], *fit.effects[i + 1 :]))
    gain = score_candidate(posterior, without, fit, i).log_evidence
    needed = max(gain + lead, margin)
    if at_peak:
        fitted = parallel_map(partial(refine_rough_fit, posterior, without), at_peak)
    else:
        fitted = parallel_map(partial(fit_candidate, posterior, without, min_log_evidence=needed), rivals)
    found = best_first(with_tone_evidence(posterior, c) for c in fitted)
    best = found[0] if found and found[0].log_evidence > needed else None
    if best and is_beyond_weak_modes(posterior, without, best.effect, best.log_evidence, margin):
        effects = (*best.fit.effects[:i], best.effect, *best.fit.effects[i:-1])
        return fit_with(posterior, best.fit, effects), best
    if is_beyond_weak_modes(posterior, without, fit.effects[i], gain, margin):
        return None
    return without, None


def _test_roughly(posterior: Posterior, fit: MapEstimate, i: int, margin: float) -> tuple[bool, list[Candidate]]:
    """Test mode i of a fit, one that the model lacks, by rough fits, since such modes may be many and most are beyond doubt.

    Return whether the mode is needed beyond doubt and no other cause of its peak comes near it, and the best other cause of the
    peak, roughly fitted; empty where none comes near the mode.
    """
    rest = (*fit.effects[:i], *fit.effects[i + 1 :])
    x = join_coordinates(fit.x[posterior.layout.nuisances], rest)
    # The slopes by all else hardly depend on the mode.  Steps that need no new slopes cost next to nothing.
    others = np.delete(np.arange(fit.x.size), fit.coordinates_of(i))
    without = maximize_posterior(posterior, x, rest, iterations=FAR, frozen=fit.slopes.by(others))
    if not without.is_possible:  # no structure is near without the mode
        return True, []
    gain = score_candidate(posterior, without, fit, i).log_evidence
    (peak,) = find_excess_peaks(posterior, without, 1)
    for find_starts in (likely_causes, effects_at_peak):  # those of all places only where one of the former comes near
        starts = [effect for effect in find_starts(posterior, without, peak) if not effect.repeatable]
        near = [c for c in fit_roughly(posterior, without, starts)[:1] if c.may_reach(gain)]
        if not near:
            break
    return gain > CERTAIN * margin and not near, near


def fit_subset(
    posterior: Posterior, fit: MapEstimate, simulation_std: Annotated[Array, "p"], kept: Sequence[bool]
) -> tuple[MapEstimate, Annotated[Array, "q"]]:
    """Refit with the effects that are `kept`; return the fit and, of these effects' coordinates, the `simulation_std`."""
    effects = tuple(e for e, stays in zip(fit.effects, kept, strict=True) if stays)
    sizes = np.array([stays for e, stays in zip(fit.effects, kept, strict=True) for _ in e.parameters], dtype=bool)
    return fit_with(posterior, fit, effects), simulation_std[sizes]
