"""Spectra of the exact nonlinear laws, by simulation together with the linearized systems under the same forces."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from monitor.core import Array, ComplexArray
from monitor.inference.arrays import Spectra, Spectrum, Transforms, mean_products
from monitor.inference.cross_spectra import Band, channel_response, extended, ground_density, noise_density
from monitor.inference.linearization import linearize
from monitor.inference.posterior import Posterior
from monitor.model import Context, Effect, LawKind, channel_motion, driven, own_forces, with_own_forces
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
    """Forces, ground motion and noise of one simulation."""

    rate_hz: float
    floors: Annotated[Array, "samples n"]
    """Forces on the floors, N."""
    own: Annotated[Array, "samples coupled"]
    """Forces on the coupled modes, N."""
    ground: Annotated[Array, "samples"] | None
    """Ground acceleration, m/s^2; None for ground at rest."""
    noise: Annotated[Array, "samples c"] | None
    """Noise of the channels, m/s^2; None where no sensor is nonlinear, since the noise is then the same in the exact and the
    linearized spectra."""
    rng: np.random.Generator
    """Generator of the random numbers that the sensors' effects add."""


@dataclass(frozen=True, eq=False, slots=True)
class SimulatedSpectra:
    """Simulation of the exact laws together with the linearized laws under the same forces."""

    controlled: Spectra
    """Exact spectra less the expected linearized spectra, with a control variate."""
    free: Spectra
    """Exact spectra less the expected linearized spectra, without a control variate."""
    exact: Transforms
    """Transforms of the segments after all sensors under the exact laws."""
    linearized: Transforms
    """Transforms of the segments after all sensors under the linearized laws."""


def draw_forces(posterior: Posterior, x: Array, effects: Sequence[Effect], seed: int) -> Forces:
    """Draw random forces that have each segment's own level.

    The simulation begins with one segment in which the transient of the start from rest decays.  The recording's segments follow
    one after the other.  The forces begin and end at the frequencies at which the recording's do.
    """
    e, context = posterior.observed, posterior.context_at(x)
    effects = posterior.effects(x, effects)
    nonlinear = _nonlinear_sensors(effects)
    fast = int(next_fast_len(int(np.ceil(_STEPS_A_PERIOD * e.band.hz[-1] / e.band.bin_hz / 2.0))))
    half = round(e.segments.rate_hz / e.band.bin_hz / 2) if nonlinear else fast
    rate = 2.0 * half * e.band.bin_hz
    n, n_segments, known = context.structure.n_dofs, e.level.size, posterior.forces(x)
    density = known[e.label] * e.level[:, None]
    middle, at_sample = (np.arange(n_segments) + 2) * half, np.arange((n_segments + 2) * half)
    rng = np.random.default_rng(seed)
    root = np.stack([np.interp(at_sample, middle, np.sqrt(density[:, j] * rate)) for j in range(n)], axis=1)
    floors = _limit_band(root * rng.standard_normal(root.shape), e.band, rate)
    floors = driven(effects, floors, rate, context.structure)
    model = posterior.model(x, effects)
    own = _limit_band(own_forces(model, np.sqrt((root**2).mean(axis=1)), rate, rng), e.band, rate)
    share = sum(effect.ground_share for effect in effects)
    ground = None
    if share > 0.0:
        system = extended(posterior.system(x, effects), effects, context, posterior.conditions[0])
        first = known[0]
        ratio = ground_density(share, system, first, effects, context, posterior.conditions[0]) / first.mean()
        ground = np.sqrt(ratio) * root.mean(axis=1) * rng.standard_normal(root.shape[0])
    noise = None
    if nonlinear:
        noise = np.sqrt(posterior.noise(x) * rate) * rng.standard_normal((root.shape[0], len(context.channels)))
    return Forces(rate, floors, own, ground, noise, rng)


def _limit_band(forces: Annotated[Array, "samples n"], band: Band, rate_hz: float) -> Array:
    """Keep the frequencies of forces (N) at which the recording shows forces."""
    forced = band.forced(np.asarray(np.fft.rfftfreq(len(forces), 1.0 / rate_hz), dtype=float))
    if forced.all():
        return forces
    return np.asarray(irfft(rfft(forces, axis=0) * forced[:, None], n=len(forces), axis=0))


def _nonlinear_sensors(effects: Sequence[Effect]) -> list[Effect]:
    return [effect for effect in effects if effect.family == "sensor" and effect.nonlinear]


def simulate_exact(posterior: Posterior, x: Array, effects: Sequence[Effect], acting: Forces) -> Transforms:
    """Simulate the exact laws under given forces, without the linear sensor effects: the segments' tapered transforms."""
    context, everything = posterior.context_at(x), posterior.effects(x, effects)
    model, finer = posterior.model(x, everything), 1
    if any(law.kind == LawKind.FRICTION for effect in everything for law in effect.laws(model.structure)):
        finer = _FRICTION_STEPS  # friction changes within a short time where a velocity changes sign
    forces = with_own_forces(model, acting.floors, acting.own)
    channels = channel_motion(model, forces, acting.ground, acting.rate_hz, context, step_hz=finer * acting.rate_hz)
    if acting.noise is not None:
        channels = channels + acting.noise
    for effect in _nonlinear_sensors(everything):
        channels = _apply_sensor_law(effect, channels, posterior, acting, context)
    return _segment_transforms(_kept_spectrum(channels, posterior), posterior, range(posterior.observed.level.size))


def _apply_sensor_law(effect: Effect, samples: Array, posterior: Posterior, acting: Forces, context: Context) -> Array:
    """Apply a sensor's nonlinear law to samples that are scaled to the measured RMS.

    The scaling is needed since the model need not have the measured RMS beyond the band.
    """
    e, part = posterior.observed, samples[::_LEVEL_STRIDE]
    wanted = np.sqrt(e.counts @ e.rms**2 / e.counts.sum())[: samples.shape[1]]
    gain = np.ones(samples.shape[1])
    for _ in range(_LEVEL_STEPS):
        measured = effect.measure(part * gain, acting.rate_hz, context, acting.rng)
        gain *= wanted / measured.std(axis=0)
    return np.asarray(effect.measure(samples * gain, acting.rate_hz, context, acting.rng) / gain)


def class_means(posterior: Posterior, x: Array, effects: Sequence[Effect], transforms: ComplexArray) -> Spectra:
    """Average the spectra of every class after the linear sensor effects; `transforms` are those of `simulate_exact`."""
    e, everything = posterior.observed, posterior.effects(x, effects)
    linear = [effect for effect in everything if effect not in _nonlinear_sensors(everything)]
    out = [mean_products(_apply_responses(transforms[m], linear, posterior, k)) for k, m in enumerate(e.members)]
    return np.asarray(np.stack(out) * e.band.gain[:, None, None])


def linearization_error(posterior: Posterior, x: Array, effects: tuple[Effect, ...], acting: Forces) -> Spectra:
    """Simulate the exact less the linearized spectra of every class.

    A law of the structure is linearized at the motion that follows from the simulation's own spectra, as it is for the measured
    spectra.
    """
    transforms = simulate_exact(posterior, x, effects, acting)
    if _nonlinear_sensors(posterior.effects(x, effects)):
        return _compare_sensors(posterior, x, effects, acting, transforms).controlled
    _, simulated, expected = _compare_at_simulated_motion(posterior, x, effects, transforms)
    return np.asarray(simulated - expected)


def simulate_spectra(posterior: Posterior, x: Array, effects: tuple[Effect, ...], acting: Forces) -> SimulatedSpectra:
    """Compare the exact laws with the linearized laws under the same forces, with a control variate.

    The control variate is the linearized system under the same forces: its simulated less its expected spectra, times the
    squared regression of the exact response on it, are subtracted.  Both responses share their random error as far as they are
    alike.  A sensor's law is always compared with the linear sensor under the same forces.
    """
    e, everything = posterior.observed, posterior.effects(x, effects)
    transforms = simulate_exact(posterior, x, effects, acting)
    if _nonlinear_sensors(everything):
        return _compare_sensors(posterior, x, effects, acting, transforms)
    posterior, simulated, expected = _compare_at_simulated_motion(posterior, x, effects, transforms)
    noise, diagonal = _noise_density(posterior, x, everything), np.arange(len(posterior.context.channels))
    beside = _extra_mode_spectra(posterior, x, everything)
    out, exact, linearized = np.empty_like(e.spectra), np.empty_like(transforms), np.empty_like(transforms)
    for k, (members, y) in enumerate(zip(e.members, _linear_transforms(posterior, x, everything, acting), strict=True)):
        linear = mean_products(y) * e.band.gain[:, None, None] + beside[k]
        linear[:, diagonal, diagonal] += noise[k] * e.band.gain[:, None]
        z = _apply_responses(transforms[members], everything, posterior, k)
        regression = _squared_regression(np.einsum("sfa,sfb->fab", z, y.conj()) / members.size, mean_products(y))
        out[k] = simulated[k] - expected[k] - regression[:, None, None] * (linear - expected[k])
        exact[members], linearized[members] = z, y
    return SimulatedSpectra(out, np.asarray(simulated - expected), exact, linearized)


def _compare_sensors(
    posterior: Posterior, x: Array, effects: tuple[Effect, ...], acting: Forces, transforms: ComplexArray
) -> SimulatedSpectra:
    """Compare nonlinear sensors with the linear ones under the same forces and noise, for `simulate_spectra`."""
    gain, everything = posterior.observed.band.gain, posterior.effects(x, effects)
    posterior, diagonal = posterior.of_model_alone(), np.arange(len(posterior.context.channels))
    out, sensors = class_means(posterior, x, effects, transforms), _nonlinear_sensors(everything)
    others = [effect for effect in everything if effect not in sensors]
    exact, linearized = np.empty_like(transforms), np.empty_like(transforms)
    for k, y in enumerate(_linear_transforms(posterior, x, everything, acting)):
        members = posterior.observed.members[k]
        out[k] -= mean_products(y) * gain[:, None, None]
        # The expectation of the linearized sensors includes the distortion that clipping adds, as white noise.
        out[k][:, diagonal, diagonal] -= (
            noise_density(sensors, posterior.context, posterior.conditions[k]) * gain[:, None]
        )
        exact[members], linearized[members] = _apply_responses(transforms[members], others, posterior, k), y
    return SimulatedSpectra(out, out, exact, linearized)


def _compare_at_simulated_motion(
    posterior: Posterior, x: Array, effects: tuple[Effect, ...], transforms: ComplexArray
) -> tuple[Posterior, Spectra, Spectra]:
    """Linearize a posterior at the simulated motion and compute the exact and the expected spectra of every class."""
    posterior, everything = posterior.of_model_alone(), posterior.effects(x, effects)
    simulated, diagonal = class_means(posterior, x, effects, transforms), np.arange(len(posterior.context.channels))
    noise = _noise_density(posterior, x, everything)[:, None, :] * posterior.observed.band.gain[:, None]
    simulated[:, :, diagonal, diagonal] += noise
    simulated += _extra_mode_spectra(posterior, x, everything)
    posterior = replace(posterior, conditions=linearize(posterior, x, effects, simulated))
    return posterior, simulated, posterior.scatter(x, effects)


def _extra_mode_spectra(posterior: Posterior, x: Array, effects: Sequence[Effect]) -> Spectra:
    """Compute the expected spectra of the extra modes, which are not simulated."""
    without = [effect for effect in effects if not effect.extra_modes(posterior.context)]
    if len(without) == len(effects):
        return np.zeros_like(posterior.observed.spectra)
    classes = range(posterior.n_classes)
    return np.asarray(posterior.linear_spectra(x, effects, classes) - posterior.linear_spectra(x, without, classes))


def _noise_density(posterior: Posterior, x: Array, effects: Sequence[Effect]) -> Array:
    """Compute the density of the channels' noise in every class, (m/s^2)^2/Hz."""
    added = [noise_density(effects, posterior.context, condition) for condition in posterior.conditions]
    return posterior.noise(x) + np.array(added)


def _linear_transforms(
    posterior: Posterior, x: Array, effects: tuple[Effect, ...], acting: Forces
) -> Iterator[Annotated[ComplexArray, "members bins c"]]:
    """Yield the transforms of every class's segments under its linearized system."""
    context, base = posterior.context_at(x), posterior.system(x, effects)
    nonlinear = _nonlinear_sensors(effects)
    hz = np.arange(_kept_frequencies(posterior)) * acting.rate_hz / len(acting.floors)
    ground = np.zeros(len(acting.floors)) if acting.ground is None else acting.ground
    sources = np.column_stack([acting.floors, ground, acting.own])
    driven, interpolation = _kept_spectrum(sources, posterior), np.sinc(hz / acting.rate_hz)[:, None] ** 2
    noise = 0.0 if acting.noise is None else _kept_spectrum(acting.noise, posterior)
    for k, members in enumerate(posterior.observed.members):
        system = extended(base, effects, context, posterior.conditions[k])
        answer = channel_response(system, hz, context)
        at_once = channel_response(system, np.array([_INERTIA_FREQUENCY * acting.rate_hz]), context)[0]
        # Forces are linear in time between samples, which adds motion far above the band.  Sampling folds this motion into the
        # band.  At its frequencies only the inertia of the floors responds.
        folded = (driven * (1.0 - interpolation)) @ at_once.T
        y = _segment_transforms(
            np.einsum("fcj,fj->fc", answer, driven * interpolation) + folded + noise, posterior, members
        )
        yield _apply_responses(
            _apply_responses(y, nonlinear, posterior, k), [e for e in effects if e not in nonlinear], posterior, k
        )


def _squared_regression(cross: Spectrum, own: Spectrum) -> Array:
    """Compute the squared regression coefficient, near every bin, of one response on another, whose spectra are `own`."""
    ones = np.ones(2 * _COHERENCE_BINS + 1)
    part, whole = (np.convolve((np.abs(a) ** 2).sum(axis=(1, 2)), ones, "same") for a in (cross, own))
    return np.asarray(part / whole)


def _apply_responses(transforms: ComplexArray, effects: Sequence[Effect], posterior: Posterior, k: int) -> ComplexArray:
    for effect in effects:
        response = effect.response(posterior.observed.band.hz, posterior.context, posterior.conditions[k])
        if response is not None:
            full = np.broadcast_to(response, (transforms.shape[1], *response.shape[1:]))
            transforms = np.einsum("fab,sfb->sfa", full, transforms)
    return transforms


def _kept_samples(posterior: Posterior) -> int:
    """Choose the number of samples in half a segment of the resampled series, which contains the band only."""
    band = posterior.observed.band
    fast = next_fast_len(int(np.ceil(_KEPT_BAND * band.hz[-1] / band.bin_hz)), real=True)
    return int(min(fast, round(posterior.observed.segments.rate_hz / band.bin_hz / 2)))


def _kept_frequencies(posterior: Posterior) -> int:
    """Count the frequencies of a whole series that are kept."""
    return (posterior.observed.level.size + 2) * _kept_samples(posterior) // 2 + 1


def _kept_spectrum(samples: Array, posterior: Posterior) -> Annotated[ComplexArray, "kept columns"]:
    """Transform whole series and keep the lowest frequencies, scaled to keep the amplitude of a series of fewer samples."""
    n = _kept_frequencies(posterior)
    return np.asarray(rfft(np.ascontiguousarray(samples.T))[:, :n].T * (2.0 * (n - 1) / len(samples)))


def _segment_transforms(spectrum: ComplexArray, posterior: Posterior, wanted: Iterable[int]) -> Transforms:
    """Cut the wanted segments out of a whole series and transform them with the taper."""
    band, half = posterior.observed.band, _kept_samples(posterior)
    samples = irfft(np.ascontiguousarray(spectrum.T), n=(posterior.observed.level.size + 2) * half)
    window = taper(2 * half) / np.sqrt(2.0 * half * band.bin_hz)
    parts = np.stack([samples[:, (i + 1) * half : (i + 3) * half] for i in wanted])  # half overlapped
    return np.asarray(rfft(window * parts)[:, :, band.first : band.first + band.n_bins].swapaxes(1, 2))
