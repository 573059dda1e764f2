"""Fit of the excitation of a model with a given structure: the most probable forces, levels and noise of a recording."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Self, get_args

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, ComplexArray, parallel_map
from monitor.inference.arrays import Spectra
from monitor.inference.corrected_posterior import relative_to
from monitor.inference.driven_posterior import DrivenPosterior
from monitor.inference.exact_simulation import draw_forces, simulate_spectra
from monitor.inference.input_response import Between
from monitor.inference.linearization import linearize
from monitor.inference.observed_spectra import ObservedSpectra, nearest_classes
from monitor.inference.parameter_layout import ParameterLayout
from monitor.inference.posterior import Posterior
from monitor.inference.starting_point import guess_levels, make_posterior
from monitor.inference.wishart import grown_by
from monitor.model import Context, Model, StructuralPrior, loaded, prior_from_drawing

_N_FIT_SIMULATIONS = 4
"""Simulations of nonlinear laws: a single one tells little of rare events. [count; cost]"""


@dataclass(frozen=True, eq=False, slots=True)
class ExcitationStart:
    """Excitation of a similar recording, or of a part of the recording, under nearly the same model: the start of a fit."""

    forces: Annotated[Array, "n"]
    """Logarithms of the floors' force densities."""
    levels: Annotated[Array, "classes"]
    """Logarithms of the classes' levels."""
    noise: float
    """Logarithm of the noise density."""
    beyond: Spectra | None = None
    """Exact less linearized spectra, relative to the latter; None if not known."""

    @classmethod
    def at(cls, posterior: Posterior, x: Array, beyond: ComplexArray | None = None) -> Self:
        """Take the excitation of a vector of nuisances."""
        layout = posterior.layout
        return cls(x[layout.forces], x[layout.levels], float(x[layout.noise]), beyond)

    def select(self, classes: NDArray[np.intp]) -> ExcitationStart:
        """Take the excitation of the given classes."""
        return replace(self, levels=self.levels[classes], beyond=None if self.beyond is None else self.beyond[classes])

    @property
    def vector(self) -> Array:
        """Forces, levels and noise in the order of the parameter vector."""
        return np.concatenate([self.forces, self.levels, [self.noise]])


def fit_excitation(
    evidence: ObservedSpectra,
    model: Model,
    context: Context,
    reference_degc: float | None,
    near: ExcitationStart | None = None,
) -> tuple[Posterior, Array]:
    """Fit levels and noise of a recording under a model, from `near` if given; all other parameters stay as stated.

    Laws that depend on the level are linearized at the motion of the fitted model, which is why the fit is
    repeated.  Simulation adds the difference of the exact from the linearized laws.  `reference_degc` is the temperature of
    the stated stiffnesses; None for the recording's mean.  Returned are the posterior at the fitted motion, and the fitted
    nuisances.
    """
    sizes = context.structure.n_stories + context.structure.n_masses
    known = replace(prior_from_drawing(model, np.ones(sizes), len(context.channels)), reference_degc=reference_degc)
    without_effects = slice(0, ParameterLayout.of(known).persistent.start)
    plain = replace(known, model=replace(model, effects=()), mean=known.mean[without_effects])
    posterior = make_posterior(evidence, plain, context)
    if isinstance(posterior, DrivenPosterior):
        # One level is fitted for all forces, which therefore start from equal values.
        posterior, near = _best_between_samples(posterior, known), None
    if near is None:
        x, ratio = guess_levels(posterior)
        x[posterior.layout.forces], x[posterior.layout.levels] = posterior.levels_of_equal_forces(ratio)
    else:
        near = near.select(nearest_classes(near.levels.size, posterior.n_classes))
        x = np.concatenate([plain.mean, near.vector])
    if near is None or not model.effects:
        x = posterior.fit_levels(x)
    for _ in range(2 if model.effects else 0):
        at_prior = posterior.layout.with_structure(x, known.mean)
        conditions = linearize(posterior, x, (), with_motion=any(effect.nonlinear for effect in model.effects))
        posterior = replace(posterior, conditions=conditions, prior=known)
        x = posterior.fit_levels(at_prior)
    if posterior.linearizes(model.effects):
        linear = posterior.without_drift().scatter(x, ())
        beyond = _simulated_correction(posterior, x, linear) if near is None or near.beyond is None else near.beyond
        corrected = replace(posterior, offset=grown_by(linear, beyond) - linear)
        if np.isfinite(corrected.score(x, ())[0]):  # the motion under a far too strong law cannot be corrected
            posterior, x = corrected, corrected.fit_levels(x)
    return posterior, x


def _simulated_correction(posterior: Posterior, x: Array, linear: Spectra) -> Spectra:
    """Simulate the difference of the exact from the linearized spectra, relative to the latter."""
    loaded()

    def added(seed: int) -> ComplexArray:
        return simulate_spectra(posterior, x, (), draw_forces(posterior, x, (), seed)).controlled

    return relative_to(
        linear, np.mean(parallel_map(added, range(_N_FIT_SIMULATIONS)), axis=0), posterior.observed.band.hz
    )


def _best_between_samples(posterior: DrivenPosterior, known: StructuralPrior) -> DrivenPosterior:
    """Choose the ground's motion between its samples that leaves the least of the floors' motion unexplained."""
    whole = replace(posterior, prior=known)
    x = np.zeros(whole.layout.n_nuisance)
    x[whole.layout.structure] = known.mean

    def log_residual(between: Between) -> float:
        residual = whole.observed.segments.values - whole.between_samples(between).mean(x, ())
        return float(np.log((np.abs(residual) ** 2).mean(axis=0)).sum())

    return posterior.between_samples(min(get_args(Between), key=log_residual))
