"""What an extended model does to the damage index: how much of an apparent loss the causes that were found account for."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from monitor.core import Array, parallel_map
from monitor.diagnosis.stepwise_selection import Diagnosis
from monitor.inference import MapEstimate, Posterior, linearize, maximize_posterior
from monitor.model import Effect

_STIFFNESS_STD = 0.2


def ddi_effect(diagnosis: Diagnosis) -> dict[str, Any]:
    """Damage index of every story, first by refitting stiffness alone, then beside the causes that were found.

    Changes of stiffness are no cause here: they are what the index is to show.

    Returns
    -------
    dict
        ``without`` and ``with`` the causes: lists of shape (n_stories,), 0.2 = 20 % lost; empty where nothing was added.
    """
    causes = tuple(e for e in diagnosis.final.effects if not e.is_stiffness_loss)
    if not diagnosis.final.effects:
        return {"without": [], "with": []}
    problem = _with_free_stiffness(diagnosis.problem)
    # The offset is a cause's.
    forms = [(replace(problem, offset=None), diagnosis.null.x, ()), (problem, diagnosis.final.x, causes)]
    alone, *beside = parallel_map(lambda form: _fitted(*form), forms[: 2 if causes else 1])
    known = np.exp(problem.prior.mean[problem.layout.stiffness])

    def index(at: MapEstimate) -> list[float]:
        return [float(v) for v in 1.0 - np.exp(at.x[problem.layout.stiffness]) / known]

    return {"without": index(alone), "with": index(*(beside or [alone]))}


def _fitted(problem: Posterior, x: Array, effects: tuple[Effect, ...]) -> MapEstimate:
    """The fit, laws that depend on the level being linear at the motion that it shows."""
    at = maximize_posterior(problem, x, effects)
    problem = replace(problem, conditions=linearize(problem, at.x, at.effects))
    return maximize_posterior(problem, at.x, at.effects)


def _with_free_stiffness(problem: Posterior) -> Posterior:
    """The baseline holds its stiffnesses fixed; an index asks what they are now."""
    stiffness, precision = problem.layout.stiffness, problem.prior.precision.copy()
    precision[stiffness], precision[:, stiffness] = 0.0, 0.0
    np.fill_diagonal(precision[stiffness, stiffness], 1.0 / _STIFFNESS_STD**2)
    known = replace(problem.prior, precision=precision, model=problem.prior.model.as_built())
    return replace(problem, prior=known)
