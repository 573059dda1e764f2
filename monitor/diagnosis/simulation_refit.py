"""Refit with the error of statistical linearization, measured by simulating the exact law.

The same forces drive the exact law and the linearized systems of every class, so the difference of their averaged spectra has
little random error.  The difference is added to the prediction, with its slopes by the law's sizes, so that the following fit
is as good as one with the exact law.  The spread between simulations shows the remaining random error, which is added to the
standard deviations of the sizes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np

from monitor.core import Array, ComplexArray, parallel_map
from monitor.diagnosis.initial_fit import fit_linearized
from monitor.diagnosis.score_test import Candidate, key_of, score_candidate
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
    measure_moments,
    normal_moments,
    simulate_spectra,
    tried,
    with_coordinates,
)
from monitor.model import Context, StructuralPrior, loaded

Spectra = Annotated[ComplexArray, "classes bins c c"]
Simulations = Annotated[ComplexArray, "k classes bins c c"]
Rounds = tuple[tuple[int, bool], ...]
"""Simulations in each round, and whether slopes are taken too."""
_MIN_SIMULATIONS = 3
"""Fewest simulations of a published result. [count; cost]"""
_MAX_SIMULATIONS = 10
"""Most simulations of a published result. [count; cost]"""
_NATS_A_SIMULATION = 100.0
"""One more simulation for every so many nats of gain that the randomness of a single one costs. [nats; judgement]"""
Effort = Literal["rough", "fine", "finest"]
"""Effort of the simulation: for a rival, for the best candidate, and where the simulations' random error makes a tie."""
_ROUNDS: dict[Effort, Rounds] = {"rough": ((1, True),), "fine": ((2, True),), "finest": ((_MAX_SIMULATIONS, False),)}
"""Rounds for each effort.  Without slopes from the start, a law that is far from its linearization is fitted away."""
_SENSORS: dict[Effort, Rounds] = {
    "rough": ((1, False),),
    "fine": ((_MIN_SIMULATIONS, False),),
    "finest": ((_MAX_SIMULATIONS, False),),
}
"""The same for sensors' laws.  Samples give the slopes by sensors' sizes, so no slope is simulated."""
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
    """Candidate refitted with its law simulated."""

    candidate: Candidate
    posterior: Posterior
    """Posterior with the correction of the linearized law."""
    moments: Moments
    """Moments that all laws add to those of a normal process, by simulation."""
    variance_ratio: float = 1.0
    """Variance of the difference between measured and simulated moments, over that of the measured ones."""
    log_evidence_std: float = 0.0
    """Standard deviation of the evidence by the simulations' random error, nats."""


@dataclass(frozen=True, eq=False, slots=True)
class SimulatedFit:
    """Fit whose nonlinear laws were simulated at the fitted parameters."""

    posterior: CorrectedPosterior
    fit: MapEstimate
    moments: Moments
    """Moments that the laws add to those of a normal process."""
    simulations: int
    """Number of simulations in the mean of the moments."""


def refit_by_simulation(
    posterior: Posterior, null_fit: MapEstimate, candidate: Candidate, effort: Effort = "rough"
) -> RefittedCandidate:
    """Refit a candidate with nonlinear laws, its linearization corrected by simulation at the fitted size."""
    simulated_fit = fit_by_simulation(posterior, candidate.fit, effort)
    softening = effort == "rough" and any(e.is_softening for e in candidate.fit.effects)
    if softening and np.abs(simulated_fit.posterior.relative[0]).max() > _MAX_SOFTENING_CORRECTION:
        weaker = fit_by_simulation(posterior, _weaken_laws(posterior, candidate.fit), effort)
        simulated_fit = max(simulated_fit, weaker, key=lambda m: m.fit.log_posterior)
    lost, variance_ratio = simulated_fit.posterior.lost, 1.0 + 1.0 / simulated_fit.simulations
    better = score_candidate(simulated_fit.posterior, null_fit, simulated_fit.fit)
    simulated = isinstance(posterior, CorrectedPosterior) and candidate.key in posterior.laws
    gain = better.delta_log_posterior + lost
    # The difference may be within the simulations' random error.
    if not simulated and better.delta_log_posterior < candidate.delta_log_posterior <= gain:
        return RefittedCandidate(candidate, posterior, simulated_fit.moments, variance_ratio)
    better = replace(better, delta_log_posterior=gain, log_evidence=better.log_evidence + lost)
    return RefittedCandidate(
        better, simulated_fit.posterior, simulated_fit.moments, variance_ratio, float(np.sqrt(2.0 * lost))
    )


def fit_initial_model(
    observed: ObservedSpectra, prior: StructuralPrior, context: Context, start: Array | None = None
) -> tuple[Posterior, MapEstimate, Moments]:
    """Fit the model without a new cause as `fit_linearized` does, with persistent nonlinear laws corrected by simulation.

    The moments are those that the persistent laws add to those of a normal process.
    """
    posterior, null_fit = fit_linearized(observed, prior, context, start)
    simulated = linear = posterior, null_fit, normal_moments(posterior)
    for _ in range(_N_REFITS):
        simulated = tried(partial(fit_persistent_effects, *simulated[:2]), linear)
    # Near the strongest motion that a law allows, forces fitted to its linear form make the exact law diverge.  Then the
    # linear form is kept.
    return max(simulated, linear, key=lambda candidate: candidate[1].log_posterior)


def fit_persistent_effects(posterior: Posterior, fit: MapEstimate) -> tuple[Posterior, MapEstimate, Moments]:
    """Refit with the correction of the persistent laws only; without such laws or with measured ground motion, do not refit."""
    linear = replace(posterior, offset=None)
    if not posterior.linearizes(posterior.prior.effects(fit.x)):
        return linear, fit, normal_moments(posterior)
    simulated_fit = fit_by_simulation(linear, fit)
    return simulated_fit.posterior, simulated_fit.fit, simulated_fit.moments


def fit_by_simulation(posterior: Posterior, fit: MapEstimate, effort: Effort = "fine") -> SimulatedFit:
    """Refit with all nonlinear laws simulated."""
    return _iterate_simulation(posterior, fit, (_SENSORS if _only_sensors_nonlinear(fit) else _ROUNDS)[effort])


def _weaken_laws(posterior: Posterior, fit: MapEstimate) -> MapEstimate:
    """Reduce the sizes of the nonlinear laws as the start of another fit."""
    x = fit.x.copy()
    x[posterior.layout.effects][[e.nonlinear for e in fit.effects for _ in e.parameters]] *= _REDUCED_START
    return replace(fit, x=x, effects=with_coordinates(fit.effects, x[posterior.layout.effects]))


def _only_sensors_nonlinear(fit: MapEstimate) -> bool:
    return all(e.family == "sensor" for e in fit.effects if e.nonlinear)


def _iterate_simulation(posterior: Posterior, fit: MapEstimate, rounds: Rounds) -> SimulatedFit:
    """Refit with all nonlinear laws simulated, in one round for each entry of `rounds`.

    The slopes of the offset by the sizes matter, since a linearized law may be far more or far less sensitive to its size than
    the exact law.  A round without slopes keeps those of the posterior.
    """
    loaded()
    laws = tuple(key_of(e) for e in fit.effects if e.nonlinear)
    slopes, spurious, known = np.zeros((0, *posterior.observed.spectra.shape), dtype=complex), np.zeros((0, 0)), 0
    if laws and isinstance(posterior, CorrectedPosterior) and posterior.laws == laws:
        slopes, spurious, known = posterior.slopes_by_size, posterior.spurious_information, posterior.simulations
    linear = replace(posterior, offset=None)
    for count, sloped in rounds:
        linear = replace(linear, conditions=linearize(linear, fit.x, fit.effects))
        kept = known if known > 1 else 0  # a single one was made on the way to the present fit
        tasks: list[partial[Any]] = [
            partial(_simulate_slopes, linear, fit, _FIRST_SLOPE_SEED + kept + i) for i in range(count * sloped)
        ]
        tasks += [partial(_simulate_offset, linear, fit, i) for i in range(count)]
        results = parallel_map(lambda task: task(), tasks)
        offset_results = results[-count:]
        offsets, free = np.array([m[0] for m in offset_results]), np.array([m[1] for m in offset_results])
        added = sum((m[2] for m in offset_results), normal_moments(linear)) / count
        if sloped:
            new = np.array(results[:count])
            known = kept + count
            slopes = new.mean(axis=0) if not kept else (kept * slopes + new.sum(axis=0)) / known
        near = correct_posterior(linear, fit.x, fit.effects, offsets.mean(axis=0), slopes)
        if sloped:
            spurious = _spurious_information(near, fit, new) * count / known
        near = replace(near, spurious_information=spurious, simulations=known)
        fit = maximize_posterior(near, fit.x, fit.effects, iterations=8)
    lost, simulation_std = _simulation_scatter(near, fit, offsets, free)
    if simulation_std.size:
        added_variance = np.diag(_widen_covariance(near, fit) - fit.covariance)[near.layout.effects]
        simulation_std = np.sqrt(simulation_std**2 + np.maximum(added_variance, 0.0))
    return SimulatedFit(replace(near, lost=lost, simulation_std=simulation_std), fit, added, count)


def refine_fit(posterior: Posterior, fit: MapEstimate) -> tuple[CorrectedPosterior, MapEstimate]:
    """Refit as `fit_by_simulation` for a published result, with more simulations where their random error is large.

    The last move of the sizes adds to their standard deviation.  Where the fit gets worse, the first fit is kept.
    """
    if isinstance(posterior, CorrectedPosterior) and posterior.simulation_std.size == fit.n_effect:
        near, start = posterior, fit  # simulated finely already, with all its effects
    else:
        simulated_fit = fit_by_simulation(posterior, fit)
        near, start = simulated_fit.posterior, simulated_fit.fit
    if _only_sensors_nonlinear(fit):
        return near, start
    count = int(np.clip(np.ceil(2.0 * near.lost / _NATS_A_SIMULATION), _MIN_SIMULATIONS, _MAX_SIMULATIONS))
    rounds: Rounds = ((count, False),) if count == _MIN_SIMULATIONS else ((count // 2, True), (count, False))
    if _largest_share(_spurious_share(near, start)) > _HIGH_NOISE_INFORMATION:
        rounds = ((max(count, _N_SLOPE_SIMULATIONS - near.simulations), True),)
    last = _iterate_simulation(near, start, rounds)
    sizes = last.fit.x[posterior.layout.effects]
    nonlinear = np.array([e.nonlinear for e in fit.effects for _ in e.parameters])
    if (last.posterior.simulation_std > _UNCERTAIN_SIZE * np.abs(sizes))[nonlinear].any():
        last = _iterate_simulation(last.posterior, last.fit, ((_MAX_SIMULATIONS, False),))
    moved = np.abs(last.fit.x - start.x)[posterior.layout.effects]
    if last.fit.log_posterior + last.posterior.lost < start.log_posterior + near.lost:
        return replace(near, simulation_std=np.hypot(last.posterior.simulation_std, moved)), start
    return replace(last.posterior, simulation_std=np.hypot(last.posterior.simulation_std, _MOVE_STD * moved)), last.fit


def _simulate_offset(posterior: Posterior, fit: MapEstimate, seed: int) -> tuple[Spectra, Spectra, Moments]:
    """Simulate the offset of the spectra from the linearized ones, with the linearized system as control variate, and without it.

    The moments are those that the laws add to those of a normal process.
    """
    acting = draw_forces(posterior, fit.x, fit.effects, seed)
    simulated = simulate_spectra(posterior, fit.x, fit.effects, acting)
    exact, linearized = (
        measure_moments(transforms, posterior, fit).mean for transforms in (simulated.exact, simulated.linearized)
    )
    return simulated.controlled, simulated.free, exact - linearized


def _simulate_slopes(
    posterior: Posterior, fit: MapEstimate, seed: int
) -> Annotated[ComplexArray, "p classes bins c c"]:
    """Simulate the slopes of the offset by the laws' sizes; by sensors' sizes they are zero, since the samples give these."""
    laws = [(i, e) for i, e in enumerate(e for e in fit.effects for _ in e.parameters) if e.nonlinear]
    out = np.zeros((len(laws), *posterior.observed.spectra.shape), dtype=complex)
    acting = draw_forces(posterior, fit.x, fit.effects, seed)

    offset = linearization_error(posterior, fit.x, fit.effects, acting)
    for slope, (i, effect) in zip(out, laws, strict=True):
        if effect.family == "sensor":
            continue
        x = fit.x.copy()
        sizes = x[posterior.layout.effects]
        step = _SIZE_DIFFERENCE * abs(sizes[i])
        sizes[i] += step
        moved = linearization_error(posterior, x, with_coordinates(fit.effects, sizes), acting)
        slope[:] = (moved - offset) / step
    return out


def _spurious_information(
    posterior: CorrectedPosterior, fit: MapEstimate, slopes: Annotated[ComplexArray, "k p classes bins c c"]
) -> Annotated[Array, "p p"]:
    """Compute the spurious information on the sizes by random error in the mean of the slopes by each of k simulations."""
    k, p = slopes.shape[:2]
    if k < 2:
        return np.zeros((p, p))
    prediction = posterior.predict(fit.x, fit.effects)
    deviations = posterior.spread(slopes - slopes.mean(axis=0))
    rows, _ = posterior.whitened(prediction.spectra, deviations.reshape(k * p, *deviations.shape[2:]), prediction.data)
    rows = rows.reshape(-1, k, p)
    return np.asarray(np.einsum("rka,rkb->ab", rows, rows) / (k * (k - 1)))


def _spurious_share(posterior: CorrectedPosterior, fit: MapEstimate) -> Annotated[Array, "n n"]:
    whole = np.zeros_like(fit.covariance)
    if posterior.spurious_information.any():
        sizes = [e.nonlinear for e in fit.effects for _ in e.parameters]
        nonlinear = posterior.layout.n_nuisance + np.flatnonzero(sizes)
        whole[np.ix_(nonlinear, nonlinear)] = posterior.spurious_information
    return np.asarray(fit.covariance @ whole)


def _largest_share(part: Annotated[Array, "n n"]) -> float:
    """Compute the largest share of the information on any size that is spurious, from `_spurious_share`."""
    return float(np.abs(np.linalg.eigvals(part)).max())


def _widen_covariance(posterior: CorrectedPosterior, fit: MapEstimate) -> Annotated[Array, "n n"]:
    """Widen the covariance of estimates whose slopes have random error, as such a fit overestimates its information J'J."""
    part = _spurious_share(posterior, fit)
    wider = np.linalg.inv(np.eye(len(part)) - part * min(1.0, _MAX_NOISE_INFORMATION / max(_largest_share(part), 1e-9)))
    return np.asarray(wider @ fit.covariance @ wider.T)


def _simulation_scatter(
    posterior: CorrectedPosterior, fit: MapEstimate, offsets: Simulations, free: Simulations
) -> tuple[float, Annotated[Array, "p"]]:
    """Estimate the effect of the simulations' random error on the log likelihood and on the sizes.

    A nonlinear response is not normal, so a recording's spectra scatter more than the likelihood assumes.  The spectra of
    simulations without a control variate show this scatter.  A single simulation shows nothing.  `offsets` and `free` are of k
    simulations with and without a control variate.  Return the log likelihood lost by the random error of the mean offset, nats,
    and the standard deviation that this error adds to the sizes.
    """
    own_sizes, k = posterior.layout.effects, len(offsets)
    if k < 2:
        return 0.0, np.zeros(0)
    prediction = posterior.predict(fit.x, fit.effects)
    steps, lost = [], 0.0
    for spectra in (offsets, free):
        deviations, _ = posterior.whitened(
            prediction.spectra, posterior.spread(spectra - spectra.mean(axis=0)), prediction.data
        )
        steps.append((fit.covariance @ (fit.slopes.along(deviations)))[own_sizes])
        if spectra is offsets:
            lost = 0.5 * float((deviations**2).sum()) / (k * (k - 1))
    own, whole = (s.var(axis=1, ddof=1) for s in steps)
    expected = np.diag(fit.covariance @ fit.information @ fit.covariance)[own_sizes]
    return lost, np.sqrt(own / k + np.maximum(whole - expected, 0.0))
