"""How well causes' sizes are known: by the fit, by simulations' chance, and by what the model's form leaves open."""

from __future__ import annotations

import numpy as np

from monitor.core import Array
from monitor.inference import MapEstimate, Posterior
from monitor.model import Effect, FittedModel

_SIGNIFICANT_SIZE_STDS = 2.0
"""Smallest distance from zero at which an effect's size counts as determined. [standard deviations; convention: two
sigma]"""


def coordinate_std(posterior: Posterior, fit: MapEstimate, simulation_std: Array) -> list[Array]:
    """Standard deviations of every effect's coordinates, shape (p,) each; `doubt` are those by simulation, of all of them."""
    first, out, fitted = 0, [], summarize_fit(posterior, fit)
    own = np.sqrt(np.maximum(np.diag(fit.covariance)[posterior.layout.effects], 0.0))
    for effect in fit.effects:
        these = slice(first, first + len(effect.parameters))
        out.append(np.hypot(own[these], np.hypot(simulation_std[these], effect.form_std_in(fitted))))
        first = these.stop
    return out


def is_significant(effect: Effect, deviation: Array) -> bool:
    """Whether a size is beyond doubt not that of no effect; what has no size always is."""
    away = [
        abs(x - (p.coordinate(p.absent) if np.isfinite(p.absent) else 0.0)) >= _SIGNIFICANT_SIZE_STDS * std
        for p, x, std in zip(effect.parameters, effect.coordinates, deviation, strict=True)
        if p.absent is not None
    ]
    return all(away)


def summarize_fit(posterior: Posterior, fit: MapEstimate) -> FittedModel:
    """Sum up a fit as far as effects ask for it to say what their laws' form leaves open."""
    correction = fit.x[posterior.layout.correction]
    return FittedModel(
        structure=posterior.context_at(fit.x).structure,
        condition=posterior.conditions[posterior.n_classes // 2],
        effects=(*posterior.prior.effects(fit.x), *fit.effects),
        correction_rms=float(np.sqrt((correction**2).mean())) if correction.size else 0.0,
        bin_hz=posterior.observed.band.bin_hz,
    )
