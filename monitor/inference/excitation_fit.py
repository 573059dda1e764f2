"""The excitation of a model whose structure is stated: levels and noise that make its prediction of a recording most probable."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from monitor.core import Array, ComplexArray, levenberg_marquardt, parallel_map
from monitor.inference.ambient_posterior import AmbientPosterior
from monitor.inference.corrected_posterior import relative_to
from monitor.inference.driven_posterior import DrivenPosterior
from monitor.inference.exact_simulation import draw_forces, simulate_exact, simulate_spectra
from monitor.inference.ground_response import Between
from monitor.inference.linearization import linearize
from monitor.inference.observed_spectra import ObservedSpectra, classify
from monitor.inference.parameter_layout import ParameterLayout
from monitor.inference.posterior import (
    FORCE_STD,
    LEVEL_STD,
    MAX_EXCITATION_STEP,
    NUDGE,
    Posterior,
    difference_operator,
)
from monitor.inference.starting_point import FORCED, guess_levels, make_posterior
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
    """The excitation of a recording that is like the one at hand, or part of it, under nearly the same model."""

    forces: Array
    """Logarithms of the floors', shape (n,)."""
    levels: Array
    """Logarithms of the classes', shape (classes,)."""
    noise: float
    """Logarithm of its density."""
    beyond: ComplexArray | None = None
    """What exact laws add to the linearized spectra, relative to them, shape (classes, n_bins, c, c); None if not known."""

    @classmethod
    def at(cls, posterior: Posterior, x: Array, beyond: ComplexArray | None = None) -> Self:
        """That of a vector of nuisances."""
        layout = posterior.layout
        return cls(x[layout.forces], x[layout.levels], float(x[layout.noise]), beyond)

    def of(self, n_classes: int) -> ExcitationStart:
        """For as many classes of rising level."""
        like = nearest_classes(self.levels.size, n_classes)
        return replace(self, levels=self.levels[like], beyond=None if self.beyond is None else self.beyond[like])

    @property
    def vector(self) -> Array:
        """Forces, levels and noise, as they follow the structural nuisances."""
        return np.concatenate([self.forces, self.levels, [self.noise]])


def nearest_classes(n: int, wanted: int) -> NDArray[np.intp]:
    """Of n classes of rising level those nearest to as many as are wanted."""
    return np.rint(np.linspace(0, n - 1, wanted)).astype(np.intp)


def fit_excitation(
    evidence: ObservedSpectra,
    model: Model,
    context: Context,
    reference_degc: float | None,
    near: ExcitationStart | None = None,
) -> tuple[Posterior, Array]:
    """The model's posterior with levels and noise fitted, from nearby where that is known; everything else as it is stated.

    Laws that depend on the level are made linear at the motion that the model itself shows, hence the repetition; what that
    leaves out is simulated.
    """
    n, c = context.structure.n_dofs, len(context.channels)
    stories = context.structure.n_stories
    known = replace(prior_from_drawing(model, np.ones(stories + n), c), reference_degc=reference_degc)
    without_effects = slice(0, ParameterLayout.of(known).persistent.start)
    plain = replace(known, model=replace(model, effects=()), mean=known.mean[without_effects])
    posterior = make_posterior(evidence, plain, context)
    if isinstance(posterior, DrivenPosterior):
        # One level is fitted for all forces, which therefore begin alike.
        posterior, near = _best_between_samples(posterior, known), None
    near = None if near is None else near.of(posterior.n_classes)
    x = _first_guess(posterior) if near is None else np.concatenate([plain.mean, near.vector])
    if near is None or not model.effects:
        x = _fit_levels(posterior, x)
    for _ in range(2 if model.effects else 0):
        at_prior = posterior.layout.with_structure(x, known.mean)
        posterior = replace(posterior, conditions=linearize(posterior, x, ()), prior=known)
        x = _fit_levels(posterior, at_prior)
    if isinstance(posterior, AmbientPosterior) and any(e.nonlinear for e in model.effects):
        linear = posterior.scatter(x, ())
        beyond = _beyond(posterior, x, linear) if near is None or near.beyond is None else near.beyond
        exactly = replace(posterior, offset=grown_by(linear, beyond) - linear)
        if np.isfinite(exactly.score(x, ())[0]):  # a law far too strong moves too differently to be corrected
            posterior, x = exactly, _fit_levels(exactly, x)
    return posterior, x


def _beyond(posterior: Posterior, x: Array, linear: ComplexArray) -> ComplexArray:
    """What the exact laws add to the linearized spectra, relative to them, by simulation."""

    loaded()

    def added(seed: int) -> ComplexArray:
        acting = draw_forces(posterior, x, (), seed)
        return simulate_spectra(posterior, x, (), acting, simulate_exact(posterior, x, (), acting)).controlled

    return relative_to(
        linear, np.mean(parallel_map(added, range(_N_FIT_SIMULATIONS)), axis=0), posterior.observed.band.hz
    )


def _best_between_samples(posterior: DrivenPosterior, known: StructuralPrior) -> DrivenPosterior:
    """Let the ground move between its samples so that least of the floors' motion is left unexplained."""
    whole = replace(posterior, prior=known)
    x = np.zeros(whole.layout.n_nuisance)
    x[whole.layout.structure] = known.mean

    def left(between: Between) -> float:
        rest = whole.observed.segments.values - whole.between_samples(between).mean(x, ())
        return float(np.log((np.abs(rest) ** 2).mean(axis=0)).sum())

    return posterior.between_samples(min(get_args(Between), key=left))


def _first_guess(posterior: Posterior) -> Array:
    """Guess the levels of the forces; beside a measured ground the level of all forces, the error being all of the power."""
    x, ratio = guess_levels(posterior)
    if isinstance(posterior, DrivenPosterior):
        x[posterior.layout.forces] = np.log(ratio).mean() + np.log(FORCED)
    else:
        x[posterior.layout.levels] = np.log(ratio)
    return x


def _fit_driven(posterior: DrivenPosterior, x: Array) -> Array:
    """Most probable level of the forces, of the model's own error in every class, noise of the ground and of the channels,
    the rest of `x` kept.

    The forces stand for what the response lacks at its resonances, the error for what it lacks everywhere.
    """
    layout, k = posterior.layout, posterior.n_classes
    moving = np.zeros((k + 3, x.size))
    moving[0, layout.forces] = 1.0
    moving[1:-2, layout.levels] = np.eye(k)
    moving[-2, layout.noise] = 1.0
    moving[-1, layout.channel_noise] = 1.0
    data = posterior.predict(x, ()).data  # levels move no mean

    def cost(by: Array) -> float:
        value = -posterior.log_likelihood(posterior.scatter(x + by @ moving, ()), data)
        return min(value + 0.5 * float(by @ by) / LEVEL_STD**2, _NO_LIKELIHOOD)

    return np.asarray(x + minimize(cost, np.zeros(k + 3), method="Powell", options={"xtol": 1e-3}).x @ moving)


def forces_from_quiet_segments(posterior: DrivenPosterior, x: Array, effects: tuple[Effect, ...]) -> Array:
    """The vector with the forces beside a measured ground that its quietest segments tell, the rest of `x` kept.

    Wind blows there too, while what the model's response lacks grows with the ground's motion.
    """
    e, forces, levels = posterior.observed, posterior.layout.forces, posterior.layout.levels
    moved = (np.abs(posterior.mean(x, effects)) ** 2 / posterior.power).mean(axis=(1, 2))
    quiet = classify(replace(e.segments, drive=posterior.drive).part(moved <= np.quantile(moved, _QUIET_SHARE)))
    like = nearest_classes(posterior.n_classes, quiet.counts.size)
    there = posterior.part(quiet, like)
    known = np.concatenate([x[: levels.start], x[levels][like], x[levels.stop :]])
    out = x.copy()
    out[forces] = _by_scoring(there, known, effects)[forces]
    return out


def _fit_levels(posterior: Posterior, x: Array) -> Array:
    """Most probable forces, levels of the classes and noise, the rest of `x` kept: Fisher scoring, Levenberg-Marquardt steps.

    How strongly each floor is shaken belongs to the recording as its level does; were it held equal, a wrong structure that
    makes up for it would score best.
    """
    return _fit_driven(posterior, x) if isinstance(posterior, DrivenPosterior) else _by_scoring(posterior, x)


def _by_scoring(posterior: Posterior, x: Array, effects: tuple[Effect, ...] = (), iterations: int = 40) -> Array:
    """As `_fit_levels`, beside further effects, whose coordinates follow in `x`."""
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

    spectra: ComplexArray
    """Slopes of the spectra by forces, levels and noise, shape (n + classes + 1, classes, n_bins, c, c)."""
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
    precision: Array
    """Of the excitation's prior, shape (n + classes + 1, n + classes + 1)."""

    @classmethod
    def at(cls, posterior: Posterior, x: Array, effects: tuple[Effect, ...]) -> Self:
        """Start at `x`."""
        n, k = posterior.context.structure.n_dofs, posterior.n_classes
        precision = np.diag(np.r_[np.full(n, FORCE_STD), np.full(k + 1, LEVEL_STD)] ** -2.0)
        if isinstance(posterior, DrivenPosterior):  # no class's level is theirs
            precision[:n, :n] = difference_operator(n)
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
