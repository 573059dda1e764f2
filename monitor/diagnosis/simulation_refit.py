"""What statistical linearization leaves out, measured by simulating the exact law.

The same forces drive the exact law and the linearized systems of every class; the difference of their averaged spectra
is little disturbed by chance and is added to the prediction, with its slopes by the law's sizes, so that the fit that
follows is as good as the exact law's.  What chance is left shows in the spread between simulations, and goes into the doubt.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from monitor.core import Array, ComplexArray, parallel_map
from monitor.diagnosis.initial_fit import fit_linearized
from monitor.diagnosis.score_test import Candidate, score_candidate
from monitor.inference import (
    CorrectedPosterior,
    MapEstimate,
    Moments,
    ObservedSpectra,
    Posterior,
    correct_posterior,
    draw_forces,
    linearization_error,
    linearize,
    maximize_posterior,
    normal_moments,
    simulate_exact,
    simulate_moments,
    simulate_spectra,
    with_coordinates,
)
from monitor.model import Context, StructuralPrior, loaded

Rounds = tuple[tuple[int, bool], ...]
"""Simulations in each round, and whether slopes are taken too."""
_LEAST, _MOST, _LOSS = 3, 10, 100.0
"""Simulations for what is published: one for so many nats that the chance of a single one takes away."""
Care = Literal["rough", "fine", "finest"]
"""For a rival; for the best; and where the simulations' chance makes a tie."""
_ROUNDS: dict[Care, Rounds] = {"rough": ((1, True),), "fine": ((2, True),), "finest": ((_MOST, False),)}
"""Without slopes from the start, a law that is far from its linearization is fitted away."""
_SENSORS: dict[Care, Rounds] = {"rough": ((1, False),), "fine": ((_LEAST, False),), "finest": ((_MOST, False),)}
"""Slopes by sensors' sizes are told by samples: there is nothing to simulate twice."""
_VAGUE = 0.15
"""Share of a law's size that may be in doubt by chance; else the most are made, as what is rare shows in few of them."""
_STEP = 0.1
"""Relative change of a size by which slopes are taken."""
_WILD, _WEAKER = 10.0, 0.7
"""Largest correction of softening, over the linearized spectra, that leads the right way for sure; share of its size to begin
at else."""
_UNSETTLED = 0.5
"""Share of the last move that is a standard deviation."""
_STANDING = 2
"""Times that laws which stand are simulated before anything else is looked for."""
_OTHER = 1000
"""First seed of the simulations that slopes come from: chance that they shared with the offset would pull the fit."""
_FEIGNED, _MUCH, _SLOPED = 0.5, 0.25, 5
"""Largest share of the information that slopes are taken to feign; share from which so many simulations at least make them."""


@dataclass(frozen=True, eq=False, slots=True)
class RefittedCandidate:
    """A candidate whose law was simulated."""

    candidate: Candidate
    problem: Posterior
    """With the correction of the linearized law."""
    moments: Moments
    """What all laws add to those of a normal process, in simulation."""
    spread: float = 1.0
    """How many times the chance of a recording's moments that of their difference has."""
    chance: float = 0.0
    """Standard deviation of the evidence by the simulations' chance, nats."""


@dataclass(frozen=True, eq=False, slots=True)
class SimulatedFit:
    """A fit whose laws were simulated where it lies."""

    problem: CorrectedPosterior
    fit: MapEstimate
    moments: Moments
    """What the laws add to those of a normal process."""
    simulations: int
    """How many the moments are the mean of."""


def refit_by_simulation(
    problem: Posterior, null: MapEstimate, candidate: Candidate, care: Care = "rough"
) -> RefittedCandidate:
    """Refit a candidate with nonlinear laws, its linearization corrected by simulation at the fitted size."""
    made = fit_by_simulation(problem, candidate.fit, care)
    softening = any(e.is_softening for e in candidate.fit.effects)
    if softening and care == "rough" and np.abs(made.problem.relative[0]).max() > _WILD:
        other = fit_by_simulation(problem, _weaker(problem, candidate.fit), care)
        made = max(made, other, key=lambda m: m.fit.log_posterior)
    lost, spread = made.problem.lost, 1.0 + 1.0 / made.simulations
    better = score_candidate(made.problem, null, made.fit)
    simulated = isinstance(problem, CorrectedPosterior) and candidate.key in problem.laws
    if not simulated and better.gain < candidate.gain <= better.gain + lost:  # the simulations' chance decides nothing
        return RefittedCandidate(candidate, problem, made.moments, spread)
    better = replace(better, gain=better.gain + lost, evidence=better.evidence + lost)
    return RefittedCandidate(better, made.problem, made.moments, spread, float(np.sqrt(2.0 * lost)))


def fit_initial_model(
    evidence: ObservedSpectra, reference: StructuralPrior, context: Context
) -> tuple[Posterior, MapEstimate, Moments]:
    """As `fit_linearized`, with what simulation adds to the laws that stand, and what they add to the moments."""
    problem, null = fit_linearized(evidence, reference, context)
    simulated = (problem, null, normal_moments(problem))
    for _ in range(_STANDING):
        simulated = fit_persistent_effects(*simulated[:2])
    # Near the strongest motion that a law allows, forces fitted to its linear form make it run away: then that form stays.
    return max(simulated, (problem, null, normal_moments(problem)), key=lambda made: made[1].log_posterior)


def fit_persistent_effects(problem: Posterior, at: MapEstimate) -> tuple[Posterior, MapEstimate, Moments]:
    """Without the correction of any law but those that stand, refitted; as it is where none does or the ground was measured."""
    linear = replace(problem, offset=None)
    if problem.observed.drive is not None or not any(e.nonlinear for e in problem.prior.effects(at.x)):
        return linear, at, normal_moments(problem)
    made = fit_by_simulation(linear, at)
    return made.problem, made.fit, made.moments


def fit_by_simulation(problem: Posterior, at: MapEstimate, care: Care = "fine") -> SimulatedFit:
    """Refit with all nonlinear laws simulated."""
    return _iterate_simulation(problem, at, (_SENSORS if _sensors_alone(at) else _ROUNDS)[care])


def _weaker(problem: Posterior, at: MapEstimate) -> MapEstimate:
    """Where a fit begins with weaker laws."""
    x = at.x.copy()
    x[problem.layout.effects][[e.nonlinear for e in at.effects for _ in e.parameters]] *= _WEAKER
    return replace(at, x=x, effects=with_coordinates(at.effects, x[problem.layout.effects]))


def _sensors_alone(at: MapEstimate) -> bool:
    """Whether no law but sensors' is nonlinear."""
    return all(e.family == "sensor" for e in at.effects if e.nonlinear)


def _iterate_simulation(problem: Posterior, at: MapEstimate, rounds: Rounds) -> SimulatedFit:
    """Refit with all nonlinear laws simulated, a round for every number of simulations.

    Slopes of the offset by the sizes matter since a linearized law may be far more or far less sensitive to its size than the
    exact one; a round without them keeps those that the problem has.
    """
    loaded()
    slopes, feigned, known = _slopes(problem, at), np.zeros((0, 0)), 0
    if len(slopes) and isinstance(problem, CorrectedPosterior):
        feigned, known = problem.feigned, problem.simulations
    linear = replace(problem, offset=None)
    for count, sloped in rounds:
        linear = replace(linear, conditions=linearize(linear, at.x, at.effects))
        kept = known if known > 1 else 0  # a single one was taken on the way
        pieces: list[partial[Any]] = [partial(_sloped, linear, at, _OTHER + kept + i) for i in range(count * sloped)]
        pieces += [partial(_simulated, linear, at, i) for i in range(count)]
        done = parallel_map(lambda piece: piece(), pieces)
        made = done[-count:]
        offsets, free = np.array([m[0] for m in made]), np.array([m[1] for m in made])
        added = sum((m[2] for m in made), normal_moments(linear)) / count
        if sloped:
            new = np.array(done[:count])
            known = kept + count
            slopes = new.mean(axis=0) if not kept else (kept * slopes + new.sum(axis=0)) / known
        near = correct_posterior(linear, at.x, at.effects, offsets.mean(axis=0), slopes)
        if sloped:
            feigned = _spurious_information(near, at, new) * count / known
        near = replace(near, feigned=feigned, simulations=known)
        at = maximize_posterior(near, at.x, at.effects, iterations=8)
    lost, doubt = _chance(near, at, offsets, free)
    if doubt.size:
        more = np.diag(_spread(near, at) - at.covariance)[near.layout.effects]
        doubt = np.sqrt(doubt**2 + np.maximum(more, 0.0))
    return SimulatedFit(replace(near, lost=lost, doubt=doubt), at, added, count)


def refine_fit(problem: Posterior, at: MapEstimate) -> tuple[CorrectedPosterior, MapEstimate]:
    """As `fit_by_simulation`, for what is published: the more chance the simulations have, the more of them.

    What the sizes still move in it is a doubt, and where the fit gets worse, the one that it began with stands.
    """
    if (
        isinstance(problem, CorrectedPosterior) and problem.doubt.size == at.n_effect
    ):  # simulated finely with all that is there
        near, start = problem, at
    else:
        made = fit_by_simulation(problem, at)
        near, start = made.problem, made.fit
    if _sensors_alone(at):
        return near, start
    count = int(np.clip(np.ceil(2.0 * near.lost / _LOSS), _LEAST, _MOST))
    rounds: Rounds = ((count, False),) if count == _LEAST else ((count // 2, True), (count, False))
    if _largest(_spurious_share(near, start)) > _MUCH:
        rounds = ((max(count, _SLOPED - near.simulations), True),)
    last = _iterate_simulation(near, start, rounds)
    sizes = last.fit.x[problem.layout.effects]
    bent = np.array([e.nonlinear for e in at.effects for _ in e.parameters])
    if (last.problem.doubt > _VAGUE * np.abs(sizes))[bent].any():
        last = _iterate_simulation(last.problem, last.fit, ((_MOST, False),))
    moved = np.abs(last.fit.x - start.x)[problem.layout.effects]
    if last.fit.log_posterior + last.problem.lost < start.log_posterior + near.lost:
        return replace(near, doubt=np.hypot(last.problem.doubt, moved)), start
    return replace(last.problem, doubt=np.hypot(last.problem.doubt, _UNSETTLED * moved)), last.fit


def _simulated(problem: Posterior, at: MapEstimate, seed: int) -> tuple[ComplexArray, ComplexArray, Moments]:
    """Offset, the same without a control variate, and what the laws add to the moments."""
    acting = draw_forces(problem, at.x, at.effects, seed)
    made = simulate_spectra(problem, at.x, at.effects, acting, simulate_exact(problem, at.x, at.effects, acting))
    added = simulate_moments(made.bent, problem, at) - simulate_moments(made.straight, problem, at)
    return made.controlled, made.free, added


def _sloped(problem: Posterior, at: MapEstimate, seed: int) -> ComplexArray:
    """Slopes of the offset by the laws' sizes, shape (p, classes, n_bins, c, c); none by a sensor's, which samples tell."""
    laws = [(i, e) for i, e in enumerate(e for e in at.effects for _ in e.parameters) if e.nonlinear]
    out = np.zeros((len(laws), *problem.observed.spectra.shape), dtype=complex)
    acting = draw_forces(problem, at.x, at.effects, seed)
    here = linearization_error(problem, at.x, at.effects, acting, simulate_exact(problem, at.x, at.effects, acting))
    for slope, (i, effect) in zip(out, laws, strict=True):
        if effect.family == "sensor":
            continue
        x = at.x.copy()
        sizes = x[problem.layout.effects]
        step = _STEP * abs(sizes[i])
        sizes[i] += step
        effects = with_coordinates(at.effects, sizes)
        slope[:] = (
            linearization_error(problem, x, effects, acting, simulate_exact(problem, x, effects, acting)) - here
        ) / step
    return out


def _slopes(problem: Posterior, at: MapEstimate) -> ComplexArray:
    """Those that a problem has for the laws of a fit; none otherwise."""
    if isinstance(problem, CorrectedPosterior) and problem.laws == tuple(
        (e.name, e.location) for e in at.effects if e.nonlinear
    ):
        return problem.slopes_by_size
    return np.zeros((0, *problem.observed.spectra.shape), dtype=complex)


def _spurious_information(problem: CorrectedPosterior, at: MapEstimate, slopes: ComplexArray) -> Array:
    """Information that chance in the mean of simulated slopes, shape (k, p, classes, n_bins, c, c), feigns: shape (p, p)."""
    k, p = slopes.shape[:2]
    if k < 2:
        return np.zeros((p, p))
    here = problem.predict(at.x, at.effects)
    apart = problem.spread(slopes - slopes.mean(axis=0))
    rows, _ = problem.whitened(here.spectra, apart.reshape(k * p, *apart.shape[2:]), here.data)
    rows = rows.reshape(-1, k, p)
    return np.asarray(np.einsum("rka,rkb->ab", rows, rows) / (k * (k - 1)))


def _spurious_share(problem: Posterior, at: MapEstimate) -> Array:
    """Covariance times feigned information, shape (n, n)."""
    whole = np.zeros_like(at.covariance)
    if isinstance(problem, CorrectedPosterior) and problem.feigned.any():
        sizes = [e.nonlinear for e in at.effects for _ in e.parameters]
        bent = problem.layout.n_nuisance + np.flatnonzero(sizes)
        whole[np.ix_(bent, bent)] = problem.feigned
    return np.asarray(at.covariance @ whole)


def _largest(part: Array) -> float:
    """Largest share of the information on any size that is feigned, of `_spurious_share`."""
    return float(np.abs(np.linalg.eigvals(part)).max())


def _spread(problem: Posterior, at: MapEstimate) -> Array:
    """Covariance of estimates whose slopes have chance in them, shape (n, n).

    Such a fit takes its information J'J for larger than it is, and its covariance for smaller.
    """
    part = _spurious_share(problem, at)
    wider = np.linalg.inv(np.eye(len(part)) - part * min(1.0, _FEIGNED / max(_largest(part), 1e-9)))
    return np.asarray(wider @ at.covariance @ wider.T)


def _chance(
    problem: CorrectedPosterior, at: MapEstimate, offsets: ComplexArray, free: ComplexArray
) -> tuple[float, Array]:
    """What the simulations' chance costs in log likelihood, and what it adds to the sizes' standard deviation.

    A nonlinear response is not normal, so a recording's spectra scatter more than the likelihood knows: as the spectra of
    simulations without a control variate do.  A single one tells nothing.
    """
    own_sizes, k = problem.layout.effects, len(offsets)
    if k < 2:
        return 0.0, np.zeros(0)
    here = problem.predict(at.x, at.effects)
    rows = at.jacobian[: at.residual.size]
    steps, lost = [], 0.0
    for made in (offsets, free):
        apart, _ = problem.whitened(here.spectra, problem.spread(made - made.mean(axis=0)), here.data)
        steps.append((at.covariance @ (rows.T @ apart))[own_sizes])
        if made is offsets:
            lost = 0.5 * float((apart**2).sum()) / (k * (k - 1))
    own, whole = (s.var(axis=1, ddof=1) for s in steps)
    expected = np.diag(at.covariance @ (rows.T @ rows) @ at.covariance)[own_sizes]
    return lost, np.sqrt(own / k + np.maximum(whole - expected, 0.0))
