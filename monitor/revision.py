"""What is seen again once more is known: the model without a cause, and causes beside later ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from monitor.corrected import Corrected
from monitor.effects import Effect
from monitor.fitting import Fit, fit
from monitor.likelihood import Problem
from monitor.motion import conditions
from monitor.parallel import each
from monitor.polish import Polished
from monitor.results import Array
from monitor.search import Candidate, evidence_of, judge

_MISSED = 3.0
"""Nats by which a fit may miss the best of its own form."""
_RIVALS = 3
"""Causes of the same round that are tried again in place of one."""


def missed(problem: Problem, at: Fit, tried: Sequence[Polished]) -> tuple[Problem, Fit] | None:
    """A better fit of the same form than `at`, where a candidate's fit came upon one; None where none did.

    Else the candidate would get the credit for it.
    """
    begun = [(p.candidate.fit.x[: at.x.size], p.candidate.fit.effects[:-1]) for p in tried]
    likely = [sum(problem.score(*start)) for start in begun]
    if not begun or not max(likely) > at.log_posterior + _MISSED:
        return None
    found = fit(problem, *begun[int(np.argmax(likely))])
    problem = moved(problem, found)
    return problem, fit(problem, found.x, found.effects)


def moved(problem: Problem, at: Fit) -> Problem:
    """The problem with its classes' motion as the fitted model has it; a correction stays at the motion that was simulated."""
    if isinstance(problem, Corrected):
        return problem
    return replace(problem, conditions=conditions(problem, at.x, at.effects))


def revised(
    problem: Problem, at: Fit, accepted: Sequence[Candidate], rounds: Sequence[Sequence[Candidate]], margin: float
) -> tuple[Problem, Fit, list[Candidate]]:
    """The causes once the later ones are known: without what they made superfluous, and rivals where these are better now.

    Parameters
    ----------
    rounds
        Of every cause, the candidates among which it was accepted, best first.
    margin : float
        Evidence that a cause needs, nats.
    """
    kept: list[Candidate] = []
    for cause, tried in zip(accepted[:-1], rounds, strict=False):
        n, i = problem.n_nuisance, [(e.name, e.location) for e in at.effects].index(cause.key)
        rest = (*at.effects[:i], *at.effects[i + 1 :])
        without = fit(problem, joined(at.x[:n], rest), rest)
        worth = evidence_of(problem, without, at, len(cause.effect.parameters)).evidence
        taken = {cause.key, *((e.name, e.location) for e in rest)}
        # What simulation added to a law is its own: none takes its place, and it none's.
        rivals = [c.effect for c in tried if not (cause.effect.nonlinear or c.effect.nonlinear or c.key in taken)][
            :_RIVALS
        ]
        best = max(each(partial(judge, problem, without), rivals), key=lambda c: c.evidence, default=None)
        if best is not None and best.evidence > max(worth, margin):
            effects = (*best.fit.effects[:i], best.effect, *best.fit.effects[i:-1])
            at = fit(problem, joined(best.fit.x[:n], effects), effects)
            kept.append(best)
        elif worth > margin:
            kept.append(cause)
        else:
            at = without
            if isinstance(problem, Corrected):
                problem = replace(problem, doubt=np.zeros(0))  # which was that of other causes
    return (
        problem if any(e.nonlinear for e in at.effects) else replace(problem, offset=None),
        at,
        [*kept, *accepted[-1:]],
    )


def joined(nuisances: Array, effects: Sequence[Effect]) -> Array:
    """The vector of a fit that begins with these effects."""
    return np.concatenate([nuisances, *[e.coordinates for e in effects]])
