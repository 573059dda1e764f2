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
"""Prior relative standard deviation of a story's stiffness in the comparison of damage indices. [ratio; not
recorded]"""


def ddi_effect(diagnosis: Diagnosis) -> dict[str, Any]:
    """Damage index of every story, first by refitting stiffness alone, then beside the causes that were found.

    Changes of stiffness are no cause here: they are what the index is to show.

    Returns
    -------
    dict
        ``without`` and ``with`` the causes: lists of shape (n_stories,), 0.2 = 20 % lost; empty where nothing was added.
    """
    causes = tuple(e for e in diagnosis.final_fit.effects if not e.is_stiffness_loss)
    if not diagnosis.final_fit.effects:
        return {"without": [], "with": []}
    posterior = _with_free_stiffness(diagnosis.posterior)
    # The offset is a cause's.
    forms = [(replace(posterior, offset=None), diagnosis.null_fit.x, ()), (posterior, diagnosis.final_fit.x, causes)]
    alone, *beside = parallel_map(lambda form: _fitted(*form), forms[: 2 if causes else 1])
    known = np.exp(posterior.prior.mean[posterior.layout.stiffness])

    def index(fit: MapEstimate) -> list[float]:
        return [float(v) for v in 1.0 - np.exp(fit.x[posterior.layout.stiffness]) / known]

    return {"without": index(alone), "with": index(*(beside or [alone]))}


def _fitted(posterior: Posterior, x: Array, effects: tuple[Effect, ...]) -> MapEstimate:
    """The fit, laws that depend on the level being linear at the motion that it shows."""
    fit = maximize_posterior(posterior, x, effects)
    posterior = replace(posterior, conditions=linearize(posterior, fit.x, fit.effects))
    return maximize_posterior(posterior, fit.x, fit.effects)


def _with_free_stiffness(posterior: Posterior) -> Posterior:
    """The baseline holds its stiffnesses fixed; an index asks what they are now."""
    stiffness, precision = posterior.layout.stiffness, posterior.prior.precision.copy()
    precision[stiffness], precision[:, stiffness] = 0.0, 0.0
    np.fill_diagonal(precision[stiffness, stiffness], 1.0 / _STIFFNESS_STD**2)
    known = replace(posterior.prior, precision=precision, model=posterior.prior.model.as_built())
    return replace(posterior, prior=known)
