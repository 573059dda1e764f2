"""What statistical linearization leaves out, measured by simulating the exact law, and the skewness that tells laws apart.

The same forces drive the exact law and the linearized systems of every class; the difference of their averaged spectra
is little disturbed by chance and is added to the prediction, so that the fit that follows is as good as the exact law's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from monitor.effects import Effect
from monitor.likelihood import Fit, Problem, fit, placed
from monitor.prediction import assemble, ground_density
from monitor.results import Array, ComplexArray
from monitor.search import Candidate, conditions, evidence_of
from monitor.simulate import respond, respond_linear
from monitor.spectrum import taper

_ROUNDS = 5
_STEEPEST = 0.7
"""Largest ratio of successive steps that is trusted in extrapolation."""
_SETTLED = 0.5
"""Standard deviations by which the parameters may still move when the polish ends."""
_DEEPEST = -0.7
"""Share of a predicted spectrum that the correction may take away."""
_LINEAR_SHARE = 0.2
"""Share of the correction that is counted as its own standard deviation."""


@dataclass(frozen=True, eq=False, slots=True)
class Polished:
    """A candidate whose law was simulated."""

    candidate: Candidate
    problem: Problem
    """With the correction of the linearized law."""
    skewness: Array
    """Of every story's drift in the simulation, shape (n,)."""


def polish(problem: Problem, null: Fit, candidate: Candidate, seed: int = 0) -> Polished:
    """Refit a candidate with nonlinear laws, its linearization corrected by simulation at the fitted size."""
    n, at = problem.n_nuisance, candidate.fit
    path = [at.x[n:]]
    drift_skewness = np.zeros(problem.context.structure.n_stories)
    for round_ in range(_ROUNDS):
        problem = replace(problem, conditions=conditions(problem, at.x, at.effects))
        offset, drift_skewness = _simulated(problem, at, seed)
        problem = replace(problem, offset=offset)
        at = fit(problem, at.x, at.effects, iterations=8)
        path.append(at.x[n:])
        std = np.sqrt(np.diag(at.covariance)[n:])
        if (np.abs(path[-1] - path[-2]) < _SETTLED * std).all():
            break
        if len(path) >= 3 and round_ < _ROUNDS - 1:
            at = replace(at, x=np.concatenate([at.x[:n], _ahead(*path[-3:])]))
            at = replace(at, effects=placed(at.effects, at.x[n:]))
            path = [at.x[n:]]
    moved = np.abs(at.x[n:] - candidate.fit.x[n:])[-len(candidate.effect.parameters) :]
    polished = replace(evidence_of(problem, null, at), doubt=_LINEAR_SHARE * moved)
    return Polished(polished, problem, drift_skewness)


def _ahead(first: Array, second: Array, third: Array) -> Array:
    """Where a sequence of fits is bound (Aitken's extrapolation)."""
    step, before = third - second, second - first
    ratio = np.clip(step / np.where(before == 0.0, 1.0, before), -0.5, _STEEPEST)
    return np.asarray(third + step * ratio / (1.0 - ratio))


def _simulated(problem: Problem, at: Fit, seed: int) -> tuple[ComplexArray, Array]:
    """Exact less linearized spectra of every class, and the drifts' skewness under the exact laws."""
    e, context = problem.evidence, problem.context
    effects: tuple[Effect, ...] = (*problem.reference.effects(at.x), *at.effects)
    mass, stiffness, damping = problem.matrices(at.x, effects)
    n, p, rate = mass.shape[0], problem.reference.mean.size, e.rate_hz
    step = round(rate / e.band.bin_hz / 2)
    n_segments = e.segments.values.shape[0]
    density = np.empty((n_segments, n))
    force, level = np.exp(at.x[p : p + n]), np.exp(at.x[p + n : p + n + problem.n_classes])
    for k, members in enumerate(e.members):
        density[members] = force * level[k] * e.level[members][:, None]
    middle = (np.arange(n_segments) + 2) * step  # one segment to swing in, then half a segment to the first one's middle
    at_sample = np.arange((n_segments + 2) * step)
    rng = np.random.default_rng(seed)
    root = np.stack([np.interp(at_sample, middle, np.sqrt(density[:, j] * rate)) for j in range(n)], axis=1)
    forces = root * rng.standard_normal(root.shape)
    for effect in effects:
        forces = effect.drive(forces, rate)
    share = sum(x.ground_share for x in effects)
    ground = None
    if share > 0.0:
        system = assemble(mass, stiffness, damping, effects, context, problem.conditions[0])
        ratio = ground_density(share, system, force, context) / force.mean()
        ground = np.sqrt(ratio) * root.mean(axis=1) * rng.standard_normal(root.shape[0])
    noise = np.sqrt(problem.noise(at.x) * rate) * rng.standard_normal((root.shape[0], len(context.channels)))
    exact = respond(problem.model(at.x, effects), forces, ground, rate) @ context.sensors.T + noise
    for effect in effects:
        exact = effect.measure(exact, rate, context, rng)
    x = _transformed(exact, problem, step, range(n_segments))
    offset = np.empty_like(e.spectra)
    for k, members in enumerate(e.members):
        system = assemble(mass, stiffness, damping, effects, context, problem.conditions[k])
        driven = forces if ground is None else _with_inertia(forces, ground, system.mass)
        linear = respond_linear(system, n, driven, rate)
        linear = (linear if ground is None else linear + ground[:, None]) @ context.sensors.T + noise
        y = _transformed(linear, problem, step, members)
        for effect in effects:
            response = effect.response(e.band.hz, context, problem.conditions[k])
            if response is not None:
                y = np.einsum("fab,sfb->sfa", np.broadcast_to(response, (e.band.n_bins, *response.shape[1:])), y)
        extra = sum((f.noise_variance(context, problem.conditions[k]) for f in effects), np.zeros(len(context.channels)))
        z = x[members]
        offset[k] = (np.einsum("sfa,sfb->fab", z, z.conj()) - np.einsum("sfa,sfb->fab", y, y.conj())) / members.size
        offset[k] -= np.diag(np.asarray(extra) / rate)
        offset[k] *= e.band.gain[:, None, None]
    plain = replace(problem, offset=None).spectra(at.x, at.effects)
    return _bounded(plain, offset), skewness(x, problem)[0]


def _with_inertia(forces: Array, ground: Array, mass: Array) -> Array:
    padded = np.pad(forces, ((0, 0), (0, mass.shape[0] - forces.shape[1])))
    return np.asarray(padded - ground[:, None] * mass.sum(axis=1))


def _transformed(samples: Array, problem: Problem, step: int, wanted: range | Array) -> ComplexArray:
    """Tapered transforms of the wanted segments in the band, shape (n_wanted, n_bins, c)."""
    band = problem.evidence.band
    window = taper(2 * step)[:, None] / np.sqrt(problem.evidence.rate_hz)
    out = []
    for i in wanted:
        part = samples[(i + 1) * step : (i + 3) * step]
        if part.shape[0] < 2 * step:
            part = np.pad(part, ((0, 2 * step - part.shape[0]), (0, 0)))
        out.append(np.fft.rfft(window * part, axis=0)[band.first : band.first + band.n_bins])
    return np.array(out)


def _bounded(spectra: ComplexArray, offset: ComplexArray) -> ComplexArray:
    """The offset, kept from taking away so much that a spectrum would lose its positive definiteness."""
    lower = np.linalg.cholesky(spectra)
    inverse = np.linalg.inv(lower)
    values, vectors = np.linalg.eigh(inverse @ offset @ inverse.conj().swapaxes(-1, -2))
    carried = lower @ vectors
    return np.asarray((carried * np.maximum(values, _DEEPEST)[..., None, :]) @ carried.conj().swapaxes(-1, -2))


def skewness(transforms: ComplexArray, problem: Problem) -> tuple[Array, Array]:
    """Skewness of every story's drift in the band, mean over segments, and its standard deviation, shape (n,) each.

    Accelerations become drifts in the frequency domain; tapered segments keep the sign of the third moment.
    """
    band, context = problem.evidence.band, problem.context
    floors = transforms[:, :, : len(context.channels)] @ np.linalg.pinv(context.sensors).T
    drift = floors @ context.structure.drift_matrix().T / (-((2.0 * np.pi * band.hz) ** 2))[:, None]
    length = 4 * (band.first + band.n_bins)  # room for the third power
    full = np.zeros((drift.shape[0], length // 2 + 1, drift.shape[2]), dtype=complex)
    full[:, band.first : band.first + band.n_bins] = drift
    d = np.fft.irfft(full, n=length, axis=1)
    third = (d**3).mean(axis=1) / (d**2).mean(axis=1) ** 1.5
    return third.mean(axis=0), third.std(axis=0, ddof=1) / np.sqrt(third.shape[0])
