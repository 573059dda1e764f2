"""How well causes' sizes are known: by the fit, by simulations' chance, and by what the model's form leaves open."""

from __future__ import annotations

import numpy as np

from monitor.core import Array
from monitor.inference import MapEstimate, Posterior
from monitor.model import Effect, FittedModel

_SURE = 2.0
"""Standard deviations from nothing that a size must have to be one."""


def deviations(problem: Posterior, at: MapEstimate, doubt: Array) -> list[Array]:
    """Standard deviations of every effect's coordinates, shape (p,) each; `doubt` are those by simulation, of all of them."""
    first, out, fitted = 0, [], summarize_fit(problem, at)
    own = np.sqrt(np.maximum(np.diag(at.covariance)[problem.layout.effects], 0.0))
    for effect in at.effects:
        these = slice(first, first + len(effect.parameters))
        out.append(np.hypot(own[these], np.hypot(doubt[these], effect.form_std_in(fitted))))
        first = these.stop
    return out


def is_significant(effect: Effect, deviation: Array) -> bool:
    """Whether a size is beyond doubt not that of no effect; what has no size always is."""
    away = [
        abs(x - (p.coordinate(p.absent) if np.isfinite(p.absent) else 0.0)) >= _SURE * std
        for p, x, std in zip(effect.parameters, effect.coordinates, deviation, strict=True)
        if p.absent is not None
    ]
    return all(away)


def summarize_fit(problem: Posterior, at: MapEstimate) -> FittedModel:
    """Sum up a fit as far as effects ask for it to say what their laws' form leaves open."""
    correction = at.x[problem.layout.correction]
    return FittedModel(
        structure=problem.context_at(at.x).structure,
        condition=problem.conditions[problem.n_classes // 2],
        effects=(*problem.prior.effects(at.x), *at.effects),
        correction_rms=float(np.sqrt((correction**2).mean())) if correction.size else 0.0,
        bin_hz=problem.observed.band.bin_hz,
    )
