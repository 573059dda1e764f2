"""What is seen again once more is known: the model without a cause, and causes beside later ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from monitor.core import Array, parallel_map
from monitor.diagnosis.score_test import Candidate, fit_candidate, score_candidate
from monitor.diagnosis.simulation_refit import RefittedCandidate, fit_persistent_effects
from monitor.inference import CorrectedPosterior, MapEstimate, Posterior, linearize, maximize_posterior
from monitor.model import Effect

_LOCAL_OPTIMUM_NATS = 3.0
"""Shortfall against the best fit of the same form from which a fit is repeated from another start. [nats; judgement]"""
_N_ALTERNATIVES = 3
"""Causes of the same round that are tried in place of one. [count; cost]"""


def find_better_null_fit(
    posterior: Posterior, fit: MapEstimate, candidates: Sequence[RefittedCandidate]
) -> tuple[Posterior, MapEstimate] | None:
    """A better fit of the same form than `at`, where a candidate's fit came upon one; None where none did.

    Else the candidate would get the credit for it.
    """
    begun = [(p.candidate.fit.x[: fit.x.size], p.candidate.fit.effects[:-1]) for p in candidates]
    likely = [sum(posterior.score(*start)) for start in begun]
    if not begun or not max(likely) > fit.log_posterior + _LOCAL_OPTIMUM_NATS:
        return None
    found = maximize_posterior(posterior, *begun[int(np.argmax(likely))])
    posterior = update_linearization(posterior, found)
    return posterior, maximize_posterior(posterior, found.x, found.effects)


def update_linearization(posterior: Posterior, fit: MapEstimate) -> Posterior:
    """The problem with its classes' motion as the fitted model has it; a correction stays at the motion that was simulated."""
    if isinstance(posterior, CorrectedPosterior):
        return posterior
    return replace(posterior, conditions=linearize(posterior, fit.x, fit.effects))


def eliminate_backward(
    posterior: Posterior,
    fit: MapEstimate,
    accepted: Sequence[Candidate],
    rounds: Sequence[Sequence[Candidate]],
    margin: float,
    lead: float,
) -> tuple[Posterior, MapEstimate, tuple[Candidate, ...]]:
    """The causes once the later ones are known: without what they made superfluous, and rivals where these are better now.

    Parameters
    ----------
    at : MapEstimate
        With the accepted causes, and after them the most probable alternative where there is one.
    rounds
        Of every cause, the candidates among which it was accepted; then that of the alternatives.
    margin, lead : float
        Evidence that a cause needs, and what a rival must have more than the cause whose place it takes, nats.
    """
    later = rounds[len(accepted)] if len(fit.effects) > len(accepted) else ()
    kept, replaced = list(accepted), False
    for cause, candidates in zip(accepted, rounds, strict=False):
        if len(fit.effects) == 1 or (cause is accepted[-1] and len(fit.effects) == len(kept) and not replaced):
            break  # nothing came after it
        nuisances, i = posterior.layout.nuisances, kept.index(cause)
        rest = (*fit.effects[:i], *fit.effects[i + 1 :])
        without = maximize_posterior(posterior, join_coordinates(fit.x[nuisances], rest), rest)
        min_gain = score_candidate(posterior, without, fit, len(cause.effect.parameters)).log_evidence
        excluded = {cause.key, *(c.key for c in later), *((e.name, e.location) for e in rest)}
        # What simulation added to a law is its own: none takes its place, and it none's.
        linear = [] if cause.effect.nonlinear else [c for c in candidates if not c.effect.nonlinear]
        rivals = [c.effect for c in linear if c.key not in excluded]
        min_log_evidence = max(min_gain + lead, margin)
        judged = parallel_map(
            partial(fit_candidate, posterior, without, min_log_evidence=min_log_evidence), rivals[:_N_ALTERNATIVES]
        )
        best = max(judged, key=lambda c: c.log_evidence, default=None)
        if best is not None and best.log_evidence > min_log_evidence:
            effects = (*best.fit.effects[:i], best.effect, *best.fit.effects[i:-1])
            fit = maximize_posterior(posterior, join_coordinates(best.fit.x[nuisances], effects), effects)
            kept[i], replaced = best, True
        elif min_gain > margin:
            continue
        else:
            fit = without
            del kept[i]
        posterior = update_linearization(posterior, fit)
        if isinstance(posterior, CorrectedPosterior):
            posterior = replace(posterior, doubt=np.zeros(0))  # which was that of other causes
        fit = maximize_posterior(posterior, fit.x, fit.effects)
    if not any(e.nonlinear for e in fit.effects) and any(c.effect.nonlinear for c in accepted):
        posterior, fit, _ = fit_persistent_effects(posterior, fit)  # its law is gone
    return posterior, fit, tuple(kept)


def fit_subset(
    posterior: Posterior, fit: MapEstimate, simulation_std: Array, kept: Sequence[bool]
) -> tuple[MapEstimate, Array]:
    """The fit, and the doubt of its sizes, with some of its effects alone."""
    effects = tuple(e for e, stays in zip(fit.effects, kept, strict=True) if stays)
    sizes = np.array([stays for e, stays in zip(fit.effects, kept, strict=True) for _ in e.parameters])
    return maximize_posterior(
        posterior, join_coordinates(fit.x[posterior.layout.nuisances], effects), effects
    ), simulation_std[sizes]


def join_coordinates(nuisances: Array, effects: Sequence[Effect]) -> Array:
    """The vector of a fit that begins with these effects."""
    return np.concatenate([nuisances, *[e.coordinates for e in effects]])
