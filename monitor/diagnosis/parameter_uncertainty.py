"""Standard deviations of the causes' sizes: by the fit, by the simulations' random error, and by the form of the model."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from monitor.core import Array
from monitor.inference import MapEstimate, Posterior
from monitor.model import Effect, FittedModel

_SIGNIFICANT_SIZE_STDS = 2.0
"""Smallest distance from zero at which an effect's size counts as determined. [standard deviations; convention: two
sigma]"""

DIFFERS_STDS = 3.0
"""Distance from which an estimate differs from what it is compared with. [standard deviations; convention: three sigma]"""


def coordinate_std(
    posterior: Posterior,
    fit: MapEstimate,
    fit_std: Annotated[Array, "coordinates"],
    simulation_std: Annotated[Array, "coordinates"],
) -> list[Annotated[Array, "p"]]:
    """Compute the standard deviations of each effect's coordinates from those by the fit and by the simulations' chance."""
    fitted, ends = summarize_fit(posterior, fit), np.cumsum([len(e.parameters) for e in fit.effects])[:-1]
    own = zip(fit.effects, np.split(fit_std, ends), np.split(simulation_std, ends), strict=False)
    return [np.hypot(std, np.hypot(by_chance, effect.form_std_in(fitted))) for effect, std, by_chance in own]


def is_significant(effect: Effect, deviation: Annotated[Array, "p"]) -> bool:
    """Decide if an effect's size differs significantly from that of no effect; an effect without a size always does.

    Of several sizes, as the components of a mode's shape, one is enough.  `deviation` is that of the coordinates.
    """
    found = zip(sizes(effect), deviation, strict=True)
    significant = [is_far(size, std) for size, std in found if size is not None]
    return any(significant) or not significant


def is_far(size: float, std: float) -> bool:
    """Decide if a size differs significantly from none."""
    return abs(size) >= _SIGNIFICANT_SIZE_STDS * std


def sizes(effect: Effect) -> list[float | None]:
    """Return the distance of every coordinate from that of no effect; None of those that no effect may have too."""
    absent = [
        None if p.absent is None else p.coordinate(p.absent) if np.isfinite(p.absent) else 0.0
        for p in effect.parameters
    ]
    return [None if none is None else float(x - none) for x, none in zip(effect.coordinates, absent, strict=True)]


def summarize_fit(posterior: Posterior, fit: MapEstimate) -> FittedModel:
    """Summarize a fit for the effects, which state from it the uncertainty that their laws' form leaves."""
    correction = fit.x[posterior.layout.correction]
    return FittedModel(
        structure=posterior.context_at(fit.x).structure,
        condition=posterior.conditions[posterior.n_classes // 2],
        effects=posterior.effects(fit.x, fit.effects),
        correction_rms=float(np.sqrt((correction**2).mean())) if correction.size else 0.0,
        bin_hz=posterior.observed.band.bin_hz,
    )
