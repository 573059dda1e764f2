"""The motion of a recording's classes, at which nonlinear laws are made linear."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from scipy.linalg import eigh

from monitor.core import Array, ComplexArray
from monitor.inference.cross_spectra import accelerance, extended, force_colour, force_root, seen, variances
from monitor.inference.driven_posterior import DrivenPosterior
from monitor.inference.force_levels import ground_levels
from monitor.inference.ground_response import motion_rms
from monitor.inference.observed_spectra import ObservedSpectra, class_temperature
from monitor.inference.posterior import Posterior
from monitor.model import Condition, Context, Effect, System

_MIN_PILE = 20
"""Samples at the largest magnitude that show a clipped signal. [samples; judgement]"""
_MAX_BINS = 1 << 16
"""Most frequencies at which the model's motion is summed. [count; cost]"""
_SLOW_SHARE = 0.4
"""Share of the lowest frequency below which motion is not recorded. [ratio; judgement]"""
_MIN_MOTION = 0.3
"""Least share of the model's variance that remains above it. [ratio; judgement]"""


def linearize(
    posterior: Posterior, x: Array, effects: tuple[Effect, ...], spectra: ComplexArray | None = None
) -> tuple[Condition, ...]:
    """RMS motion of every class, as its spectra (by default the measured ones) tell it under the fitted model, and its
    temperature.

    A class's narrow modes swing more or less by chance than its forces' level says, and nonlinear laws follow the motion:
    the model's variance is corrected by what a Wiener filter sees of the motion in the spectra.
    """
    e, context = posterior.observed, posterior.context_at(x)
    everything = (*posterior.prior.effects(x), *effects)
    base, damping = posterior.system(x, everything), np.exp(x[posterior.layout.damping])
    n, forces = context.structure.n_dofs, posterior.forces(x)
    drift = context.structure.drift_matrix()
    rows, order = np.vstack([drift, drift, np.eye(n)]), np.repeat([0, 1, 1], [len(drift), len(drift), n])
    excess = (e.spectra if spectra is None else spectra) - posterior.scatter(x, effects)
    beyond, out = _beyond(posterior, x, everything), []
    shaken = not isinstance(posterior, DrivenPosterior) and any(effect.ground_share for effect in everything)
    ground = ground_levels(posterior, x, effects) if shaken else np.ones(posterior.n_classes)
    for k in range(posterior.n_classes):
        system = extended(base, everything, context, posterior.conditions[k])
        lowest = np.sqrt(max(eigh(base.stiffness, base.mass, eigvals_only=True).min(), 1e-6)) / (2.0 * np.pi)
        step = min(0.25 * e.band.bin_hz, 0.25 * damping.min() * lowest)
        step = max(step, e.band.hz[-1] / _MAX_BINS)  # a damping that the fit lets go to nothing
        hz = np.arange(max(0.2 * lowest, step), e.band.hz[-1] * 1.2, step)
        motion, _ = _moved(system, everything, hz, forces[k], rows, order, context)
        variance = 2.0 * step * (np.abs(motion) ** 2).sum(axis=(0, 2))
        if isinstance(posterior, DrivenPosterior):
            drive = posterior.drive.part(e.members[k])
            driven = [motion_rms(drive, system, e.band, context, rows[order == o], o, 0.2 * lowest) for o in (0, 1)]
            variance = variance + np.concatenate(driven) ** 2
        else:
            motion, seen_there = _moved(system, everything, e.band.hz, forces[k], rows, order, context, posterior, k)
            channels = seen_there @ seen_there.conj().swapaxes(-1, -2) + np.diag(posterior.noise(x))
            wiener = np.linalg.solve(channels, seen_there @ motion.conj().swapaxes(-1, -2)).conj().swapaxes(-1, -2)
            # What is slower than the structure is the noise of sensors that are integrated twice.
            heard = (e.band.hz > _SLOW_SHARE * lowest)[:, None, None] / e.band.gain[:, None, None] * excess[k]
            more = np.einsum("fra,fab,frb->r", wiener, heard, wiener.conj()).real
            variance = np.maximum(variance + 2.0 * e.band.bin_hz * more, _MIN_MOTION * variance)
        rms = np.sqrt(variance)
        warmer = partial(_excess_degc, e, k, posterior.prior.reference_degc)
        m = len(drift)
        piled, band_hz = e.piled >= _MIN_PILE, float(e.band.hz[-1])
        moved = rms[:m], rms[m : 2 * m], rms[2 * m :]
        out.append(Condition(*moved, e.rms[k], warmer, e.peak, piled, beyond, band_hz, float(ground[k])))
    return tuple(out)


def forced_drift(posterior: Posterior, x: Array, effects: Sequence[Effect]) -> Array:
    """RMS drift that the linearized model has under forces of its level, shape (classes, n_stories), m; whatever their colour."""
    everything = (*posterior.prior.effects(x), *effects)
    context, base = posterior.context_at(x), posterior.system(x, everything)
    n = context.structure.n_dofs
    states, drives = [], []
    for condition, force in zip(posterior.conditions, posterior.forces(x), strict=True):
        system = extended(base, everything, context, condition)
        size = system.mass.shape[0]
        inverse = np.linalg.inv(system.mass)
        states.append(system.state_matrix())
        drive = np.zeros((2 * size, 2 * size))
        root = inverse[:, :n] @ force_root(force, everything)
        drive[size:, size:] = root @ root.T
        drives.append(drive)
    # Lyapunov's equation of all classes at once: in the eigenvectors' coordinates it is a division.
    poles, vectors = np.linalg.eig(np.array(states))
    back = np.linalg.inv(vectors)
    inner = back @ np.array(drives) @ back.conj().swapaxes(1, 2) / -(poles[:, :, None] + poles[:, None, :].conj())
    rows = context.structure.drift_matrix() @ vectors[:, :n]
    return np.asarray(np.sqrt(0.5 * np.einsum("kra,kab,krb->kr", rows, inner, rows.conj()).real))


def _beyond(posterior: Posterior, x: Array, effects: Sequence[Effect]) -> float:
    """See `Condition.beyond`; 1 without a shaken ground, whose motion would be taken for what forces cause."""
    if not any(effect.ground_share for effect in effects):
        return 1.0
    e, context = posterior.observed, posterior.context_at(x)
    system = extended(posterior.system(x, effects), effects, context, posterior.conditions[0])
    white = variances(system, e.counts @ posterior.forces(x) / e.counts.sum(), effects, context, e.band.hz[-1])[2]
    noise = posterior.noise(x) * (e.rate_hz - 2.0 * e.band.hz[-1])
    return float((np.maximum(e.segments.above.mean(axis=0) - noise, 0.0) / white).mean())


def _moved(
    system: System, effects: Sequence[Effect], hz: Array, force: Array, rows: Array, order: Array, context: Context,
    posterior: Posterior | None = None, k: int = 0,
) -> tuple[ComplexArray, ComplexArray]:  # fmt: skip
    """Roots of the density of displacements (order 0) and velocities (1) in given rows, and of the channels.

    Shapes (n_hz, rows, columns) and (n_hz, c, columns), for independent forces of density one.
    """
    n = force.size
    size = system.mass.shape[0]
    right = np.zeros((size, n + 1))
    right[:n, :n] = np.eye(n)
    right[:, n] = -system.mass.sum(axis=1)
    w = 2.0 * np.pi * hz
    root = np.sqrt(force_colour(effects, hz))[:, None, None] * force_root(force, effects)
    floors = accelerance(system.mass, system.damping, system.stiffness, w, right)[:, :n, :n] @ root
    motion = (rows @ floors) * w[:, None, None] ** (order - 2.0)[:, None] * (-1j) ** (2 - order)[:, None]
    if posterior is None:
        return motion, motion
    clock = float(np.prod([effect.clock_factor for effect in effects]))
    return motion, seen(system, effects, hz, clock, context, posterior.conditions[k])[:, :, :n] @ root


def _excess_degc(evidence: ObservedSpectra, k: int, reference_degc: float | None, lag_s: float) -> float:
    """See `Condition.excess_degc`: than at the baseline's mean temperature, else the recording's."""
    value = class_temperature(evidence, k, lag_s)
    if value is None:
        return 0.0
    return value - (float(evidence.temperature[:, 1].mean()) if reference_degc is None else reference_degc)
