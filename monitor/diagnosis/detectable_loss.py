"""Smallest loss of stiffness that a diagnosis would have found."""

from __future__ import annotations

import numpy as np

from monitor.diagnosis.missing_modes import cost_of_weak_modes
from monitor.diagnosis.score_test import parameter_cost, whitened_slope
from monitor.inference import MapEstimate, Posterior
from monitor.model import EFFECTS, Effect, inverse, locations


def detectable_losses(posterior: Posterior, fit: MapEstimate, margin: float) -> list[float | None]:
    """Compute the smallest relative loss of each story that the search would find in 95 % of recordings like this one.

    `fit` is the final one, without causes, which need the log evidence `margin`, nats.  None where no loss would be found.
    """
    (kind,) = (kind for kind in EFFECTS.values() if kind.is_stiffness_loss)
    typical, context = posterior.conditions[posterior.n_classes // 2], posterior.context
    starts = [kind.starts(place, context, typical)[0] for place in locations("story", context)]
    prediction = posterior.predict(fit.x, fit.effects)
    tangent = fit.slopes
    normal = inverse(fit.information + posterior.normal_prior(fit.x, fit.effects)[1])

    def loss(effect: Effect) -> float | None:
        needed = margin + parameter_cost(posterior, 1) + cost_of_weak_modes(posterior, fit, effect)
        v = whitened_slope(posterior, fit, prediction, effect)
        along = tangent.along(v)
        information = float(v @ v - along @ normal @ along)
        stds = np.sqrt(2.0 * needed) + 1.645  # quantile of 95 %
        size = stds * float(abs(effect.coordinates[0])) / np.sqrt(max(information, 1e-9))
        return size if size < 1.0 else None

    return [loss(effect) for effect in starts]
