"""Motion of a recording's classes, at which nonlinear laws are linearized."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Annotated

import numpy as np
from scipy.linalg import eigh

from monitor.core import Array, ComplexArray
from monitor.inference.arrays import Spectra
from monitor.inference.cross_spectra import accelerance, extended, force_colour, force_root, seen, variances
from monitor.inference.force_levels import ground_levels
from monitor.inference.input_response import motion_rms
from monitor.inference.observed_spectra import class_temperature
from monitor.inference.posterior import Posterior
from monitor.inference.segments import MIN_PILED
from monitor.inference.trial import require_finite
from monitor.model import Condition, Context, Effect, System

_MAX_BINS = 1 << 16
"""Most frequencies at which the model's motion is summed. [count; cost]"""
_SLOW_SHARE = 0.4
"""Share of the lowest frequency below which motion is not recorded. [ratio; judgement]"""
_MIN_MOTION = 0.3
"""Least share of the model's variance that remains above it. [ratio; judgement]"""


def linearize(
    posterior: Posterior,
    x: Array,
    effects: tuple[Effect, ...],
    spectra: Spectra | None = None,
    *,
    with_motion: bool = True,
) -> tuple[Condition, ...]:
    """Estimate the RMS motion and the temperature of every class under the fitted model.

    The motion of narrow-band modes differs by chance from that expected at the level of the forces, and nonlinear laws depend
    on the actual motion.  The variance by the model is therefore corrected by a Wiener filter's estimate from the spectra, the
    measured ones by default, see `Posterior.excess`.  The motion costs as much as many fits of a linear model; without it it is
    NaN, which is enough for a model without nonlinear effects.

    References
    ----------
    J. B. Roberts, P. D. Spanos, Random Vibration and Statistical Linearization (1990).
    """
    e, context = posterior.observed, posterior.context_at(x)
    everything = posterior.effects(x, effects)
    n, m = context.structure.n_dofs, context.structure.n_stories
    rms = np.full((posterior.n_classes, 2 * m + n), np.nan)
    if with_motion:
        rms = _class_motion(posterior, x, effects, e.spectra if spectra is None else spectra)
    beyond, out = _power_above_band(posterior, x, everything), []
    shaken = posterior.unmeasured_share(everything) > 0.0
    ground = ground_levels(posterior, x, effects) if shaken else np.ones(posterior.n_classes)
    piled, band_hz = e.segments.piled >= MIN_PILED, float(e.band.hz[-1])
    for k, row in enumerate(rms):
        excess_degc = partial(_excess_degc, posterior, k)
        parts = row[:m], row[m : 2 * m], row[2 * m :]
        out.append(Condition(*parts, e.rms[k], excess_degc, e.segments.peak, piled, beyond, band_hz, float(ground[k])))
    return tuple(out)


def _class_motion(posterior: Posterior, x: Array, effects: tuple[Effect, ...], spectra: ComplexArray) -> Array:
    """Estimate the RMS motion of every class: drift (m) and its velocity (m/s) of m stories, velocity (m/s) of n floors."""
    e, context = posterior.observed, posterior.context_at(x)
    everything = posterior.effects(x, effects)
    base, damping = posterior.system(x, everything), np.exp(x[posterior.layout.damping])
    n, forces = context.structure.n_dofs, posterior.forces(x)
    drift = context.structure.drift_matrix()
    rows, order = np.vstack([drift, drift, np.eye(n)]), np.repeat([0, 1, 1], [len(drift), len(drift), n])
    excess, out = posterior.excess(x, effects, spectra), np.empty((posterior.n_classes, len(rows)))
    for k in range(posterior.n_classes):
        system = extended(base, everything, context, posterior.conditions[k])
        lowest = np.sqrt(max(eigh(base.stiffness, base.mass, eigvals_only=True).min(), 1e-6)) / (2.0 * np.pi)
        step = min(0.25 * e.band.bin_hz, 0.25 * damping.min() * lowest)
        step = max(step, e.band.hz[-1] / _MAX_BINS)  # a damping ratio that the fit moves to zero
        require_finite(step, lowest)
        top = e.band.hz[-1] * 1.2
        hz = np.arange(min(max(0.2 * lowest, step), top), top, step)
        motion, _ = _motion_roots(system, everything, hz, forces[k], rows, order, context)
        variance = 2.0 * step * (np.abs(motion[e.band.forced(hz)]) ** 2).sum(axis=(0, 2))
        drive = e.drive.part(e.members[k])
        driven = [motion_rms(drive, system, e.band, context, rows[order == o], o, 0.2 * lowest) for o in (0, 1)]
        variance = variance + np.concatenate(driven) ** 2
        motion, channel_roots = _motion_roots(
            system, everything, e.band.hz, forces[k], rows, order, context, posterior, k
        )
        channels = channel_roots @ channel_roots.conj().swapaxes(-1, -2) + np.diag(posterior.noise(x))
        wiener = np.linalg.solve(channels, channel_roots @ motion.conj().swapaxes(-1, -2)).conj().swapaxes(-1, -2)
        # Motion slower than the structure is noise of sensors, integrated twice.
        recorded = (e.band.hz > _SLOW_SHARE * lowest)[:, None, None] / e.band.gain[:, None, None] * excess[k]
        excess_power = np.einsum("fra,fab,frb->r", wiener, recorded, wiener.conj()).real
        variance = np.maximum(variance + 2.0 * e.band.bin_hz * excess_power, _MIN_MOTION * variance)
        out[k] = np.sqrt(variance)
    return out


def forced_motion(posterior: Posterior, x: Array, effects: Sequence[Effect], laws: Sequence[Effect]) -> Array:
    """Compute the RMS motion (m) of every class along laws of the linearized model, under white forces of the class's level.

    The laws are effects of stories, whose motion is the story's drift, and of floors.  NaN where the system has no stationary
    motion.
    """
    everything = posterior.effects(x, effects)
    context, base = posterior.context_at(x), posterior.system(x, everything)
    n = context.structure.n_dofs
    states, drives = [], []
    for condition, force in zip(posterior.conditions, posterior.forces(x), strict=True):
        system = extended(base, everything, context, condition)
        size = system.mass.shape[0]
        inverse = np.linalg.inv(system.mass)
        states.append(system.state_matrix())
        drive = np.zeros((2 * size, 2 * size))
        ratios = np.array([mode.force_ratio for mode in system.coupled])
        moved = inverse @ system.forced(n)
        root = np.hstack([moved[:, :n] @ force_root(force, everything), moved[:, n:] * np.sqrt(force.mean() * ratios)])
        drive[size:, size:] = root @ root.T
        drives.append(drive)
    # Lyapunov's equation of all classes at once: in the coordinates of the eigenvectors its solution is a division.
    poles, vectors = np.linalg.eig(np.array(states))
    back = np.linalg.inv(vectors)
    decay = -(poles[:, :, None] + poles[:, None, :].conj())
    still = decay == 0.0  # a pole that rounds to 0, as of damping beyond all measure: no stationary motion
    inner = back @ np.array(drives) @ back.conj().swapaxes(1, 2) / np.where(still, 1.0, decay)
    inner[still] = np.nan
    rows = np.array([law.direction(context.structure) for law in laws]) @ vectors[:, :n]
    variance = 0.5 * np.einsum("kra,kab,krb->kr", rows, inner, rows.conj()).real
    # Too strong a coupling makes the system unstable: it has no stationary motion, and the spectra no likelihood.
    return np.asarray(np.sqrt(np.where(variance >= 0.0, variance, np.nan)))


def _power_above_band(posterior: Posterior, x: Array, effects: Sequence[Effect]) -> float:
    """Compute `Condition.beyond`; 1 where no effect is a ground motion, since only the share of a ground motion needs it."""
    if not any(effect.ground_share for effect in effects):
        return 1.0
    e, context = posterior.observed, posterior.context_at(x)
    system = extended(posterior.system(x, effects), effects, context, posterior.conditions[0])
    white = variances(system, e.counts @ posterior.forces(x) / e.counts.sum(), effects, context, e.band.hz[-1])[2]
    noise = posterior.noise(x) * (e.segments.rate_hz - 2.0 * e.band.hz[-1])
    return float((np.maximum(e.segments.above.mean(axis=0) - noise, 0.0) / white).mean())


def _motion_roots(
    system: System, effects: Sequence[Effect], hz: Array, force: Array, rows: Annotated[Array, "rows n"], order: Array,
    context: Context, posterior: Posterior | None = None, k: int = 0,
) -> tuple[Annotated[ComplexArray, "hz rows columns"], Annotated[ComplexArray, "hz c columns"]]:  # fmt: skip
    """Compute roots of the density of displacements (order 0) and velocities (order 1) in given rows, and of the channels.

    Each column is of an independent source of density one.  The channels are under the condition of class k; the second result is
    the first without a posterior.  The forces are in N^2/Hz.
    """
    n = force.size
    own_root = np.sqrt(force.mean() * np.array([mode.force_ratio for mode in system.coupled]))
    w = 2.0 * np.pi * hz
    colour = np.sqrt(force_colour(effects, hz))[:, None, None]
    root = colour * force_root(force, effects)
    floors = accelerance(system.mass, system.damping, system.stiffness, w, system.forced(n))[:, :n]
    floors = np.concatenate([floors[:, :, :n] @ root, colour * own_root * floors[:, :, n:]], axis=2)
    motion = (rows @ floors) * w[:, None, None] ** (order - 2.0)[:, None] * (-1j) ** (2 - order)[:, None]
    if posterior is None:
        return motion, motion
    answer = seen(system, effects, hz, context, posterior.conditions[k])
    n_extra = answer.shape[2] - n - 1 - own_root.size
    own_root = np.concatenate([own_root, np.full(n_extra, np.sqrt(force.mean()))])
    channels = np.concatenate([answer[:, :, :n] @ root, colour * own_root * answer[:, :, n + 1 :]], axis=2)
    still = np.zeros((*motion.shape[:2], channels.shape[2] - motion.shape[2]))  # an extra mode moves no story
    return np.concatenate([motion, still], axis=2), channels


def _excess_degc(posterior: Posterior, k: int, lag_s: float) -> float:
    """Compute `Condition.excess_degc`: the temperature of class k above the reference, by default the recording's mean."""
    value, reference = class_temperature(posterior.observed, k, lag_s), posterior.prior.reference_degc
    if value is None:
        return 0.0
    return value - (float(posterior.observed.segments.temperature[:, 1].mean()) if reference is None else reference)
