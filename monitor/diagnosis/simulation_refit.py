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
_MIN_SIMULATIONS = 3
"""Fewest simulations of a published result. [count; cost]"""
_MAX_SIMULATIONS = 10
"""Most simulations of a published result. [count; cost]"""
_NATS_A_SIMULATION = 100.0
"""One more simulation for every so many nats of gain that the randomness of a single one costs. [nats; judgement]"""
Effort = Literal["rough", "fine", "finest"]
"""For a rival; for the best; and where the simulations' chance makes a tie."""
_ROUNDS: dict[Effort, Rounds] = {"rough": ((1, True),), "fine": ((2, True),), "finest": ((_MAX_SIMULATIONS, False),)}
"""Without slopes from the start, a law that is far from its linearization is fitted away."""
_SENSORS: dict[Effort, Rounds] = {
    "rough": ((1, False),),
    "fine": ((_MIN_SIMULATIONS, False),),
    "finest": ((_MAX_SIMULATIONS, False),),
}
"""Slopes by sensors' sizes are told by samples: there is nothing to simulate twice."""
_UNCERTAIN_SIZE = 0.15
"""Relative uncertainty of a law's size by the simulations' randomness from which the most simulations are made: rare
events show in few of them. [ratio; judgement]"""
_SIZE_DIFFERENCE = 0.1
"""Relative change of a size over which slopes are taken. [ratio; judgement]"""
_MAX_SOFTENING_CORRECTION = 10.0
"""Largest correction of a softening law, over the linearized spectra, that points the right way for certain. [ratio;
not recorded]"""
_REDUCED_START = 0.7
"""Share of the size to begin at beyond that. [ratio; not recorded]"""
_MOVE_STD = 0.5
"""Standard deviation of a fit that still moves, as a share of its last move. [ratio; not recorded]"""
_N_REFITS = 2
"""Times that accepted laws are simulated before the search goes on. [count; cost]"""
_FIRST_SLOPE_SEED = 1000
"""First seed of the simulations for slopes: randomness shared with the offset would bias the fit. [seed; definition]"""
_MAX_NOISE_INFORMATION = 0.5
"""Largest share of the information that the randomness of slopes may imitate. [ratio; judgement]"""
_HIGH_NOISE_INFORMATION = 0.25
"""Share from which `_N_SLOPE_SIMULATIONS` are made at least. [ratio; judgement]"""
_N_SLOPE_SIMULATIONS = 5
"""Simulations of a slope that random errors affect. [count; cost]"""


@dataclass(frozen=True, eq=False, slots=True)
class RefittedCandidate:
    """A candidate whose law was simulated."""

    candidate: Candidate
    posterior: Posterior
    """With the correction of the linearized law."""
    moments: Moments
    """What all laws add to those of a normal process, in simulation."""
    variance_ratio: float = 1.0
    """How many times the chance of a recording's moments that of their difference has."""
    log_evidence_std: float = 0.0
    """Standard deviation of the evidence by the simulations' chance, nats."""


@dataclass(frozen=True, eq=False, slots=True)
class SimulatedFit:
    """A fit whose laws were simulated where it lies."""

    posterior: CorrectedPosterior
    fit: MapEstimate
    moments: Moments
    """What the laws add to those of a normal process."""
    simulations: int
    """How many the moments are the mean of."""


def refit_by_simulation(
    posterior: Posterior, null_fit: MapEstimate, candidate: Candidate, effort: Effort = "rough"
) -> RefittedCandidate:
    """Refit a candidate with nonlinear laws, its linearization corrected by simulation at the fitted size."""
    made = fit_by_simulation(posterior, candidate.fit, effort)
    softening = any(e.is_softening for e in candidate.fit.effects)
    if softening and effort == "rough" and np.abs(made.posterior.relative[0]).max() > _MAX_SOFTENING_CORRECTION:
        other = fit_by_simulation(posterior, _weaken_laws(posterior, candidate.fit), effort)
        made = max(made, other, key=lambda m: m.fit.log_posterior)
    lost, variance_ratio = made.posterior.lost, 1.0 + 1.0 / made.simulations
    better = score_candidate(made.posterior, null_fit, made.fit)
    simulated = isinstance(posterior, CorrectedPosterior) and candidate.key in posterior.laws
    if (
        not simulated
        and better.delta_log_posterior < candidate.delta_log_posterior <= better.delta_log_posterior + lost
    ):  # the simulations' chance decides nothing
        return RefittedCandidate(candidate, posterior, made.moments, variance_ratio)
    better = replace(
        better, delta_log_posterior=better.delta_log_posterior + lost, log_evidence=better.log_evidence + lost
    )
    return RefittedCandidate(better, made.posterior, made.moments, variance_ratio, float(np.sqrt(2.0 * lost)))


def fit_initial_model(
    observed: ObservedSpectra, prior: StructuralPrior, context: Context
) -> tuple[Posterior, MapEstimate, Moments]:
    """As `fit_linearized`, with what simulation adds to the laws that stand, and what they add to the moments."""
    posterior, null_fit = fit_linearized(observed, prior, context)
    simulated = (posterior, null_fit, normal_moments(posterior))
    for _ in range(_N_REFITS):
        simulated = fit_persistent_effects(*simulated[:2])
    # Near the strongest motion that a law allows, forces fitted to its linear form make it run away: then that form stays.
    return max(simulated, (posterior, null_fit, normal_moments(posterior)), key=lambda made: made[1].log_posterior)


def fit_persistent_effects(posterior: Posterior, fit: MapEstimate) -> tuple[Posterior, MapEstimate, Moments]:
    """Without the correction of any law but those that stand, refitted; as it is where none does or the ground was measured."""
    linear = replace(posterior, offset=None)
    if posterior.observed.drive is not None or not any(e.nonlinear for e in posterior.prior.effects(fit.x)):
        return linear, fit, normal_moments(posterior)
    made = fit_by_simulation(linear, fit)
    return made.posterior, made.fit, made.moments


def fit_by_simulation(posterior: Posterior, fit: MapEstimate, effort: Effort = "fine") -> SimulatedFit:
    """Refit with all nonlinear laws simulated."""
    return _iterate_simulation(posterior, fit, (_SENSORS if _sensors_alone(fit) else _ROUNDS)[effort])


def _weaken_laws(posterior: Posterior, fit: MapEstimate) -> MapEstimate:
    """Where a fit begins with weaker laws."""
    x = fit.x.copy()
    x[posterior.layout.effects][[e.nonlinear for e in fit.effects for _ in e.parameters]] *= _REDUCED_START
    return replace(fit, x=x, effects=with_coordinates(fit.effects, x[posterior.layout.effects]))


def _sensors_alone(fit: MapEstimate) -> bool:
    """Whether no law but sensors' is nonlinear."""
    return all(e.family == "sensor" for e in fit.effects if e.nonlinear)


def _iterate_simulation(posterior: Posterior, fit: MapEstimate, rounds: Rounds) -> SimulatedFit:
    """Refit with all nonlinear laws simulated, a round for every number of simulations.

    Slopes of the offset by the sizes matter since a linearized law may be far more or far less sensitive to its size than the
    exact one; a round without them keeps those that the problem has.
    """
    loaded()
    slopes, feigned, known = _stored_slopes(posterior, fit), np.zeros((0, 0)), 0
    if len(slopes) and isinstance(posterior, CorrectedPosterior):
        feigned, known = posterior.feigned, posterior.simulations
    linear = replace(posterior, offset=None)
    for count, sloped in rounds:
        linear = replace(linear, conditions=linearize(linear, fit.x, fit.effects))
        kept = known if known > 1 else 0  # a single one was taken on the way
        pieces: list[partial[Any]] = [
            partial(_simulate_slopes, linear, fit, _FIRST_SLOPE_SEED + kept + i) for i in range(count * sloped)
        ]
        pieces += [partial(_simulate_offset, linear, fit, i) for i in range(count)]
        done = parallel_map(lambda piece: piece(), pieces)
        made = done[-count:]
        offsets, free = np.array([m[0] for m in made]), np.array([m[1] for m in made])
        added = sum((m[2] for m in made), normal_moments(linear)) / count
        if sloped:
            new = np.array(done[:count])
            known = kept + count
            slopes = new.mean(axis=0) if not kept else (kept * slopes + new.sum(axis=0)) / known
        near = correct_posterior(linear, fit.x, fit.effects, offsets.mean(axis=0), slopes)
        if sloped:
            feigned = _spurious_information(near, fit, new) * count / known
        near = replace(near, feigned=feigned, simulations=known)
        fit = maximize_posterior(near, fit.x, fit.effects, iterations=8)
    lost, simulation_std = _simulation_scatter(near, fit, offsets, free)
    if simulation_std.size:
        more = np.diag(_widen_covariance(near, fit) - fit.covariance)[near.layout.effects]
        simulation_std = np.sqrt(simulation_std**2 + np.maximum(more, 0.0))
    return SimulatedFit(replace(near, lost=lost, doubt=simulation_std), fit, added, count)


def refine_fit(posterior: Posterior, fit: MapEstimate) -> tuple[CorrectedPosterior, MapEstimate]:
    """As `fit_by_simulation`, for what is published: the more chance the simulations have, the more of them.

    What the sizes still move in it is a doubt, and where the fit gets worse, the one that it began with stands.
    """
    if (
        isinstance(posterior, CorrectedPosterior) and posterior.doubt.size == fit.n_effect
    ):  # simulated finely with all that is there
        near, start = posterior, fit
    else:
        made = fit_by_simulation(posterior, fit)
        near, start = made.posterior, made.fit
    if _sensors_alone(fit):
        return near, start
    count = int(np.clip(np.ceil(2.0 * near.lost / _NATS_A_SIMULATION), _MIN_SIMULATIONS, _MAX_SIMULATIONS))
    rounds: Rounds = ((count, False),) if count == _MIN_SIMULATIONS else ((count // 2, True), (count, False))
    if _largest_share(_spurious_share(near, start)) > _HIGH_NOISE_INFORMATION:
        rounds = ((max(count, _N_SLOPE_SIMULATIONS - near.simulations), True),)
    last = _iterate_simulation(near, start, rounds)
    sizes = last.fit.x[posterior.layout.effects]
    nonlinear = np.array([e.nonlinear for e in fit.effects for _ in e.parameters])
    if (last.posterior.doubt > _UNCERTAIN_SIZE * np.abs(sizes))[nonlinear].any():
        last = _iterate_simulation(last.posterior, last.fit, ((_MAX_SIMULATIONS, False),))
    moved = np.abs(last.fit.x - start.x)[posterior.layout.effects]
    if last.fit.log_posterior + last.posterior.lost < start.log_posterior + near.lost:
        return replace(near, doubt=np.hypot(last.posterior.doubt, moved)), start
    return replace(last.posterior, doubt=np.hypot(last.posterior.doubt, _MOVE_STD * moved)), last.fit


def _simulate_offset(posterior: Posterior, fit: MapEstimate, seed: int) -> tuple[ComplexArray, ComplexArray, Moments]:
    """Offset, the same without a control variate, and what the laws add to the moments."""
    acting = draw_forces(posterior, fit.x, fit.effects, seed)
    made = simulate_spectra(
        posterior, fit.x, fit.effects, acting, simulate_exact(posterior, fit.x, fit.effects, acting)
    )
    added = simulate_moments(made.bent, posterior, fit) - simulate_moments(made.straight, posterior, fit)
    return made.controlled, made.free, added


def _simulate_slopes(posterior: Posterior, fit: MapEstimate, seed: int) -> ComplexArray:
    """Slopes of the offset by the laws' sizes, shape (p, classes, n_bins, c, c); none by a sensor's, which samples tell."""
    laws = [(i, e) for i, e in enumerate(e for e in fit.effects for _ in e.parameters) if e.nonlinear]
    out = np.zeros((len(laws), *posterior.observed.spectra.shape), dtype=complex)
    acting = draw_forces(posterior, fit.x, fit.effects, seed)
    here = linearization_error(
        posterior, fit.x, fit.effects, acting, simulate_exact(posterior, fit.x, fit.effects, acting)
    )
    for slope, (i, effect) in zip(out, laws, strict=True):
        if effect.family == "sensor":
            continue
        x = fit.x.copy()
        sizes = x[posterior.layout.effects]
        step = _SIZE_DIFFERENCE * abs(sizes[i])
        sizes[i] += step
        effects = with_coordinates(fit.effects, sizes)
        slope[:] = (
            linearization_error(posterior, x, effects, acting, simulate_exact(posterior, x, effects, acting)) - here
        ) / step
    return out


def _stored_slopes(posterior: Posterior, fit: MapEstimate) -> ComplexArray:
    """Those that a problem has for the laws of a fit; none otherwise."""
    if isinstance(posterior, CorrectedPosterior) and posterior.laws == tuple(
        (e.name, e.location) for e in fit.effects if e.nonlinear
    ):
        return posterior.slopes_by_size
    return np.zeros((0, *posterior.observed.spectra.shape), dtype=complex)


def _spurious_information(posterior: CorrectedPosterior, fit: MapEstimate, slopes: ComplexArray) -> Array:
    """Information that chance in the mean of simulated slopes, shape (k, p, classes, n_bins, c, c), feigns: shape (p, p)."""
    k, p = slopes.shape[:2]
    if k < 2:
        return np.zeros((p, p))
    here = posterior.predict(fit.x, fit.effects)
    apart = posterior.spread(slopes - slopes.mean(axis=0))
    rows, _ = posterior.whitened(here.spectra, apart.reshape(k * p, *apart.shape[2:]), here.data)
    rows = rows.reshape(-1, k, p)
    return np.asarray(np.einsum("rka,rkb->ab", rows, rows) / (k * (k - 1)))


def _spurious_share(posterior: Posterior, fit: MapEstimate) -> Array:
    """Covariance times feigned information, shape (n, n)."""
    whole = np.zeros_like(fit.covariance)
    if isinstance(posterior, CorrectedPosterior) and posterior.feigned.any():
        sizes = [e.nonlinear for e in fit.effects for _ in e.parameters]
        nonlinear = posterior.layout.n_nuisance + np.flatnonzero(sizes)
        whole[np.ix_(nonlinear, nonlinear)] = posterior.feigned
    return np.asarray(fit.covariance @ whole)


def _largest_share(part: Array) -> float:
    """Largest share of the information on any size that is feigned, of `_spurious_share`."""
    return float(np.abs(np.linalg.eigvals(part)).max())


def _widen_covariance(posterior: Posterior, fit: MapEstimate) -> Array:
    """Covariance of estimates whose slopes have chance in them, shape (n, n).

    Such a fit takes its information J'J for larger than it is, and its covariance for smaller.
    """
    part = _spurious_share(posterior, fit)
    wider = np.linalg.inv(np.eye(len(part)) - part * min(1.0, _MAX_NOISE_INFORMATION / max(_largest_share(part), 1e-9)))
    return np.asarray(wider @ fit.covariance @ wider.T)


def _simulation_scatter(
    posterior: CorrectedPosterior, fit: MapEstimate, offsets: ComplexArray, free: ComplexArray
) -> tuple[float, Array]:
    """What the simulations' chance costs in log likelihood, and what it adds to the sizes' standard deviation.

    A nonlinear response is not normal, so a recording's spectra scatter more than the likelihood knows: as the spectra of
    simulations without a control variate do.  A single one tells nothing.
    """
    own_sizes, k = posterior.layout.effects, len(offsets)
    if k < 2:
        return 0.0, np.zeros(0)
    here = posterior.predict(fit.x, fit.effects)
    rows = fit.jacobian[: fit.residual.size]
    steps, lost = [], 0.0
    for made in (offsets, free):
        apart, _ = posterior.whitened(here.spectra, posterior.spread(made - made.mean(axis=0)), here.data)
        steps.append((fit.covariance @ (rows.T @ apart))[own_sizes])
        if made is offsets:
            lost = 0.5 * float((apart**2).sum()) / (k * (k - 1))
    own, whole = (s.var(axis=1, ddof=1) for s in steps)
    expected = np.diag(fit.covariance @ (rows.T @ rows) @ fit.covariance)[own_sizes]
    return lost, np.sqrt(own / k + np.maximum(whole - expected, 0.0))
