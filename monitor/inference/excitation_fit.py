"""Fit of the excitation of a model with a given structure: the most probable forces, levels and noise of a recording."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Self, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from monitor.core import Array, ComplexArray, levenberg_marquardt, parallel_map
from monitor.inference.ambient_posterior import AmbientPosterior
from monitor.inference.arrays import Spectra
from monitor.inference.corrected_posterior import relative_to
from monitor.inference.driven_posterior import DrivenPosterior
from monitor.inference.exact_simulation import draw_forces, simulate_exact, simulate_spectra
from monitor.inference.input_response import Between
from monitor.inference.linearization import linearize
from monitor.inference.observed_spectra import ObservedSpectra, classify
from monitor.inference.parameter_layout import ParameterLayout
from monitor.inference.posterior import LEVEL_STD, MAX_EXCITATION_STEP, NUDGE, Posterior
from monitor.inference.starting_point import guess_levels, make_posterior
from monitor.inference.wishart import grown_by
from monitor.model import Context, Effect, Model, StructuralPrior, loaded, prior_from_drawing

_MIN_GAIN_NATS = 0.01
"""Expected gain of the next step at which the fit ends. [nats; judgement]"""
_FIXED_SLOPES_NATS = 10.0
"""Gain of a step below which the slopes are not computed again. [nats; judgement]"""
_N_FIT_SIMULATIONS = 4
"""Simulations of nonlinear laws: a single one tells little of rare events. [count; cost]"""
_NO_LIKELIHOOD = 1e30
"""Stands for a likelihood of zero. [nats; definition]"""
_QUIET_SHARE = 1.0 / 3.0
"""Share of the driven segments, the quietest, that tell the forces. [ratio; judgement]"""


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

    def of(self, n_classes: int) -> ExcitationStart:
        """Convert the excitation to another number of classes of rising level."""
        return self.select(nearest_classes(self.levels.size, n_classes))

    def select(self, classes: NDArray[np.intp]) -> ExcitationStart:
        """Take the excitation of the given classes."""
        return replace(self, levels=self.levels[classes], beyond=None if self.beyond is None else self.beyond[classes])

    @property
    def vector(self) -> Array:
        """Forces, levels and noise in the order of the parameter vector."""
        return np.concatenate([self.forces, self.levels, [self.noise]])


def nearest_classes(n: int, wanted: int) -> NDArray[np.intp]:
    """Choose, out of n classes of rising level, those nearest to a wanted number of classes.

    Examples
    --------
    >>> from monitor.inference.excitation_fit import nearest_classes
    >>> nearest_classes(5, 3).tolist()
    [0, 2, 4]
    """
    return np.rint(np.linspace(0, n - 1, wanted)).astype(np.intp)


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
    n, c = context.structure.n_dofs, len(context.channels)
    stories = context.structure.n_stories
    known = replace(prior_from_drawing(model, np.ones(stories + n), c), reference_degc=reference_degc)
    without_effects = slice(0, ParameterLayout.of(known).persistent.start)
    plain = replace(known, model=replace(model, effects=()), mean=known.mean[without_effects])
    posterior = make_posterior(evidence, plain, context)
    if isinstance(posterior, DrivenPosterior):
        # One level is fitted for all forces, which therefore start from equal values.
        posterior, near = _best_between_samples(posterior, known), None
    near = None if near is None else near.of(posterior.n_classes)
    x = _first_guess(posterior) if near is None else np.concatenate([plain.mean, near.vector])
    if near is None or not model.effects:
        x = _fit_levels(posterior, x)
    for _ in range(2 if model.effects else 0):
        at_prior = posterior.layout.with_structure(x, known.mean)
        conditions = linearize(posterior, x, (), with_motion=any(effect.nonlinear for effect in model.effects))
        posterior = replace(posterior, conditions=conditions, prior=known)
        x = _fit_levels(posterior, at_prior)
    if isinstance(posterior, AmbientPosterior) and any(e.nonlinear for e in model.effects):
        linear = posterior.without_drift().scatter(x, ())
        beyond = _simulated_correction(posterior, x, linear) if near is None or near.beyond is None else near.beyond
        corrected = replace(posterior, offset=grown_by(linear, beyond) - linear)
        if np.isfinite(corrected.score(x, ())[0]):  # the motion under a far too strong law cannot be corrected
            posterior, x = corrected, _fit_levels(corrected, x)
    return posterior, x


def _simulated_correction(posterior: Posterior, x: Array, linear: Spectra) -> Spectra:
    """Simulate the difference of the exact from the linearized spectra, relative to the latter."""

    loaded()

    def added(seed: int) -> ComplexArray:
        acting = draw_forces(posterior, x, (), seed)
        return simulate_spectra(posterior, x, (), acting, simulate_exact(posterior, x, (), acting)).controlled

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


def _first_guess(posterior: Posterior) -> Array:
    """Guess the levels of equal forces."""
    x, ratio = guess_levels(posterior)
    x[posterior.layout.forces], x[posterior.layout.levels] = posterior.levels_of_equal_forces(ratio)
    return x


def _fit_driven(posterior: DrivenPosterior, x: Array) -> Array:
    """Fit the excitation of a recording with measured ground: one level of all forces, the model's own error, and noise.

    The error has a level in every class; the noise is that of the ground and that of the channels.  The rest of `x` does not
    change.  The forces explain residuals at the resonances, the error explains residuals at all frequencies.
    """
    layout, k = posterior.layout, posterior.n_classes
    moving = np.zeros((k + 3, x.size))
    moving[0, layout.forces] = 1.0
    moving[1:-2, layout.levels] = np.eye(k)
    moving[-2, layout.noise] = 1.0
    moving[-1, layout.channel_noise] = 1.0
    data = posterior.predict(x, ()).data  # levels do not change the means

    def cost(by: Array) -> float:
        value = -posterior.log_likelihood(posterior.scatter(x + by @ moving, ()), data)
        return min(value + 0.5 * float(by @ by) / LEVEL_STD**2, _NO_LIKELIHOOD)

    return np.asarray(x + minimize(cost, np.zeros(k + 3), method="Powell", options={"xtol": 1e-3}).x @ moving)


def forces_from_quiet_segments(posterior: DrivenPosterior, x: Array, effects: tuple[Effect, ...]) -> Array:
    """Estimate the forces beside a measured ground motion from its quietest segments; nothing else of `x` changes.

    Wind acts in quiet segments too, while the error of the model's response grows with the ground's motion.
    """
    e, forces, levels = posterior.observed, posterior.layout.forces, posterior.layout.levels
    moved = (np.abs(posterior.mean(x, effects)) ** 2 / posterior.power).mean(axis=(1, 2))
    quiet = classify(replace(e.segments, drive=posterior.drive).part(moved <= np.quantile(moved, _QUIET_SHARE)))
    nearest = nearest_classes(posterior.n_classes, quiet.counts.size)
    quiet_posterior = posterior.part(quiet, nearest)
    known = np.concatenate([x[: levels.start], x[levels][nearest], x[levels.stop :]])
    out = x.copy()
    out[forces] = _fit_by_scoring(quiet_posterior, known, effects)[forces]
    return out


def _fit_levels(posterior: Posterior, x: Array) -> Array:
    """Fit forces, levels of the classes and noise by Fisher scoring with Levenberg-Marquardt steps, the rest of `x` fixed.

    The force on each floor is a property of the recording, as its level is.  With equal forces on all floors, a wrong structure
    that compensates for their differences would have the best score.
    """
    return _fit_driven(posterior, x) if isinstance(posterior, DrivenPosterior) else _fit_by_scoring(posterior, x)


def _fit_by_scoring(posterior: Posterior, x: Array, effects: tuple[Effect, ...] = (), iterations: int = 40) -> Array:
    """Fit as `_fit_levels`, with extra effects, whose coordinates follow in `x`."""
    fit = _ExcitationFit.at(posterior, x, effects)
    return levenberg_marquardt(
        fit.evaluate(x),
        fit.linearize,
        lambda at, step: fit.evaluate(
            fit.with_excitation(at.x[fit.free] + np.clip(step, -MAX_EXCITATION_STEP, MAX_EXCITATION_STEP))
        ),
        iterations=iterations,
        tolerance=_MIN_GAIN_NATS,
        fixed_slopes_gain=_FIXED_SLOPES_NATS,
    ).point.x


@dataclass(frozen=True, eq=False, slots=True)
class _Point:
    """The log posterior of an excitation."""

    x: Array
    spectra: ComplexArray
    value: float


@dataclass(frozen=True, eq=False, slots=True)
class _Slopes:
    """The log posterior near an excitation to second order."""

    spectra: Annotated[ComplexArray, "n+classes+1 classes bins c c"]
    """Slopes of the spectra by forces, levels and noise."""
    normal: Array
    gradient: Array


@dataclass(frozen=True, eq=False, slots=True)
class _ExcitationFit:
    """The log posterior of the excitation alone, all else kept."""

    posterior: Posterior
    x: Array
    """The parameters that are kept, and the excitation about which the prior lies."""
    effects: tuple[Effect, ...]
    data: ComplexArray
    """Measured spectra about the predicted mean, which no level moves."""
    precision: Annotated[Array, "n+classes+1 n+classes+1"]
    """Of the excitation's prior."""

    @classmethod
    def at(cls, posterior: Posterior, x: Array, effects: tuple[Effect, ...]) -> Self:
        """Start at `x`."""
        n, k = posterior.context.structure.n_dofs, posterior.n_classes
        precision = np.diag(np.full(n + k + 1, LEVEL_STD) ** -2.0)
        precision[:n, :n] = posterior.force_precision()
        return cls(posterior, x.copy(), effects, posterior.predict(x, effects).data, precision)

    @property
    def free(self) -> slice:
        """Where forces, levels and noise stand in `x`."""
        return self.posterior.layout.excitation

    def with_excitation(self, excitation: Array) -> Array:
        """Return the parameters with another excitation."""
        out = self.x.copy()
        out[self.free] = excitation
        return out

    def evaluate(self, x: Array) -> _Point:
        """Evaluate the log posterior, nats."""
        spectra, far = self.posterior.scatter(x, self.effects), x[self.free] - self.x[self.free]
        value = self.posterior.log_likelihood(spectra, self.data) - 0.5 * float(far @ self.precision @ far)
        return _Point(x, spectra, value)

    def linearize(self, at: _Point, last: _Slopes | None) -> _Slopes:
        """Linearize the spectra, by the slopes of `last` where there are any."""
        slopes = self._slopes(at) if last is None else last.spectra
        rows, residual = self.posterior.whitened(at.spectra, slopes, self.data)
        gradient = rows.T @ residual - self.precision @ (at.x - self.x)[self.free]
        return _Slopes(slopes, rows.T @ rows + self.precision, gradient)

    def _slopes(self, at: _Point) -> ComplexArray:
        """Differentiate the spectra by forces, levels and noise."""
        n, k = self.posterior.context.structure.n_dofs, self.posterior.n_classes
        out = np.zeros((n + k + 1, *at.spectra.shape), dtype=complex)

        def slope(direction: Array) -> ComplexArray:
            moved = self.with_excitation(at.x[self.free] + NUDGE * direction)
            return np.asarray((self.posterior.scatter(moved, self.effects) - at.spectra) / NUDGE)

        for i in (*range(n), n + k):
            out[i] = slope(np.eye(n + k + 1)[i])
        # A class's level moves its spectra alone, so that one difference serves all classes.
        out[n + np.arange(k), np.arange(k)] = slope(np.r_[np.zeros(n), np.ones(k), 0.0])
        return out
