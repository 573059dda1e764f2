"""Effect of an extended model on the damage index: the part of an apparent loss that the causes account for."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from monitor.core import Array, parallel_map
from monitor.diagnosis.verdict import Diagnosis
from monitor.inference import MapEstimate, Posterior, linearize, maximize_posterior
from monitor.model import Effect

_STIFFNESS_STD = 0.2
"""Prior relative standard deviation of a story's stiffness in the comparison of damage indices. [ratio; not
recorded]"""


def ddi_effect(diagnosis: Diagnosis) -> dict[str, Any]:
    """Compute every story's damage index with stiffness refitted alone, and with stiffness refitted beside the causes.

    Changes of stiffness do not count as causes here, since the index is to show them.  The keys ``without`` and ``with`` (the
    causes) hold lists of a number for each story, 0.2 = 20 % lost; empty where nothing was added.
    """
    causes = tuple(e for e in diagnosis.final_fit.effects if not e.is_stiffness_loss)
    if not diagnosis.final_fit.effects:
        return {"without": [], "with": []}
    posterior = _with_free_stiffness(diagnosis.posterior)
    # The simulated offset belongs to a cause, so the fit without causes has none.
    forms = [(replace(posterior, offset=None), diagnosis.null_fit.x, ()), (posterior, diagnosis.final_fit.x, causes)]
    without, *with_causes = parallel_map(lambda form: _refit(*form), forms[: 2 if causes else 1])
    known = np.exp(posterior.prior.mean[posterior.layout.stiffness])

    def index(fit: MapEstimate) -> list[float]:
        return [float(v) for v in 1.0 - np.exp(fit.x[posterior.layout.stiffness]) / known]

    return {"without": index(without), "with": index(*(with_causes or [without]))}


def _refit(posterior: Posterior, x: Array, effects: tuple[Effect, ...]) -> MapEstimate:
    """Refit at the fitted motion: laws that depend on the vibration level are linearized at the motion of a first fit."""
    fit = maximize_posterior(posterior, x, effects)
    posterior = replace(posterior, conditions=linearize(posterior, fit.x, fit.effects))
    return maximize_posterior(posterior, fit.x, fit.effects)


def _with_free_stiffness(posterior: Posterior) -> Posterior:
    """Free the stiffnesses, which the baseline's prior holds fixed."""
    stiffness, precision = posterior.layout.stiffness, posterior.prior.precision.copy()
    precision[stiffness], precision[:, stiffness] = 0.0, 0.0
    np.fill_diagonal(precision[stiffness, stiffness], 1.0 / _STIFFNESS_STD**2)
    known = replace(posterior.prior, precision=precision, model=posterior.prior.model.as_built())
    return replace(posterior, prior=known)
