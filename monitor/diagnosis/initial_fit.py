"""A recording's problem before any cause is looked for, and what a measured ground asks of its fits."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import numpy as np

from monitor.core import Array
from monitor.inference import (
    FORCED,
    Between,
    DrivenPosterior,
    MapEstimate,
    ObservedSpectra,
    ParameterLayout,
    Posterior,
    forces_from_quiet_segments,
    guess_levels,
    linearize,
    make_posterior,
    maximize_posterior,
)
from monitor.model import Context, StructuralPrior

FAR = 40
"""Iterations of a fit on a longer way: a first one to driven motion, whose phases tell more, or to forces far from white."""
_HEAVY, _LIGHTER, _HELD_DAMPING = 0.05, 0.015, 1e4
"""Damping ratios at which that fit begins and goes on, and the precision that holds the former."""
_TURNS = 4
"""Times at most that the exact laws' slopes are taken anew."""
ROUGHLY, LONG = 4, 15
"""Iterations by which ways of the ground between its samples, and kinds of causes, are compared; of a fit to the end."""
COARSE = 0.3
"""Nats that the last step of a fit to driven motion may promise, which tells causes apart by hundreds."""
_MODEL_ERROR = 0.5
"""With the ground measured: error of the model as a share of the measured amplitude, at the start."""


def fit_linearized(
    evidence: ObservedSpectra, reference: StructuralPrior, context: Context
) -> tuple[Posterior, MapEstimate]:
    """The problem without extra effects, fitted, with the motion of every class known.

    Nonlinear laws are made linear at the motion of the fitted model, so the fit is made twice where standing effects
    need it.
    """
    if evidence.drive is not None:
        reference = reference.with_any_noise()
    linear = slice(0, ParameterLayout.of(reference).persistent.start)
    plain = replace(
        reference,
        model=replace(reference.model, effects=()),
        mean=reference.mean[linear],
        precision=reference.precision[linear, linear],
    )
    problem = make_posterior(evidence, plain, context)
    null = maximize_posterior(problem, _first_guess(problem)) if evidence.drive is None else _from_afar(problem)
    problem, null = between_samples(problem, null)
    problem = replace(problem, conditions=linearize(problem, null.x, ()))
    if not reference.n_standing:
        return beside_wind(problem, null)
    structure = np.concatenate([null.x[linear], reference.mean[linear.stop :]])
    x = problem.layout.with_structure(null.x, structure)
    for _ in range(2):
        problem = replace(problem, prior=reference)
        null = maximize_posterior(problem, x)
        x = null.x
        problem = replace(problem, conditions=linearize(problem, x, ()))
    return beside_wind(problem, null)


def beside_wind(problem: Posterior, at: MapEstimate) -> tuple[Posterior, MapEstimate]:
    """With the forces that the quiet tells, where the ground was measured."""
    if not isinstance(problem, DrivenPosterior):
        return problem, at
    x = forces_from_quiet_segments(problem, at.x, at.effects)
    problem = replace(problem, wind=x[problem.layout.forces])
    return problem, maximize_posterior(problem, x, at.effects, iterations=FAR)


def _from_afar(problem: Posterior) -> MapEstimate:
    """The first fit to driven motion, whose phases lead back from nearby only: with heavy damping first, for wide peaks."""
    known, x = problem.prior, _first_guess(problem)
    modes = problem.layout.damping
    mean, held = known.mean.copy(), np.zeros(known.mean.size)
    mean[modes], held[modes] = np.log(_HEAVY), _HELD_DAMPING
    precision = known.precision + np.diag(held)
    wide = replace(problem, prior=replace(known, mean=mean, precision=precision))
    near = maximize_posterior(wide, problem.layout.with_structure(x, mean), iterations=LONG).x
    near[modes] = np.log(_LIGHTER)
    return maximize_posterior(problem, near, iterations=FAR)


def between_samples(problem: Posterior, at: MapEstimate) -> tuple[Posterior, MapEstimate]:
    """With the ground's motion between its samples that explains the floors best, where the ground was measured."""
    if not isinstance(problem, DrivenPosterior):
        return problem, at
    tried = [(problem, at)]
    for between in get_args(Between):
        if between != problem.drive.between:
            other = problem.between_samples(between)
            tried.append((other, maximize_posterior(other, at.x, at.effects, iterations=ROUGHLY)))
    problem, best = max(tried, key=lambda pair: pair[1].log_posterior)
    return problem, at if best is at else maximize_posterior(problem, best.x, best.effects, iterations=FAR)


def exactly(problem: Posterior, at: MapEstimate) -> tuple[Posterior, MapEstimate]:
    """With the exact laws' slopes at the best fit to a measured ground's response; linearized ones lead near it only."""
    for _ in range(_TURNS):
        problem, before = problem.with_exact_slopes(at.x, at.effects), at
        at = maximize_posterior(problem, at.x, at.effects, iterations=FAR)
        if at.log_posterior < before.log_posterior + COARSE:
            break
    return problem, at


def _first_guess(problem: Posterior) -> Array:
    """Guess forces and levels; beside a measured ground small forces, and the model's own error as a share of the power."""
    x, ratio = guess_levels(problem)
    layout = problem.layout
    x[layout.forces], x[layout.levels] = np.log(ratio.mean()), np.log(ratio / ratio.mean())
    if isinstance(problem, DrivenPosterior):
        power = np.einsum("kfaa->kfa", problem.observed.spectra).real
        x[layout.forces] += np.log(FORCED)
        x[layout.levels] = np.log(power / problem.power).mean(axis=(1, 2)) + 2.0 * np.log(_MODEL_ERROR)
    return x
