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
"""Least samples of the simulation in a period of the band's last frequency. [count; accuracy of the integration]"""
_KEPT_BAND = 1.3
"""Highest frequency kept of the simulations, over the band's last. [ratio; judgement]"""
_FRICTION_STEPS = 3
"""Steps a sample where a law is friction. [count; accuracy of the integration]"""
_INERTIA_FREQUENCY = 1e3
"""Frequency at which only inertia responds. [1/sample; definition: far above the band]"""
_LEVEL_STRIDE = 16
"""Every so many samples are used to find a level. [samples; cost]"""
_LEVEL_STEPS = 12
"""Iterations to find a level. [iterations; cost]"""
_COHERENCE_BINS = 2
"""Bins on either side over which the coherence of the two responses is measured. [bins; judgement]"""


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


def draw_forces(posterior: Posterior, x: Array, effects: Sequence[Effect], seed: int) -> Forces:
    """Random forces of every segment's own level: one segment to swing in, then the segments one after the other."""
    e, context = posterior.observed, posterior.context_at(x)
    effects = (*posterior.prior.effects(x), *effects)
    bent = _bent(effects)
    half = round(e.rate_hz / e.band.bin_hz / 2) if bent else _samples(posterior)
    rate = 2.0 * half * e.band.bin_hz
    n, n_segments, known = context.structure.n_dofs, e.t_s.size, posterior.forces(x)
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
        system = extended(posterior.system(x, effects), effects, context, posterior.conditions[0])
        first = known[0]
        ratio = ground_density(share, system, first, effects, context, posterior.conditions[0]) / first.mean()
        ground = np.sqrt(ratio) * root.mean(axis=1) * rng.standard_normal(root.shape[0])
    noise = None
    if bent:
        noise = np.sqrt(posterior.noise(x) * rate) * rng.standard_normal((root.shape[0], len(context.channels)))
    return Forces(rate, floors, ground, noise, rng)


def _samples(posterior: Posterior) -> int:
    """In half a segment."""
    band = posterior.observed.band
    return int(next_fast_len(int(np.ceil(_STEPS_A_PERIOD * band.hz[-1] / band.bin_hz / 2.0))))


def _bent(effects: Sequence[Effect]) -> list[Effect]:
    """Sensors with a law of their own."""
    return [effect for effect in effects if effect.family == "sensor" and effect.nonlinear]


def simulate_exact(posterior: Posterior, x: Array, effects: Sequence[Effect], acting: Forces) -> ComplexArray:
    """Transforms of the segments under the exact laws before the linear sensors, shape (n_segments, n_bins, c)."""
    context, everything = posterior.context_at(x), (*posterior.prior.effects(x), *effects)
    model, finer = posterior.model(x, everything), 1
    if any(law.kind == LawKind.FRICTION for effect in everything for law in effect.laws(model.structure)):
        finer = _FRICTION_STEPS  # where the sign of a velocity turns, forces change within a short time
    moved = respond(model, acting.floors, acting.ground, acting.rate_hz, step_hz=finer * acting.rate_hz)
    seen = moved @ context.sensors.T
    if acting.noise is not None:
        seen = seen + acting.noise
    for effect in _bent(everything):
        seen = _measured(effect, seen, posterior, acting, context)
    return _transformed(_spectrum(seen, posterior), posterior, range(posterior.observed.t_s.size))


def _measured(effect: Effect, samples: Array, posterior: Posterior, acting: Forces, context: Context) -> Array:
    """What a sensor's law makes of samples at the measured RMS, which beyond the band the model need not meet."""
    e, part = posterior.observed, samples[::_LEVEL_STRIDE]
    wanted = np.sqrt(e.counts @ e.rms**2 / e.counts.sum())[: samples.shape[1]]
    louder = np.ones(samples.shape[1])
    for _ in range(_LEVEL_STEPS):
        heard = effect.measure(part * louder, acting.rate_hz, context, acting.rng)
        louder *= wanted / heard.std(axis=0)
    return np.asarray(effect.measure(samples * louder, acting.rate_hz, context, acting.rng) / louder)


def class_means(posterior: Posterior, x: Array, effects: Sequence[Effect], transforms: ComplexArray) -> ComplexArray:
    """Spectra of every class behind the linear sensors, shape (classes, n_bins, c, c), of `simulate_exact`'s transforms."""
    e, everything = posterior.observed, (*posterior.prior.effects(x), *effects)
    straight = [effect for effect in everything if effect not in _bent(everything)]
    out = [_products(_through(transforms[m], straight, posterior, k)) for k, m in enumerate(e.members)]
    return np.asarray(np.stack(out) * e.band.gain[:, None, None])


def linearization_error(
    posterior: Posterior, x: Array, effects: tuple[Effect, ...], acting: Forces, transforms: ComplexArray
) -> ComplexArray:
    """Exact less linearized spectra of every class, shape (classes, n_bins, c, c).

    A structure's law is made linear at the motion that the simulation's own spectra tell, as it is for the measured ones.
    """
    if _bent((*posterior.prior.effects(x), *effects)):
        return _sensors_sides(posterior, x, effects, acting, transforms).controlled
    _, simulated, expected = _compared(posterior, x, effects, transforms)
    return np.asarray(simulated - expected)


def simulate_spectra(
    posterior: Posterior, x: Array, effects: tuple[Effect, ...], acting: Forces, transforms: ComplexArray
) -> SimulatedSpectra:
    """What the exact laws make of forces, of `simulate_exact`'s transforms, beside what the linearized ones do.

    The linearized system under the same forces is the control: its simulated spectra less those expected, times the likeness
    of the two responses, are taken off (its chance is theirs as far as they are alike).  A sensor's law is always compared so.
    """
    e, everything = posterior.observed, (*posterior.prior.effects(x), *effects)
    if _bent(everything):
        return _sensors_sides(posterior, x, effects, acting, transforms)
    posterior, simulated, expected = _compared(posterior, x, effects, transforms)
    noise, diagonal = _noise(posterior, x, everything), np.arange(len(posterior.context.channels))
    out, bent, straight = np.empty_like(e.spectra), np.empty_like(transforms), np.empty_like(transforms)
    for k, (members, y) in enumerate(zip(e.members, _linear(posterior, x, everything, acting), strict=True)):
        linear = _products(y) * e.band.gain[:, None, None]
        linear[:, diagonal, diagonal] += noise[k] * e.band.gain[:, None]
        z = _through(transforms[members], everything, posterior, k)
        likeness = _likeness(np.einsum("sfa,sfb->fab", z, y.conj()) / members.size, _products(y))
        out[k] = simulated[k] - expected[k] - likeness[:, None, None] * (linear - expected[k])
        bent[members], straight[members] = z, y
    return SimulatedSpectra(out, np.asarray(simulated - expected), bent, straight)


def _sensors_sides(
    posterior: Posterior, x: Array, effects: tuple[Effect, ...], acting: Forces, transforms: ComplexArray
) -> SimulatedSpectra:
    """As `simulate_spectra` where a sensor bends: less what the linear sensors say under the same forces and noise."""
    gain, everything = posterior.observed.band.gain, (*posterior.prior.effects(x), *effects)
    posterior, diagonal = posterior.of_model_alone(), np.arange(len(posterior.context.channels))
    out, sensors = class_means(posterior, x, effects, transforms), _bent(everything)
    others = [effect for effect in everything if effect not in sensors]
    bent, straight = np.empty_like(transforms), np.empty_like(transforms)
    for k, y in enumerate(_linear(posterior, x, everything, acting)):
        members = posterior.observed.members[k]
        out[k] -= _products(y) * gain[:, None, None]
        out[k][:, diagonal, diagonal] -= _added(sensors, posterior, k) * gain[:, None]  # what clipping adds
        bent[members], straight[members] = _through(transforms[members], others, posterior, k), y
    return SimulatedSpectra(out, out, bent, straight)


def _compared(
    posterior: Posterior, x: Array, effects: tuple[Effect, ...], transforms: ComplexArray
) -> tuple[Posterior, ComplexArray, ComplexArray]:
    """The posterior linear at the simulation's motion, the exact spectra of every class and those that it expects."""
    posterior, everything = posterior.of_model_alone(), (*posterior.prior.effects(x), *effects)
    simulated, diagonal = class_means(posterior, x, effects, transforms), np.arange(len(posterior.context.channels))
    noise = _noise(posterior, x, everything)[:, None, :] * posterior.observed.band.gain[:, None]
    simulated[:, :, diagonal, diagonal] += noise
    posterior = replace(posterior, conditions=linearize(posterior, x, effects, simulated))
    return posterior, simulated, posterior.scatter(x, effects)


def _noise(posterior: Posterior, x: Array, effects: Sequence[Effect]) -> Array:
    """Density of the channels' noise in every class, shape (classes, c)."""
    return np.array([posterior.noise(x) + _added(effects, posterior, k) for k in range(posterior.n_classes)])


def _linear(posterior: Posterior, x: Array, effects: tuple[Effect, ...], acting: Forces) -> Iterator[ComplexArray]:
    """Transforms of every class's segments as its linearized system answers the forces."""
    context, base = posterior.context_at(x), posterior.system(x, effects)
    bent = _bent(effects)
    hz = np.arange(_kept(posterior)) * acting.rate_hz / len(acting.floors)
    sources = acting.floors if acting.ground is None else np.column_stack([acting.floors, acting.ground])
    driven, straight = _spectrum(sources, posterior), np.sinc(hz / acting.rate_hz)[:, None] ** 2
    heard = 0.0 if acting.noise is None else _spectrum(acting.noise, posterior)
    for k, members in enumerate(posterior.observed.members):
        system = extended(base, effects, context, posterior.conditions[k])
        answer = channel_response(system, hz, context)[:, :, : driven.shape[1]]
        at_once = channel_response(system, np.array([_INERTIA_FREQUENCY * acting.rate_hz]), context)[
            0, :, : driven.shape[1]
        ]
        # Forces run straight between samples.  What that adds far above the band, where floors answer at once, is folded into it.
        folded = (driven * (1.0 - straight)) @ at_once.T
        y = _transformed(np.einsum("fcj,fj->fc", answer, driven * straight) + folded + heard, posterior, members)
        yield _through(_through(y, bent, posterior, k), [e for e in effects if e not in bent], posterior, k)


def _added(effects: Sequence[Effect], posterior: Posterior, k: int) -> Array:
    """Density of the white noise that effects add to the channels."""
    context = posterior.context
    variance = sum(
        (f.noise_variance(context, posterior.conditions[k]) for f in effects), np.zeros(len(context.channels))
    )
    return np.asarray(variance) / context.rate_hz


def _likeness(cross: ComplexArray, own: ComplexArray) -> Array:
    """Squared regression of one response on another near every bin, shape (n_bins,)."""
    ones = np.ones(2 * _COHERENCE_BINS + 1)
    part, whole = (np.convolve((np.abs(a) ** 2).sum(axis=(1, 2)), ones, "same") for a in (cross, own))
    return np.asarray(part / whole)


def _products(transforms: ComplexArray) -> ComplexArray:
    return np.asarray(np.einsum("sfa,sfb->fab", transforms, transforms.conj()) / len(transforms))


def _through(transforms: ComplexArray, effects: Sequence[Effect], posterior: Posterior, k: int) -> ComplexArray:
    """Transforms after the effects' responses."""
    for effect in effects:
        response = effect.response(posterior.observed.band.hz, posterior.context, posterior.conditions[k])
        if response is not None:
            full = np.broadcast_to(response, (transforms.shape[1], *response.shape[1:]))
            transforms = np.einsum("fab,sfb->sfa", full, transforms)
    return transforms


def _coarse(posterior: Posterior) -> int:
    """Samples in half a segment of the series that holds the band alone."""
    band = posterior.observed.band
    fast = next_fast_len(int(np.ceil(_KEPT_BAND * band.hz[-1] / band.bin_hz)), real=True)
    return int(min(fast, round(posterior.observed.rate_hz / band.bin_hz / 2)))


def _kept(posterior: Posterior) -> int:
    """Frequencies of a whole series that matter in the band."""
    return (posterior.observed.t_s.size + 2) * _coarse(posterior) // 2 + 1


def _spectrum(samples: Array, posterior: Posterior) -> ComplexArray:
    """Lowest frequencies of whole series, shape (n, columns), scaled so that fewer samples keep the amplitude."""
    n = _kept(posterior)
    return np.asarray(rfft(np.ascontiguousarray(samples.T))[:, :n].T * (2.0 * (n - 1) / len(samples)))


def _transformed(spectrum: ComplexArray, posterior: Posterior, wanted: Iterable[int]) -> ComplexArray:
    """Tapered transforms of the wanted segments in the band, shape (n_wanted, n_bins, c), of a series at a lower rate."""
    band, half = posterior.observed.band, _coarse(posterior)
    samples = irfft(np.ascontiguousarray(spectrum.T), n=(posterior.observed.t_s.size + 2) * half)
    window = taper(2 * half) / np.sqrt(2.0 * half * band.bin_hz)
    parts = np.stack([samples[:, (i + 1) * half : (i + 3) * half] for i in wanted])  # half overlapped
    return np.asarray(rfft(window * parts)[:, :, band.first : band.first + band.n_bins].swapaxes(1, 2))
