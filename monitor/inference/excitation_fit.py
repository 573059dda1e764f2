"""The excitation of a model whose structure is stated: levels and noise that make its prediction of a recording most probable."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from monitor.core import Array, ComplexArray, parallel_map
from monitor.inference.corrected_posterior import relative_to
from monitor.inference.exact_simulation import draw_forces, simulate_exact, simulate_spectra
from monitor.inference.ground_response import Between
from monitor.inference.linearization import linearize
from monitor.inference.observed_spectra import ObservedSpectra, classify
from monitor.inference.posterior import Posterior, difference_operator
from monitor.inference.wishart import grown_by
from monitor.model import Condition, Context, Effect, Model, StructuralPrior, loaded, prior_from_drawing

_FORCE_STD, _LEVEL_STD = 1.0, 5.0
"""Prior of the logarithms of the floors' forces about one level, of the classes' levels and of the noise."""
_LEAST_GAIN = 0.01
"""Nats of the last step."""
_NEAR = 10.0
"""Nats of a step after which the slopes change no more."""
_NUDGE = 1e-5
"""Finite difference of those logarithms."""
_SIMULATIONS = 4
"""Of laws that are not linear: of rare events a single one tells little."""
_WORST = 1e30
"""Stands for no likelihood at all."""
_QUIET = 1.0 / 3.0
"""Share of driven segments that tell the forces."""
_FORCED = 1e-3
"""With the ground measured: power that forces cause, as a share of what is seen, where the model is all wrong."""


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
    def at(cls, problem: Posterior, x: Array, beyond: ComplexArray | None = None) -> Self:
        """That of a vector of nuisances."""
        first, last = problem.prior.mean.size, problem.n_nuisance - 1
        forces, levels = np.split(x[first:last], [problem.context.structure.n_dofs])
        return cls(forces, levels, float(x[last]), beyond)

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
    """The model's problem with levels and noise fitted, from nearby where that is known; everything else as it is stated.

    Laws that depend on the level are made linear at the motion that the model itself shows, hence the repetition; what that
    leaves out is simulated.
    """
    n, c = context.structure.n_dofs, len(context.channels)
    stories = context.structure.n_stories
    known = replace(prior_from_drawing(model, np.ones(stories + n), c), reference_degc=reference_degc)
    first = known.mean.size - known.n_standing
    plain = replace(known, model=replace(model, effects=()), mean=known.mean[:first])
    unknown = Condition(np.ones(stories), np.ones(stories), np.ones(n), np.ones(c))
    problem = Posterior(evidence, plain, context, (unknown,) * evidence.counts.size)
    problem = _as_moved(problem, known)
    # With the ground measured one level is fitted for all forces, which therefore begin alike.
    near = None if near is None or evidence.drive is not None else near.of(problem.n_classes)
    x = _first_guess(problem) if near is None else np.concatenate([plain.mean, near.vector])
    if near is None or not model.effects:
        x = _fit_levels(problem, x)
    for _ in range(2 if model.effects else 0):
        excitation = x[problem.prior.mean.size :]
        problem = replace(problem, conditions=linearize(problem, x, ()), prior=known)
        x = _fit_levels(problem, np.concatenate([known.mean, excitation]))
    if evidence.drive is None and any(e.nonlinear for e in model.effects):
        linear = problem.scatter(x, ())
        beyond = _beyond(problem, x, linear) if near is None or near.beyond is None else near.beyond
        exactly = replace(problem, offset=grown_by(linear, beyond) - linear)
        if np.isfinite(exactly.score(x, ())[0]):  # a law far too strong moves too differently to be corrected
            problem, x = exactly, _fit_levels(exactly, x)
    return problem, x


def _beyond(problem: Posterior, x: Array, linear: ComplexArray) -> ComplexArray:
    """What the exact laws add to the linearized spectra, relative to them, by simulation."""

    loaded()

    def added(seed: int) -> ComplexArray:
        acting = draw_forces(problem, x, (), seed)
        return simulate_spectra(problem, x, (), acting, simulate_exact(problem, x, (), acting)).controlled

    return relative_to(linear, np.mean(parallel_map(added, range(_SIMULATIONS)), axis=0), problem.observed.band.hz)


def _as_moved(problem: Posterior, known: StructuralPrior) -> Posterior:
    """With the motion of a measured ground between its samples that leaves the least of the floors' unexplained."""
    drive = problem.observed.drive
    if drive is None:
        return problem
    whole = replace(problem, prior=known)
    x = np.concatenate([known.mean, np.zeros(whole.n_nuisance - known.mean.size)])

    def moved(between: Between) -> Posterior:
        return replace(whole, observed=replace(whole.observed, drive=replace(drive, between=between)))

    def left(between: Between) -> float:
        mean = moved(between).mean(x, ())
        assert mean is not None
        rest = whole.observed.segments.values - mean
        return float(np.log((np.abs(rest) ** 2).mean(axis=0)).sum())

    return replace(problem, observed=moved(min(get_args(Between), key=left)).observed)


def _first_guess(problem: Posterior) -> Array:
    """Levels from the medians over frequency of the channels' power, noise from its least."""
    e, c = problem.observed, len(problem.context.channels)
    power = np.einsum("kfaa->kfa", e.spectra[:, :, :c, :c]).real
    noise = np.log(max(0.3 * float(np.quantile(power.mean(axis=(0, 2)), 0.02)), 1e-300))
    levels = np.zeros(problem.context.structure.n_dofs + problem.n_classes)
    x = np.concatenate([problem.prior.mean, levels, [noise - 10.0]])
    predicted = np.einsum("kfaa->kfa", problem.scatter(x, ())[:, :, :c, :c]).real
    level = np.log(np.median(power / predicted, axis=(1, 2)))
    x[-1] = noise
    if e.power is None:
        x[-problem.n_classes - 1 : -1] = level
    else:  # the level is the model's own error; what forces move beside the ground goes with it
        p = problem.prior.mean.size
        x[p:-1] = np.r_[np.full(problem.context.structure.n_dofs, level.mean()), np.zeros(problem.n_classes)]
        x[p : -problem.n_classes - 1] += np.log(_FORCED)
    return x


def _fit_driven(problem: Posterior, x: Array) -> Array:
    """Most probable level of the forces, of the model's own error in every class, noise of the ground and of the channels,
    the rest of `x` kept.

    The forces stand for what the response lacks at its resonances, the error for what it lacks everywhere.
    """
    p, k = problem.prior.mean.size, problem.n_classes
    n = problem.context.structure.n_dofs
    moving = np.zeros((k + 3, x.size))
    moving[0, p : p + n] = 1.0
    moving[1:-1, p + n :] = np.eye(k + 1)
    moving[-1, problem.prior.channel_noises] = 1.0
    data = problem.predict(x, ()).data  # levels move no mean

    def cost(by: Array) -> float:
        value = -problem.log_likelihood(problem.scatter(x + by @ moving, ()), data)
        return min(value + 0.5 * float(by @ by) / _LEVEL_STD**2, _WORST)

    return np.asarray(x + minimize(cost, np.zeros(k + 3), method="Powell", options={"xtol": 1e-3}).x @ moving)


def forces_from_quiet_segments(problem: Posterior, x: Array, effects: tuple[Effect, ...]) -> Array:
    """The vector with the forces beside a measured ground that its quietest segments tell, the rest of `x` kept.

    Wind blows there too, while what the model's response lacks grows with the ground's motion.
    """
    e, p, n = problem.observed, problem.prior.mean.size, problem.context.structure.n_dofs
    mean = problem.mean(x, effects)
    assert mean is not None
    assert e.power is not None
    moved = (np.abs(mean) ** 2 / e.power).mean(axis=(1, 2))
    quiet = classify(replace(e.segments, drive=e.drive).part(moved <= np.quantile(moved, _QUIET)))
    like = nearest_classes(problem.n_classes, quiet.counts.size)
    there, last = problem.part(quiet, like), x[p + n + problem.n_classes :]
    known = np.concatenate([x[: p + n], x[p + n : p + n + problem.n_classes][like], last])
    out = x.copy()
    out[p : p + n] = _by_scoring(there, known, effects)[p : p + n]
    return out


def _fit_levels(problem: Posterior, x: Array) -> Array:
    """Most probable forces, levels of the classes and noise, the rest of `x` kept: Fisher scoring, Levenberg-Marquardt steps.

    How strongly each floor is shaken belongs to the recording as its level does; were it held equal, a wrong structure that
    makes up for it would score best.
    """
    return _by_scoring(problem, x) if problem.observed.drive is None else _fit_driven(problem, x)


def _by_scoring(problem: Posterior, x: Array, effects: tuple[Effect, ...] = (), iterations: int = 40) -> Array:
    """As `_fit_levels`, beside further effects, whose coordinates follow in `x`."""
    p, n, k, damping = problem.prior.mean.size, problem.context.structure.n_dofs, problem.n_classes, 1e-3
    end = problem.n_nuisance
    first, data = x[p:end].copy(), problem.predict(x, effects).data  # levels move no mean
    precision = np.diag(np.r_[np.full(n, _FORCE_STD), np.full(k + 1, _LEVEL_STD)] ** -2.0)
    if problem.observed.drive is not None:  # no class's level is theirs
        precision[:n, :n] = difference_operator(n)

    def moved(by: Array) -> tuple[Array, ComplexArray, float]:
        at = np.r_[x[:p], x[p:end] + by, x[end:]]
        spectra, far = problem.scatter(at, effects), at[p:end] - first
        return at, spectra, problem.log_likelihood(spectra, data) - 0.5 * float(far @ precision @ far)

    x, spectra, value = moved(np.zeros(first.size))
    slopes, gained = np.zeros((first.size, *spectra.shape), dtype=complex), np.inf
    for _ in range(iterations):
        if gained > _NEAR:
            for i in (*range(n), first.size - 1):
                slopes[i] = (moved(_NUDGE * np.eye(first.size)[i])[1] - spectra) / _NUDGE
            every = (moved(_NUDGE * np.r_[np.zeros(n), np.ones(k), 0.0])[1] - spectra) / _NUDGE
            slopes[n + np.arange(k), np.arange(k)] = every  # a class's level moves its spectra alone
        rows, residual = problem.whitened(spectra, slopes, data)
        normal = rows.T @ rows + precision
        gradient = rows.T @ residual - precision @ (x[p:end] - first)
        for _ in range(8):
            step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
            there, its_spectra, its_value = moved(np.clip(step, -2.0, 2.0))
            if its_value >= value:
                break
            damping = max(10.0 * damping, 1e-2)
        else:
            break
        gained = its_value - value
        x, spectra, value, damping = there, its_spectra, its_value, 0.1 * damping
        if gained < _LEAST_GAIN:
            break
    return x
