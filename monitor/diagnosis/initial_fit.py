"""First fit of a recording before any cause is searched, and the further steps that measured ground motion requires."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, get_args

import numpy as np

from monitor.core import Array
from monitor.inference import (
    FORCED,
    Between,
    DrivenPosterior,
    MapEstimate,
    ObservedSpectra,
    Posterior,
    forces_from_quiet_segments,
    guess_levels,
    linearize,
    make_posterior,
    maximize_posterior,
)
from monitor.model import Context, StructuralPrior

FAR = 40
"""Most iterations of a fit that begins far from its end: a first fit to driven motion, or to forces whose spectrum is
far from flat. [iterations; cost]"""
_FIRST_DAMPING = 0.05
"""Damping ratio at which the first fit to driven motion begins. [1; judgement]"""
_SECOND_DAMPING = 0.015
"""Damping ratio at which that fit goes on. [1; judgement]"""
_HELD_DAMPING_PRECISION = 1e4
"""Precision that holds the first damping ratio. [1; rounding]"""
_MAX_SLOPE_UPDATES = 4
"""Most times that the slopes of the exact laws are computed again. [count; cost]"""
ROUGHLY = 4
"""Iterations by which kinds of causes, and the ground's motion between its samples, are compared. [iterations; cost]"""
LONG = 15
"""Most iterations of a fit that is followed to its end. [iterations; cost]"""
COARSE = 0.3
"""Expected gain of the next step at which a fit to driven motion ends. [nats; judgement: driven motion separates causes
by hundreds of nats]"""
_INITIAL_MODEL_ERROR = 0.5
"""Error of the model as a share of the amplitude at the start of a fit to driven motion. [ratio; judgement]"""


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
    if observed.drive is not None:
        prior = prior.with_any_noise()
    posterior = make_posterior(observed, prior.without_nonlinear(), context)
    if observed.drive is None:
        null_fit = maximize_posterior(posterior, first_guess(posterior), iterations=FAR)
    else:
        null_fit = _fit_from_heavy_damping(posterior)
    posterior, null_fit = fit_ground_interpolation(posterior, null_fit)
    posterior = replace(posterior, conditions=linearize(posterior, null_fit.x, ()))
    x = posterior.layout.with_structure(null_fit.x, prior.with_linear(null_fit.x[posterior.layout.structure]))
    posterior = replace(posterior, prior=prior)
    if start is not None and observed.drive is None:  # driven fits lead to the optimum from heavy damping only
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
    """Fit the ambient forces from the quiet segments and refit all else; unchanged without measured ground motion."""
    if not isinstance(posterior, DrivenPosterior):
        return posterior, fit
    x = forces_from_quiet_segments(posterior, fit.x, fit.effects)
    posterior = replace(posterior, wind=x[posterior.layout.forces])
    return posterior, maximize_posterior(posterior, x, fit.effects, iterations=FAR)


def _fit_from_heavy_damping(posterior: Posterior) -> MapEstimate:
    """Fit driven motion for the first time, beginning with heavy damping.

    The phases of a driven response lead to the optimum only from nearby; heavy damping widens the peaks.
    """
    known, x = posterior.prior, first_guess(posterior)
    modes = posterior.layout.damping
    mean, added_precision = known.mean.copy(), np.zeros(known.mean.size)
    mean[modes], added_precision[modes] = np.log(_FIRST_DAMPING), _HELD_DAMPING_PRECISION
    precision = known.precision + np.diag(added_precision)
    heavily_damped = replace(posterior, prior=replace(known, mean=mean, precision=precision))
    x_start = maximize_posterior(heavily_damped, posterior.layout.with_structure(x, mean), iterations=LONG).x
    x_start[modes] = np.log(_SECOND_DAMPING)
    return maximize_posterior(posterior, x_start, iterations=FAR)


def fit_ground_interpolation(posterior: Posterior, fit: MapEstimate) -> tuple[Posterior, MapEstimate]:
    """Choose the interpolation of the ground motion between its samples that explains the floors best, and refit with it.

    Without measured ground motion posterior and fit are returned unchanged.
    """
    if not isinstance(posterior, DrivenPosterior):
        return posterior, fit
    candidates = [(posterior, fit)]
    for between in get_args(Between):
        if between != posterior.drive.between:
            other = posterior.between_samples(between)
            candidates.append((other, maximize_posterior(other, fit.x, fit.effects, iterations=ROUGHLY)))
    posterior, best = max(candidates, key=lambda pair: pair[1].log_posterior)
    return posterior, fit if best is fit else maximize_posterior(posterior, best.x, best.effects, iterations=FAR)


def fit_exact_slopes(posterior: Posterior, fit: MapEstimate) -> tuple[Posterior, MapEstimate]:
    """Refit a response to measured ground motion with the slopes of the exact laws.

    Slopes of the linearized laws lead close to the best fit only.  The slopes are computed again until the gain ends.
    """
    for _ in range(_MAX_SLOPE_UPDATES):
        posterior, before = posterior.with_exact_slopes(fit.x, fit.effects), fit
        fit = maximize_posterior(posterior, fit.x, fit.effects, iterations=FAR)
        if fit.log_posterior < before.log_posterior + COARSE:
            break
    return posterior, fit


def first_guess(posterior: Posterior) -> Annotated[Array, "p"]:
    """Guess the forces and the levels of the classes as the start of a fit.

    With measured ground motion the forces are small, and the levels are those of the model's error as a share of the power.
    """
    x, ratio = guess_levels(posterior)
    layout = posterior.layout
    x[layout.forces], x[layout.levels] = np.log(ratio.mean()), np.log(ratio / ratio.mean())
    if isinstance(posterior, DrivenPosterior):
        power = np.einsum("kfaa->kfa", posterior.observed.spectra).real
        x[layout.forces] += np.log(FORCED)
        x[layout.levels] = np.log(power / posterior.power).mean(axis=(1, 2)) + 2.0 * np.log(_INITIAL_MODEL_ERROR)
    return x
