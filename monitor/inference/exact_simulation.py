"""Spectra of the exact nonlinear laws, by simulation beside the linearized systems under the same forces."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from monitor.core import Array, ComplexArray
from monitor.inference.cross_spectra import channel_response, extended, ground_density
from monitor.inference.linearization import linearize
from monitor.inference.posterior import Posterior
from monitor.model import Context, Effect, LawKind, respond
from monitor.signals import taper

_STEPS_A_PERIOD = 14
"""Least samples of the simulation in a period of the band's last frequency."""
_BANDS = 1.3
"""Highest frequency kept of the simulations, over the band's last."""
_STICKY = 3
"""Steps a sample where a law is friction."""
_AT_ONCE = 1e3
"""Frequency, in samples a second, at which nothing but inertia answers."""
_SPARSE, _TURNS = 16, 12
"""Samples of which one is taken to find a level, and iterations."""
_NEAR_BINS = 2
"""Bins to either side over which the likeness of the two responses is measured."""


@dataclass(frozen=True, eq=False, slots=True)
class Forces:
    """What drives one simulation."""

    rate_hz: float
    floors: Array
    """Shape (n_samples, n), N."""
    ground: Array | None
    """Shape (n_samples,), m/s^2."""
    noise: Array | None
    """Of the channels, shape (n_samples, c), m/s^2; none where no sensor bends, since then it is the same on both sides."""
    rng: np.random.Generator
    """For what sensors add."""


@dataclass(frozen=True, eq=False, slots=True)
class SimulatedSpectra:
    """One simulation of the exact laws beside the linearized ones under the same forces."""

    controlled: ComplexArray
    """Exact spectra less those that the linearized laws make expect, with a control variate, shape (classes, n_bins, c, c)."""
    free: ComplexArray
    """The same without one."""
    bent: ComplexArray
    """Transforms of the segments behind all sensors under the exact laws, shape (n_segments, n_bins, c)."""
    straight: ComplexArray
    """Under the linearized laws."""


def draw_forces(problem: Posterior, x: Array, effects: Sequence[Effect], seed: int) -> Forces:
    """Random forces of every segment's own level: one segment to swing in, then the segments one after the other."""
    e, context = problem.observed, problem.context_at(x)
    effects = (*problem.prior.effects(x), *effects)
    bent = _bent(effects)
    half = round(e.rate_hz / e.band.bin_hz / 2) if bent else _samples(problem)
    rate = 2.0 * half * e.band.bin_hz
    n, n_segments, known = context.structure.n_dofs, e.t_s.size, problem.forces(x)
    density = np.empty((n_segments, n))
    for k, members in enumerate(e.members):
        density[members] = known[k] * e.level[members][:, None]
    middle, at_sample = (np.arange(n_segments) + 2) * half, np.arange((n_segments + 2) * half)
    rng = np.random.default_rng(seed)
    root = np.stack([np.interp(at_sample, middle, np.sqrt(density[:, j] * rate)) for j in range(n)], axis=1)
    floors = root * rng.standard_normal(root.shape)
    for effect in effects:
        floors = effect.drive(floors, rate)
    share = sum(effect.ground_share for effect in effects)
    ground = None
    if share > 0.0:
        system = extended(problem.system(x, effects), effects, context, problem.conditions[0])
        first = known[0]
        ratio = ground_density(share, system, first, effects, context, problem.conditions[0]) / first.mean()
        ground = np.sqrt(ratio) * root.mean(axis=1) * rng.standard_normal(root.shape[0])
    noise = None
    if bent:
        noise = np.sqrt(problem.noise(x) * rate) * rng.standard_normal((root.shape[0], len(context.channels)))
    return Forces(rate, floors, ground, noise, rng)


def _samples(problem: Posterior) -> int:
    """In half a segment."""
    band = problem.observed.band
    return int(next_fast_len(int(np.ceil(_STEPS_A_PERIOD * band.hz[-1] / band.bin_hz / 2.0))))


def _bent(effects: Sequence[Effect]) -> list[Effect]:
    """Sensors with a law of their own."""
    return [effect for effect in effects if effect.family == "sensor" and effect.nonlinear]


def simulate_exact(problem: Posterior, x: Array, effects: Sequence[Effect], acting: Forces) -> ComplexArray:
    """Transforms of the segments under the exact laws before the linear sensors, shape (n_segments, n_bins, c)."""
    context, everything = problem.context_at(x), (*problem.prior.effects(x), *effects)
    model, finer = problem.model(x, everything), 1
    if any(law.kind == LawKind.FRICTION for effect in everything for law in effect.laws(model.structure)):
        finer = _STICKY  # where the sign of a velocity turns, forces change within a short time
    moved = respond(model, acting.floors, acting.ground, acting.rate_hz, step_hz=finer * acting.rate_hz)
    seen = moved @ context.sensors.T
    if acting.noise is not None:
        seen = seen + acting.noise
    for effect in _bent(everything):
        seen = _measured(effect, seen, problem, acting, context)
    return _transformed(_spectrum(seen, problem), problem, range(problem.observed.t_s.size))


def _measured(effect: Effect, samples: Array, problem: Posterior, acting: Forces, context: Context) -> Array:
    """What a sensor's law makes of samples at the measured RMS, which beyond the band the model need not meet."""
    e, part = problem.observed, samples[::_SPARSE]
    wanted = np.sqrt(e.counts @ e.rms**2 / e.counts.sum())[: samples.shape[1]]
    louder = np.ones(samples.shape[1])
    for _ in range(_TURNS):
        heard = effect.measure(part * louder, acting.rate_hz, context, acting.rng)
        louder *= wanted / heard.std(axis=0)
    return np.asarray(effect.measure(samples * louder, acting.rate_hz, context, acting.rng) / louder)


def class_means(problem: Posterior, x: Array, effects: Sequence[Effect], transforms: ComplexArray) -> ComplexArray:
    """Spectra of every class behind the linear sensors, shape (classes, n_bins, c, c), of `simulate_exact`'s transforms."""
    e, everything = problem.observed, (*problem.prior.effects(x), *effects)
    straight = [effect for effect in everything if effect not in _bent(everything)]
    out = [_products(_through(transforms[m], straight, problem, k)) for k, m in enumerate(e.members)]
    return np.asarray(np.stack(out) * e.band.gain[:, None, None])


def linearization_error(
    problem: Posterior, x: Array, effects: tuple[Effect, ...], acting: Forces, transforms: ComplexArray
) -> ComplexArray:
    """Exact less linearized spectra of every class, shape (classes, n_bins, c, c).

    A structure's law is made linear at the motion that the simulation's own spectra tell, as it is for the measured ones.
    """
    if _bent((*problem.prior.effects(x), *effects)):
        return _sensors_sides(problem, x, effects, acting, transforms).controlled
    _, simulated, expected = _compared(problem, x, effects, transforms)
    return np.asarray(simulated - expected)


def simulate_spectra(
    problem: Posterior, x: Array, effects: tuple[Effect, ...], acting: Forces, transforms: ComplexArray
) -> SimulatedSpectra:
    """What the exact laws make of forces, of `simulate_exact`'s transforms, beside what the linearized ones do.

    The linearized system under the same forces is the control: its simulated spectra less those expected, times the likeness
    of the two responses, are taken off (its chance is theirs as far as they are alike).  A sensor's law is always compared so.
    """
    e, everything = problem.observed, (*problem.prior.effects(x), *effects)
    if _bent(everything):
        return _sensors_sides(problem, x, effects, acting, transforms)
    problem, simulated, expected = _compared(problem, x, effects, transforms)
    noise, diagonal = _noise(problem, x, everything), np.arange(len(problem.context.channels))
    out, bent, straight = np.empty_like(e.spectra), np.empty_like(transforms), np.empty_like(transforms)
    for k, (members, y) in enumerate(zip(e.members, _linear(problem, x, everything, acting), strict=True)):
        linear = _products(y) * e.band.gain[:, None, None]
        linear[:, diagonal, diagonal] += noise[k] * e.band.gain[:, None]
        z = _through(transforms[members], everything, problem, k)
        likeness = _likeness(np.einsum("sfa,sfb->fab", z, y.conj()) / members.size, _products(y))
        out[k] = simulated[k] - expected[k] - likeness[:, None, None] * (linear - expected[k])
        bent[members], straight[members] = z, y
    return SimulatedSpectra(out, np.asarray(simulated - expected), bent, straight)


def _sensors_sides(
    problem: Posterior, x: Array, effects: tuple[Effect, ...], acting: Forces, transforms: ComplexArray
) -> SimulatedSpectra:
    """As `simulate_spectra` where a sensor bends: less what the linear sensors say under the same forces and noise."""
    gain, everything = problem.observed.band.gain, (*problem.prior.effects(x), *effects)
    problem, diagonal = problem.of_model_alone(), np.arange(len(problem.context.channels))
    out, sensors = class_means(problem, x, effects, transforms), _bent(everything)
    others = [effect for effect in everything if effect not in sensors]
    bent, straight = np.empty_like(transforms), np.empty_like(transforms)
    for k, y in enumerate(_linear(problem, x, everything, acting)):
        members = problem.observed.members[k]
        out[k] -= _products(y) * gain[:, None, None]
        out[k][:, diagonal, diagonal] -= _added(sensors, problem, k) * gain[:, None]  # what clipping adds
        bent[members], straight[members] = _through(transforms[members], others, problem, k), y
    return SimulatedSpectra(out, out, bent, straight)


def _compared(
    problem: Posterior, x: Array, effects: tuple[Effect, ...], transforms: ComplexArray
) -> tuple[Posterior, ComplexArray, ComplexArray]:
    """The problem linear at the simulation's motion, the exact spectra of every class and those that it expects."""
    problem, everything = problem.of_model_alone(), (*problem.prior.effects(x), *effects)
    simulated, diagonal = class_means(problem, x, effects, transforms), np.arange(len(problem.context.channels))
    noise = _noise(problem, x, everything)[:, None, :] * problem.observed.band.gain[:, None]
    simulated[:, :, diagonal, diagonal] += noise
    problem = replace(problem, conditions=linearize(problem, x, effects, simulated))
    return problem, simulated, problem.scatter(x, effects)


def _noise(problem: Posterior, x: Array, effects: Sequence[Effect]) -> Array:
    """Density of the channels' noise in every class, shape (classes, c)."""
    return np.array([problem.noise(x) + _added(effects, problem, k) for k in range(problem.n_classes)])


def _linear(problem: Posterior, x: Array, effects: tuple[Effect, ...], acting: Forces) -> Iterator[ComplexArray]:
    """Transforms of every class's segments as its linearized system answers the forces."""
    context, base = problem.context_at(x), problem.system(x, effects)
    bent = _bent(effects)
    hz = np.arange(_kept(problem)) * acting.rate_hz / len(acting.floors)
    sources = acting.floors if acting.ground is None else np.column_stack([acting.floors, acting.ground])
    driven, straight = _spectrum(sources, problem), np.sinc(hz / acting.rate_hz)[:, None] ** 2
    heard = 0.0 if acting.noise is None else _spectrum(acting.noise, problem)
    for k, members in enumerate(problem.observed.members):
        system = extended(base, effects, context, problem.conditions[k])
        answer = channel_response(system, hz, context)[:, :, : driven.shape[1]]
        at_once = channel_response(system, np.array([_AT_ONCE * acting.rate_hz]), context)[0, :, : driven.shape[1]]
        # Forces run straight between samples.  What that adds far above the band, where floors answer at once, is folded into it.
        folded = (driven * (1.0 - straight)) @ at_once.T
        y = _transformed(np.einsum("fcj,fj->fc", answer, driven * straight) + folded + heard, problem, members)
        yield _through(_through(y, bent, problem, k), [e for e in effects if e not in bent], problem, k)


def _added(effects: Sequence[Effect], problem: Posterior, k: int) -> Array:
    """Density of the white noise that effects add to the channels."""
    context = problem.context
    variance = sum((f.noise_variance(context, problem.conditions[k]) for f in effects), np.zeros(len(context.channels)))
    return np.asarray(variance) / context.rate_hz


def _likeness(cross: ComplexArray, own: ComplexArray) -> Array:
    """Squared regression of one response on another near every bin, shape (n_bins,)."""
    ones = np.ones(2 * _NEAR_BINS + 1)
    part, whole = (np.convolve((np.abs(a) ** 2).sum(axis=(1, 2)), ones, "same") for a in (cross, own))
    return np.asarray(part / whole)


def _products(transforms: ComplexArray) -> ComplexArray:
    return np.asarray(np.einsum("sfa,sfb->fab", transforms, transforms.conj()) / len(transforms))


def _through(transforms: ComplexArray, effects: Sequence[Effect], problem: Posterior, k: int) -> ComplexArray:
    """Transforms after the effects' responses."""
    for effect in effects:
        response = effect.response(problem.observed.band.hz, problem.context, problem.conditions[k])
        if response is not None:
            full = np.broadcast_to(response, (transforms.shape[1], *response.shape[1:]))
            transforms = np.einsum("fab,sfb->sfa", full, transforms)
    return transforms


def _coarse(problem: Posterior) -> int:
    """Samples in half a segment of the series that holds the band alone."""
    band = problem.observed.band
    fast = next_fast_len(int(np.ceil(_BANDS * band.hz[-1] / band.bin_hz)), real=True)
    return int(min(fast, round(problem.observed.rate_hz / band.bin_hz / 2)))


def _kept(problem: Posterior) -> int:
    """Frequencies of a whole series that matter in the band."""
    return (problem.observed.t_s.size + 2) * _coarse(problem) // 2 + 1


def _spectrum(samples: Array, problem: Posterior) -> ComplexArray:
    """Lowest frequencies of whole series, shape (n, columns), scaled so that fewer samples keep the amplitude."""
    n = _kept(problem)
    return np.asarray(rfft(np.ascontiguousarray(samples.T))[:, :n].T * (2.0 * (n - 1) / len(samples)))


def _transformed(spectrum: ComplexArray, problem: Posterior, wanted: Iterable[int]) -> ComplexArray:
    """Tapered transforms of the wanted segments in the band, shape (n_wanted, n_bins, c), of a series at a lower rate."""
    band, half = problem.observed.band, _coarse(problem)
    samples = irfft(np.ascontiguousarray(spectrum.T), n=(problem.observed.t_s.size + 2) * half)
    window = taper(2 * half) / np.sqrt(2.0 * half * band.bin_hz)
    parts = np.stack([samples[:, (i + 1) * half : (i + 3) * half] for i in wanted])  # half overlapped
    return np.asarray(rfft(window * parts)[:, :, band.first : band.first + band.n_bins].swapaxes(1, 2))
