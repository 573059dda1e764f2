"""What statistical linearization leaves out, measured by simulating the exact law, and the skewness that tells laws apart.

The same forces drive the exact law and the linearized systems of every class; the difference of their averaged spectra
is little disturbed by chance and is added to the prediction, so that the fit that follows is as good as the exact law's.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from monitor.effects import Effect
from monitor.likelihood import Fit, Problem, fit, placed
from monitor.prediction import assemble, channel_response, ground_density
from monitor.results import Array, ComplexArray
from monitor.search import Candidate, conditions, evidence_of
from monitor.simulate import respond
from monitor.spectrum import taper

_ROUNDS = 5
_STEEPEST = 0.7
"""Largest ratio of successive steps that is trusted in extrapolation."""
_SETTLED = 0.5
"""Standard deviations by which the parameters may still move when the polish ends."""
_STEP_HZ = 2048.0
"""Steps of the simulation: spectra in the band need no more."""
_BANDS = 1.3
"""Highest frequency kept of the simulations, over the band's last."""
_SMOOTH = 0.006
"""Width over which the correction is smoothed, as a share of the frequency: about a half-power bandwidth."""
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
    if (
        problem.evidence.drive is not None
    ):  # linear in every class: good enough where the model's own error is fitted too
        return Polished(candidate, problem, np.zeros(problem.context.structure.n_stories))
    path = [at.x[n:]]
    drift_skewness = np.zeros(problem.context.structure.n_stories)
    for round_ in range(_ROUNDS):
        problem = replace(problem, conditions=conditions(problem, at.x, at.effects))
        made = [_simulated(problem, at, seed + k) for k in range(1 if round_ == 0 else 2)]
        drift_skewness = np.mean([s for _, s in made], axis=0)
        plain = replace(problem, offset=None).scatter(at.x, at.effects)
        problem = replace(
            problem, offset=_bounded(plain, np.mean([o for o, _ in made], axis=0), problem.evidence.band.hz)
        )
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
    e, context = problem.evidence, problem.context_at(at.x)
    effects: tuple[Effect, ...] = (*problem.reference.effects(at.x), *at.effects)
    mass, stiffness, damping = problem.matrices(at.x, effects)
    n, p, rate = mass.shape[0], problem.reference.mean.size, e.rate_hz
    step = round(rate / e.band.bin_hz / 2)
    n_segments = e.segments.values.shape[0]
    density = np.empty((n_segments, n))
    force, level = np.exp(at.x[p : p + n]), np.exp(at.x[p + n : p + n + problem.n_classes])
    for k, members in enumerate(e.members):
        density[members] = force * level[k] * e.level[members][:, None]
    middle = (
        np.arange(n_segments) + 2
    ) * step  # one segment to swing in, then half a segment to the first one's middle
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
        ratio = (
            ground_density(share, system, force * level[0], context, problem.conditions[0]) / (force * level[0]).mean()
        )
        ground = np.sqrt(ratio) * root.mean(axis=1) * rng.standard_normal(root.shape[0])
    noise = np.sqrt(problem.noise(at.x) * rate) * rng.standard_normal((root.shape[0], len(context.channels)))
    exact = respond(problem.model(at.x, effects), forces, ground, rate, step_hz=_STEP_HZ) @ context.sensors.T + noise
    bent = [effect for effect in effects if effect.family == "sensor" and effect.nonlinear]
    straight = [effect for effect in effects if effect not in bent]
    for effect in bent:
        exact = effect.measure(exact, rate, context, rng)
    hz = np.arange(round(_BANDS * e.band.hz[-1] / rate * len(root))) * rate / len(root)
    x = _transformed(_spectrum(exact, hz.size), problem, range(n_segments))
    hold = np.sinc(hz / rate)[:, None] ** 2  # forces run straight between samples
    driven = _spectrum(forces if ground is None else np.column_stack([forces, ground]), hz.size) * hold
    heard = _spectrum(noise, hz.size)
    offset = np.empty_like(e.spectra)
    for k, members in enumerate(e.members):
        system = assemble(mass, stiffness, damping, effects, context, problem.conditions[k])
        answer = channel_response(system, hz, context)[:, :, : driven.shape[1]]
        y = _transformed(np.einsum("fcj,fj->fc", answer, driven) + heard, problem, members)
        y = _through(_through(y, bent, problem, k), straight, problem, k)
        z = _through(x[members], straight, problem, k)
        # Noise that linear sensors add is the same on both sides; what clipping adds is on the exact one.
        extra = sum((f.noise_variance(context, problem.conditions[k]) for f in bent), np.zeros(len(context.channels)))
        offset[k] = (np.einsum("sfa,sfb->fab", z, z.conj()) - np.einsum("sfa,sfb->fab", y, y.conj())) / members.size
        offset[k] -= np.diag(np.asarray(extra) / rate)
        offset[k] *= e.band.gain[:, None, None]
    return offset, skewness(x, problem)[0]


def _through(transforms: ComplexArray, effects: list[Effect], problem: Problem, k: int) -> ComplexArray:
    """Transforms after the effects' responses."""
    for effect in effects:
        response = effect.response(problem.evidence.band.hz, problem.context, problem.conditions[k])
        if response is not None:
            full = np.broadcast_to(response, (transforms.shape[1], *response.shape[1:]))
            transforms = np.einsum("fab,sfb->sfa", full, transforms)
    return transforms


def _spectrum(samples: Array, n: int) -> ComplexArray:
    """The lowest n frequencies of whole series, shape (n, columns), scaled so that n / 2 samples keep the amplitude."""
    return np.asarray(np.fft.rfft(samples, axis=0)[:n] * (2.0 * (n - 1) / samples.shape[0]))


def _transformed(spectrum: ComplexArray, problem: Problem, wanted: Iterable[int]) -> ComplexArray:
    """Tapered transforms of the wanted segments in the band, shape (n_wanted, n_bins, c), of a series at a lower rate."""
    band = problem.evidence.band
    samples = np.fft.irfft(spectrum, n=2 * (spectrum.shape[0] - 1), axis=0)
    total = (problem.evidence.segments.values.shape[0] + 2) / 2.0  # segments one after the other
    rate = samples.shape[0] / total * band.bin_hz
    length = samples.shape[0] / total
    window = taper(round(length))[:, None] / np.sqrt(rate)
    begin = [round((i + 1) * length / 2.0) for i in wanted]
    parts = np.stack([samples[i : i + len(window)] for i in begin])
    return np.asarray(np.fft.rfft(window * parts, axis=1)[:, band.first : band.first + band.n_bins])


def _bounded(spectra: ComplexArray, offset: ComplexArray, hz: Array) -> ComplexArray:
    """The offset, smoothed relative to the spectra, and kept from taking away so much that none would be left."""
    lower = np.linalg.cholesky(spectra)
    inverse = np.linalg.inv(lower)
    relative = inverse @ offset @ inverse.conj().swapaxes(-1, -2)
    near = np.exp(-0.5 * ((hz[:, None] - hz) / np.maximum(_SMOOTH * hz[:, None], 1e-9)) ** 2)
    near /= near.sum(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("fg,kgab->kfab", near, relative))
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
