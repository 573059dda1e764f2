"""First fit of a recording before any cause is searched, and the further steps that measured ground motion requires."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import numpy as np

from monitor.core import Array
from monitor.diagnosis.plan import COARSE, FAR, LONG, ROUGHLY, plan_of
from monitor.inference import (
    MapEstimate,
    ObservedSpectra,
    Posterior,
    guess_levels,
    linearize,
    make_posterior,
    maximize_posterior,
)
from monitor.model import Context, StructuralPrior

_HELD_DAMPING_PRECISION = 1e4
"""Precision that holds the first damping ratio. [1; rounding]"""
_MAX_SLOPE_UPDATES = 4
"""Most times that the slopes of the exact laws are computed again. [count; cost]"""


def fit_linearized(
    observed: ObservedSpectra,
    prior: StructuralPrior,
    context: Context,
    start: Annotated[Array, "nuisances"] | None = None,
) -> tuple[Posterior, MapEstimate]:
    """Fit the model without extra effects, with nonlinear laws linearized at the fitted motion.

    The first fit is without the persistent laws that depend on the motion.  With them the fit is made twice, since their
    linearization needs the motion of the fitted model.  The posterior has the motion of every class.  From the parameters `start`
    of another fit to the recording it is fitted too, and the better fit is taken.
    """
    posterior = make_posterior(observed, prior, context)
    plan = plan_of(posterior)
    prior = plan.begins_with(prior)
    posterior = replace(posterior, prior=prior.without_nonlinear())
    at = first_guess(posterior)
    for held, then in plan.first_dampings:
        at = _start_from_heavy_damping(posterior, at, held, then)
    null_fit = maximize_posterior(posterior, at, iterations=FAR)
    posterior, null_fit = fit_ground_interpolation(posterior, null_fit)
    posterior = replace(posterior, conditions=linearize(posterior, null_fit.x, ()))
    x = posterior.layout.with_structure(null_fit.x, prior.with_linear(null_fit.x[posterior.layout.structure]))
    posterior = replace(posterior, prior=prior)
    if start is not None and plan.starts_anywhere:
        fits = [maximize_posterior(posterior, at, iterations=FAR, keep_slopes=False) for at in (x, start)]
        x = max(fits, key=lambda fit: fit.log_posterior).x
    elif not prior.n_persistent:
        return fit_ambient_forces(posterior, null_fit)
    for _ in range(2):
        null_fit = maximize_posterior(posterior, x, iterations=FAR)
        x = null_fit.x
        posterior = replace(posterior, conditions=linearize(posterior, x, ()))
    return fit_ambient_forces(posterior, null_fit)


def fit_ambient_forces(posterior: Posterior, fit: MapEstimate) -> tuple[Posterior, MapEstimate]:
    """Fit the ambient forces from the quiet segments and refit all else; unchanged without measured inputs."""
    known, x = posterior.with_quiet_forces(fit.x, fit.effects)
    return known, fit if known is posterior else maximize_posterior(known, x, fit.effects, iterations=FAR)


def _start_from_heavy_damping(
    posterior: Posterior, x: Annotated[Array, "nuisances"], held: float, then: float
) -> Annotated[Array, "nuisances"]:
    """Fit with a damping ratio that is held; return the start of the next fit, with another one.

    The phases of a driven response lead to the optimum only from nearby; heavy damping widens the peaks.
    """
    known = posterior.prior
    modes = posterior.layout.damping
    mean, added_precision = known.mean.copy(), np.zeros(known.mean.size)
    mean[modes], added_precision[modes] = np.log(held), _HELD_DAMPING_PRECISION
    precision = known.precision + np.diag(added_precision)
    heavily_damped = replace(posterior, prior=replace(known, mean=mean, precision=precision))
    x_start = maximize_posterior(heavily_damped, posterior.layout.with_structure(x, mean), iterations=LONG).x
    x_start[modes] = np.log(then)
    return x_start


def fit_ground_interpolation(posterior: Posterior, fit: MapEstimate) -> tuple[Posterior, MapEstimate]:
    """Choose the interpolation of the ground motion between its samples that explains the floors best, and refit with it.

    Without measured ground motion posterior and fit are returned unchanged.
    """
    candidates = [(posterior, fit)]
    for other in posterior.other_interpolations():
        candidates.append((other, maximize_posterior(other, fit.x, fit.effects, iterations=ROUGHLY)))
    posterior, best = max(candidates, key=lambda pair: pair[1].log_posterior)
    return posterior, fit if best is fit else maximize_posterior(posterior, best.x, best.effects, iterations=FAR)


def fit_exact_slopes(posterior: Posterior, fit: MapEstimate) -> tuple[Posterior, MapEstimate]:
    """Refit a response to measured ground motion with the slopes of the exact laws.

    Slopes of the linearized laws lead close to the best fit only.  The slopes are computed again until the gain ends.
    Posterior and fit are returned unchanged where there are none.
    """
    for _ in range(_MAX_SLOPE_UPDATES):
        exact, before = posterior.with_exact_slopes(fit.x, fit.effects), fit
        if exact is posterior:
            break
        posterior = exact
        fit = maximize_posterior(posterior, fit.x, fit.effects, iterations=FAR)
        if fit.log_posterior < before.log_posterior + COARSE:
            break
    return posterior, fit


def first_guess(posterior: Posterior) -> Annotated[Array, "p"]:
    """Guess the forces and the levels of the classes as the start of a fit."""
    x, ratio = guess_levels(posterior)
    layout = posterior.layout
    x[layout.forces], x[layout.levels] = posterior.first_levels(ratio)
    return x
