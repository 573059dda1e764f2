"""Simulation of a Model in time: recordings with known truth.

`monitor.model.integration` integrates every simulation but those of `reproduce`.  It is exact where the model is linear, for
forces that are linear in time between samples, so that nothing is delayed.  Newmark's average-acceleration method at the paper's
steps is for `reproduce` alone: it lengthens periods to ``f_N = atan(pi f dt) / (pi dt)``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from scipy.optimize import brentq

from monitor.core import Array
from monitor.model.effects import Condition, Context, Effect, System, place_index
from monitor.model.model import Model
from monitor.model.structures import Structure

ExcitationKind = Literal["ambient", "impulse", "ground", "force", "sweep"]
_MEASURED_N = 10.0
"""RMS of a measured force, as a shaker's, beside ambient forces of 1 N. [N; definition]"""


@dataclass(frozen=True, eq=False, slots=True)
class Motion:
    """Recording of the sensors of a simulated structure."""

    rate_hz: float
    floors: Annotated[Array, "samples c"]
    """Absolute accelerations, m/s^2; one channel a floor unless sensors were named."""
    ground: Annotated[Array, "samples"] | None
    """Measured ground acceleration, m/s^2; None where it was not measured."""
    force: Annotated[Array, "samples k"] | None = None
    """Measured forces, N; None where none was measured."""
    rotation_rate: Annotated[Array, "samples g"] | None = None
    """Rates of rotation, rad/s; None where none was measured."""


def linear_system(model: Model) -> System:
    """Assemble the structure, its damping and the effects that are linear at every level of vibration."""
    n = model.structure.n_dofs
    mass, stiffness = model.structural_matrices()
    system = System(mass, model.damping_matrix(), stiffness, ground=model.structure.rides)
    context = Context(model.structure, (), np.zeros((0, n)), 1.0)
    no_condition = Condition(np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0))
    for effect in model.effects:
        if not (effect.conditional or effect.nonlinear):  # the exact laws of the others act in the integration
            system = effect.extend(system, context, no_condition)
    return system


def respond_exactly(model: Model, forces: Array, rate_hz: float, *, appended: bool = False) -> Array:
    """Simulate the floors' accelerations relative to the ground, m/s^2, without nonlinear laws, from rest.

    The response is exact under forces (N) that are linear in time between samples.  Columns beyond n act on the degrees of
    freedom that effects append, whose accelerations are returned too if `appended`.
    """
    from monitor.model.integration import march  # compiled code takes a while to load

    return march(linear_system(model), model.structure.n_dofs, (), forces, rate_hz, step_hz=rate_hz, appended=appended)


def respond_newmark(model: Model, forces: Annotated[Array, "samples n"], rate_hz: float) -> Array:
    """Simulate the floors' accelerations (m/s^2, relative to the ground) by Newmark's average-acceleration method from rest.

    In modal coordinates of a classically damped model the method (gamma 1/2, beta 1/4) is the bilinear transform of
    ``s^2 / (s^2 + 2 zeta w s + w^2)``.  Forces are in N.
    """
    from scipy.signal import lfilter  # takes most of a second to load

    modes = model.modes()
    omega = np.sqrt(modes.eigenvalues)
    zeta = np.diag(modes.shapes.T @ model.damping_matrix() @ modes.shapes) / (2.0 * omega)
    dt = 1.0 / rate_hz
    modal_force = forces @ modes.shapes
    modal_acceleration = np.empty_like(modal_force)
    for i, (w, z) in enumerate(zip(omega, zeta, strict=True)):
        a = 4.0 / dt**2
        b = 4.0 * z * w / dt
        numerator = [a, -2.0 * a, a]
        denominator = [a + b + w**2, 2.0 * (w**2 - a), a - b + w**2]
        modal_acceleration[:, i] = lfilter(numerator, denominator, modal_force[:, i])
    return np.asarray(modal_acceleration @ modes.shapes.T)


def level_wander(n: int, rate_hz: float, spread: float, rng: np.random.Generator) -> Array:
    """Draw a slowly varying level of mean square 1, log-normal and correlated over 60 s, of n samples."""
    if spread == 0.0:
        return np.ones(n)
    from scipy.signal import lfilter  # takes most of a second to load

    step = max(1, int(rate_hz))
    knots = n // step + 2
    decay = np.exp(-step / rate_hz / 60.0)
    white = rng.standard_normal(knots) * np.sqrt(1.0 - decay**2)
    white[0] /= np.sqrt(1.0 - decay**2)
    slow = np.interp(np.arange(n) / step, np.arange(knots), lfilter([1.0], [1.0, -decay], white))
    sigma = np.sqrt(np.log1p(spread**2))
    return np.asarray(np.exp(sigma * slow - sigma**2))


def simulate(
    model: Model,
    *,
    duration_s: float,
    rate_hz: float,
    excitation: ExcitationKind = "ambient",
    noise: float = 0.0,
    level_spread: float = 0.0,
    seed: int = 0,
    context: Context | None = None,
    excess_degc: Array | None = None,
    forced: Sequence[int] = (),
    turning: Array | None = None,
) -> Motion:
    """Simulate a recording of a model under random forces, hammer blows, ground motion, measured forces or a shaker's sweep.

    Raises ValueError if an effect shapes the forces or moves the ground, and `excitation` is the ground; or if a measured
    force has no floor.

    Parameters
    ----------
    excitation : {"ambient", "impulse", "ground", "force", "sweep"}
        Independent white forces of 1 N on every floor; a hammer blow on the middle floor every 10 s; a white ground
        acceleration of 0.5 m/s^2, measured; measured white forces of 10 N beside the ambient ones; a shaker alone, on the floors
        of the measured forces or, not measured, on floor 1: a sine of 10 N that rises over the recording, each octave in equal
        time, from half the lowest mode's frequency to twice the highest's.
    noise : float
        Sensor noise, white at the nominal `rate_hz`, as a fraction of the mean over channels of the acceleration's RMS, the same
        on every channel.  The sensor effects act on the noise as on the motion.  That of gyroscopes is the same fraction of
        the mean RMS of their rates.
    level_spread : float
        Relative spread of the excitation's slowly varying level (0.35 for wind).
    context : Context, optional
        Names and places of the sensors; by default one a floor, a1 to an.
    excess_degc : ndarray, optional
        Temperature above the reference, K; none by default.
    forced : sequence of int, optional
        Floor on which each measured force acts, counted from 1.
    turning : ndarray, optional
        Rotation at each gyroscope by the floors' displacements relative to the ground, rad/m; none by default.
    """
    if excitation == "ground" and any(e.ground_share or np.ndim(e.colour(np.ones(1))) for e in model.effects):
        raise ValueError("effects of the excitation need --excitation ambient or impulse")
    if excitation == "force" and not forced:
        raise ValueError("--excitation force needs [[inputs]] in the structure file: a channel and its floor")
    n = model.structure.n_dofs
    if context is None:
        context = Context(model.structure, tuple(f"a{j + 1}" for j in range(n)), np.eye(n), rate_hz)
    rng = np.random.default_rng(seed)
    effects_rng = rng.spawn(1)[0]  # so that the same seed gives the same forces and noise with and without effects
    n_samples = round(duration_s * rate_hz)
    true_rate_hz = rate_hz * float(np.prod([e.clock_factor for e in model.effects]))
    level = level_wander(n_samples, rate_hz, level_spread, rng)[:, None]
    forces, ground, measured = np.zeros((n_samples, n)), None, None
    if excitation in ("ambient", "force"):
        forces = level * rng.standard_normal((n_samples, n))
    elif excitation == "sweep":
        floors = np.array(forced or [1]) - 1
        shaken = level * _swept(model, n_samples, rate_hz)[:, None] * np.ones(floors.size)
        forces, measured = shaken @ np.eye(n)[floors], shaken if forced else None
    elif excitation == "impulse":
        forces[:: max(1, round(10.0 * rate_hz)), n // 2] = rate_hz  # 1 N s within one sample
    else:
        ground = 0.5 * level[:, 0] * rng.standard_normal(n_samples)
    forces = driven(model.effects, forces, true_rate_hz, model.structure)
    if excitation == "force":
        measured = _MEASURED_N * level * rng.standard_normal((n_samples, len(forced)))
        forces = forces + measured @ np.eye(n)[np.array(forced) - 1]
    true_ground = (
        _unmeasured_ground(model, forces, level[:, 0], true_rate_hz, context, effects_rng) if ground is None else ground
    )
    own = own_forces(model, level[:, 0], true_rate_hz, effects_rng)
    system, all_forces = linear_system(model), with_own_forces(model, forces, own)
    moved = respond(model, all_forces, true_ground, true_rate_hz, excess_degc, appended=bool(system.coupled))
    clean = _seen(moved, system, context)
    clean += _extra_motion(model, level[:, 0], true_rate_hz, context, effects_rng)
    rms = noise * float(np.sqrt((clean**2).mean(axis=0)).mean())
    samples = clean + rms * rng.standard_normal(clean.shape)
    if ground is not None:
        ground = ground + rms * rng.standard_normal(n_samples)
    for effect in model.effects:
        samples = effect.measure(samples, true_rate_hz, context, effects_rng)
    rotation_rate = None
    if turning is not None:
        relative = moved[:, :n]
        if true_ground is not None:
            relative = relative - true_ground[:, None] * model.structure.rides
        rotation_rate = _integrated(relative @ turning.T, true_rate_hz)
        own_rms = noise * float(np.sqrt((rotation_rate**2).mean(axis=0)).mean())
        rotation_rate = rotation_rate + own_rms * effects_rng.standard_normal(rotation_rate.shape)
    return Motion(rate_hz, samples, ground, measured, rotation_rate)


def driven(
    effects: Sequence[Effect], forces: Array, rate_hz: float, structure: Structure
) -> Annotated[Array, "samples N"]:
    """Apply effects to the forces on the structure's degrees of freedom, N, in their order."""
    for effect in effects:
        forces = effect.drive(forces, rate_hz)
        for line in effect.lines():
            forces = forces.copy()
            turns = 2.0 * np.pi * line.frequency_hz / rate_hz * np.arange(len(forces))
            forces[:, place_index(line.location, structure)] += line.force_n * np.sin(turns)
    return forces


def _swept(model: Model, n: int, rate_hz: float) -> Annotated[Array, "n"]:
    """Compute the force of a shaker that sweeps once over the modes below half the rate, N."""
    hz = model.modes().frequencies_hz
    lowest, highest = 0.5 * hz[0], min(2.0 * hz[-1], 0.5 * rate_hz)
    octaves = np.log(highest / lowest)
    cycles = lowest * n / rate_hz / octaves * np.expm1(octaves * np.arange(n) / n)
    return np.asarray(np.sqrt(2.0) * _MEASURED_N * np.sin(2.0 * np.pi * cycles))


def _integrated(values: Annotated[Array, "samples k"], rate_hz: float) -> Array:
    """Integrate samples over time from rest, by cubic splines."""
    from scipy.interpolate import CubicSpline  # takes most of a second to load

    t_s = np.arange(len(values)) / rate_hz
    return np.asarray(CubicSpline(t_s, values).antiderivative()(t_s))


def own_forces(model: Model, level: Array, rate_hz: float, rng: np.random.Generator) -> Array:
    """Draw the random forces of the coupled modes, of 1 N times the excitation's level and the root of their force ratios."""
    ratios = np.array([mode.force_ratio for mode in linear_system(model).coupled])
    drawn = level[:, None] * rng.standard_normal((level.size, ratios.size)) * np.sqrt(ratios)
    return _coloured(model, drawn, rate_hz)


def _coloured(model: Model, forces: Array, rate_hz: float) -> Array:
    """Apply the colour of the floors' forces to other forces."""
    for effect in model.effects:
        if forces.size and np.ndim(effect.colour(np.ones(1))):
            forces = np.column_stack([effect.drive(column[:, None], rate_hz) for column in forces.T])
    return forces


def with_own_forces(model: Model, forces: Array, own: Array) -> Annotated[Array, "samples N"]:
    """Put the coupled modes' own forces beside those on the floors, each at its degree of freedom."""
    system = linear_system(model)
    if not system.coupled:
        return forces
    return np.asarray(np.hstack([forces, own]) @ system.forced(forces.shape[1]).T)


def channel_motion(
    model: Model,
    forces: Array,
    ground: Array | None,
    rate_hz: float,
    context: Context,
    excess_degc: Array | None = None,
    step_hz: float | None = None,
) -> Array:
    """Simulate the channels' true accelerations, m/s^2; the parameters are those of `respond`."""
    system = linear_system(model)
    moved = respond(model, forces, ground, rate_hz, excess_degc, step_hz, appended=bool(system.coupled))
    return _seen(moved, system, context)


def _seen(moved: Array, system: System, context: Context) -> Array:
    """Compute what the channels see of accelerations as `respond` gives them: with appended ones where modes are coupled."""
    return np.asarray(moved @ (system.sensors(context.sensors) if system.coupled else context.sensors).T)


def _extra_motion(
    model: Model, level: Annotated[Array, "samples"], rate_hz: float, context: Context, rng: np.random.Generator
) -> Array | float:
    """Simulate the channels' accelerations by extra modes, each under a force of its own of 1 N times the excitation's level."""
    out: Array | float = 0.0
    for mode in (m for effect in model.effects for m in effect.extra_modes(context)):
        force = _coloured(model, level[:, None] * rng.standard_normal((level.size, 1)), rate_hz)
        omega = 2.0 * np.pi * mode.frequency_hz
        alone = System(np.eye(1), np.full((1, 1), 2.0 * mode.damping_ratio * omega), np.full((1, 1), omega**2))
        from monitor.model.integration import march  # compiled code takes a while to load

        out = out + march(alone, 1, (), force, rate_hz, step_hz=rate_hz) * mode.shape
    return out


def respond(
    model: Model,
    forces: Annotated[Array, "samples n"],
    ground: Array | None,
    rate_hz: float,
    excess_degc: Array | None = None,
    step_hz: float | None = None,
    *,
    appended: bool = False,
) -> Annotated[Array, "samples n"]:
    """Simulate the floors' absolute accelerations (m/s^2) with all linear and nonlinear laws of the model.

    Forces are in N, the ground's acceleration in m/s^2 (None: at rest), temperatures above the reference in K.  `step_hz` is the
    least rate of the integration steps with nonlinear laws; `monitor.model.integration.STEP_HZ` by default.  If `appended`, the
    accelerations of the degrees of freedom that effects append are returned too; those of coupled modes relative to the ground.
    """
    if ground is not None:
        forces = _with_inertia(model, forces, ground)
    laws = [law for effect in model.effects for law in effect.laws(model.structure)]
    factors = [] if excess_degc is None else [e.stiffness_factor(excess_degc, rate_hz) for e in model.effects]
    changing = [f for f in factors if f is not None]
    if laws or changing:
        from monitor.model.integration import STEP_HZ, march  # compiled code takes a while to load

        factor = np.prod(changing, axis=0) if changing else None
        step_hz = STEP_HZ if step_hz is None else step_hz
        system, n = linear_system(model), model.structure.n_dofs
        floors = march(system, n, laws, forces, rate_hz, factor, step_hz, appended=appended)
    else:
        floors = respond_exactly(model, forces, rate_hz, appended=appended)
    if ground is None:
        return floors
    return np.asarray(floors + ground[:, None] * linear_system(model).rides[: floors.shape[1]])


def _with_inertia(model: Model, forces: Array, ground: Array) -> Array:
    """Add the inertia forces of the ground's acceleration to the forces."""
    inertia = linear_system(model).inertia
    padded = np.pad(forces, ((0, 0), (0, inertia.size - forces.shape[1])))
    return np.asarray(padded - ground[:, None] * inertia)


def _unmeasured_ground(
    model: Model, forces: Array, level: Array, rate_hz: float, context: Context, rng: np.random.Generator
) -> Array | None:
    """Draw the ground acceleration that causes the effects' share of the channels' variance, m/s^2.

    The variances are those of the linear model's response.
    """
    share = sum(e.ground_share for e in model.effects)
    if share <= 0.0:
        return None
    if share >= 1.0:
        names = ", ".join(dict.fromkeys(e.name for e in model.effects if e.ground_share))
        raise ValueError(f"{names}: shares add up to {share:g}, not below 1")
    ground = np.asarray(level * rng.standard_normal(level.size))
    response = respond_exactly(model, _with_inertia(model, np.zeros_like(forces), ground), rate_hz)
    response = response + ground[:, None] * model.structure.rides
    by_ground = ((response @ context.sensors.T) ** 2).mean(axis=0)
    by_force = ((respond_exactly(model, forces, rate_hz) @ context.sensors.T) ** 2).mean(axis=0)

    def excess(ln_power: float) -> float:
        part = np.exp(ln_power) * by_ground
        return float((part / (part + by_force)).mean()) - share

    middle = float(np.log(by_force.mean() / by_ground.mean()))
    return np.asarray(ground * np.exp(0.5 * brentq(excess, middle - 25.0, middle + 25.0)))
