"""What is seen again once more is known: the model without a cause, and causes beside later ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from monitor.core import Array, parallel_map
from monitor.diagnosis.score_test import Candidate, fit_best, score_candidate
from monitor.diagnosis.simulation_refit import RefittedCandidate, fit_persistent_effects
from monitor.inference import CorrectedPosterior, MapEstimate, Posterior, linearize, maximize_posterior
from monitor.model import Effect

_MISSED = 3.0
"""Nats by which a fit may miss the best of its own form."""
_RIVALS = 3
"""Causes of the same round that are tried again in place of one."""


def simulate_what_was_missed(
    problem: Posterior, at: MapEstimate, tried: Sequence[RefittedCandidate]
) -> tuple[Posterior, MapEstimate] | None:
    """A better fit of the same form than `at`, where a candidate's fit came upon one; None where none did.

    Else the candidate would get the credit for it.
    """
    begun = [(p.candidate.fit.x[: at.x.size], p.candidate.fit.effects[:-1]) for p in tried]
    likely = [sum(problem.score(*start)) for start in begun]
    if not begun or not max(likely) > at.log_posterior + _MISSED:
        return None
    found = maximize_posterior(problem, *begun[int(np.argmax(likely))])
    problem = moved(problem, found)
    return problem, maximize_posterior(problem, found.x, found.effects)


def moved(problem: Posterior, at: MapEstimate) -> Posterior:
    """The problem with its classes' motion as the fitted model has it; a correction stays at the motion that was simulated."""
    if isinstance(problem, CorrectedPosterior):
        return problem
    return replace(problem, conditions=linearize(problem, at.x, at.effects))


def revise_candidates(
    problem: Posterior,
    at: MapEstimate,
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
    later = rounds[len(accepted)] if len(at.effects) > len(accepted) else ()
    kept, replaced = list(accepted), False
    for cause, tried in zip(accepted, rounds, strict=False):
        if len(at.effects) == 1 or (cause is accepted[-1] and len(at.effects) == len(kept) and not replaced):
            break  # nothing came after it
        nuisances, i = problem.layout.nuisances, kept.index(cause)
        rest = (*at.effects[:i], *at.effects[i + 1 :])
        without = maximize_posterior(problem, joined(at.x[nuisances], rest), rest)
        worth = score_candidate(problem, without, at, len(cause.effect.parameters)).evidence
        taken = {cause.key, *(c.key for c in later), *((e.name, e.location) for e in rest)}
        # What simulation added to a law is its own: none takes its place, and it none's.
        linear = [] if cause.effect.nonlinear else [c for c in tried if not c.effect.nonlinear]
        rivals = [c.effect for c in linear if c.key not in taken]
        bar = max(worth + lead, margin)
        judged = parallel_map(partial(fit_best, problem, without, bar=bar), rivals[:_RIVALS])
        best = max(judged, key=lambda c: c.evidence, default=None)
        if best is not None and best.evidence > bar:
            effects = (*best.fit.effects[:i], best.effect, *best.fit.effects[i:-1])
            at = maximize_posterior(problem, joined(best.fit.x[nuisances], effects), effects)
            kept[i], replaced = best, True
        elif worth > margin:
            continue
        else:
            at = without
            del kept[i]
        problem = moved(problem, at)
        if isinstance(problem, CorrectedPosterior):
            problem = replace(problem, doubt=np.zeros(0))  # which was that of other causes
        at = maximize_posterior(problem, at.x, at.effects)
    if not any(e.nonlinear for e in at.effects) and any(c.effect.nonlinear for c in accepted):
        problem, at, _ = fit_persistent_effects(problem, at)  # its law is gone
    return problem, at, tuple(kept)


def only(problem: Posterior, at: MapEstimate, doubt: Array, kept: Sequence[bool]) -> tuple[MapEstimate, Array]:
    """The fit, and the doubt of its sizes, with some of its effects alone."""
    effects = tuple(e for e, stays in zip(at.effects, kept, strict=True) if stays)
    sizes = np.array([stays for e, stays in zip(at.effects, kept, strict=True) for _ in e.parameters])
    return maximize_posterior(problem, joined(at.x[problem.layout.nuisances], effects), effects), doubt[sizes]


def joined(nuisances: Array, effects: Sequence[Effect]) -> Array:
    """The vector of a fit that begins with these effects."""
    return np.concatenate([nuisances, *[e.coordinates for e in effects]])
