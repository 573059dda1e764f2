"""Integrates a Model in time: recordings with known truth.

Two integrators for linear models, both recursions run as compiled IIR filters: the exact discretisation (force linear
between samples, so that nothing is delayed) for everything of ours, and Newmark's average acceleration at the paper's
steps for `reproduce`, which lengthens periods to ``f_N = atan(pi f dt) / (pi dt)``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.signal import lfilter

from monitor.model import Model
from monitor.results import Array

ExcitationKind = Literal["ambient", "impulse", "ground"]


@dataclass(frozen=True, eq=False, slots=True)
class Motion:
    """What the sensors of a simulated structure saw."""

    rate_hz: float
    floors: Array
    """Absolute accelerations, shape (n_samples, n), m/s^2."""
    ground: Array | None
    """Ground acceleration, shape (n_samples,), m/s^2."""


def respond_exactly(model: Model, forces: Array, rate_hz: float) -> Array:
    """Accelerations of the floors under forces that run straight between samples.

    Parameters
    ----------
    forces : ndarray, shape (n_samples, n), N
    rate_hz : float

    Returns
    -------
    ndarray, shape (n_samples, n), m/s^2
        Relative to the ground; at rest before the first sample.

    Notes
    -----
    The complex modes of the state matrix decouple it into n first-order recursions (one of each conjugate pair).
    """
    n, dt = forces.shape[1], 1.0 / rate_hz
    minv = np.linalg.inv(model.mass_matrix())
    dynamics = np.block(
        [
            [np.zeros((n, n)), np.eye(n)],
            [-minv @ model.stiffness_matrix(), -minv @ model.damping_matrix()],
        ]
    )
    poles, vectors = np.linalg.eig(dynamics)
    drive = np.linalg.solve(vectors, np.vstack([np.zeros((n, n)), minv]).astype(complex))
    output = dynamics[n:].astype(complex) @ vectors
    accelerations = forces @ minv.T
    for q in np.flatnonzero(poles.imag >= 0):
        decay = np.exp(poles[q] * dt)
        held = (decay - 1.0) / poles[q]
        ahead = (decay - 1.0 - poles[q] * dt) / (poles[q] ** 2 * dt)  # share of the force at the step's end
        state = lfilter([ahead, held - ahead], [1.0, -decay], forces @ drive[q])
        pair = 2.0 if poles[q].imag > 0 else 1.0  # its conjugate gives the same again
        accelerations += pair * (state[:, None] * output[:, q]).real
    return np.asarray(accelerations)


def respond_newmark(model: Model, forces: Array, rate_hz: float) -> Array:
    """Accelerations of the floors by Newmark's average-acceleration method (gamma 1/2, beta 1/4).

    Parameters and return value as `respond_exactly`.  In modal coordinates of a classically damped model the method
    is the bilinear transform of ``s^2 / (s^2 + 2 zeta w s + w^2)``.
    """
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
    """A slowly wandering level with mean square 1: log-normal, correlated over 60 s, shape (n,)."""
    if spread == 0.0:
        return np.ones(n)
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
) -> Motion:
    """A recording's worth of motion.

    Parameters
    ----------
    excitation : {"ambient", "impulse", "ground"}
        Independent white forces of 1 N on every floor; a hammer blow on the middle floor every 10 s; a white ground
        acceleration of 0.5 m/s^2.
    noise : float
        Sensor noise, white at `rate_hz`, as a fraction of the mean over channels of the acceleration's RMS, the same
        on every channel.
    level_spread : float
        Relative spread of the excitation's slowly wandering level (0.35 for wind).
    """
    rng = np.random.default_rng(seed)
    n_samples, n = round(duration_s * rate_hz), model.structure.n_stories
    level = level_wander(n_samples, rate_hz, level_spread, rng)[:, None]
    ground = None
    if excitation == "ambient":
        forces = level * rng.standard_normal((n_samples, n))
    elif excitation == "impulse":
        forces = np.zeros((n_samples, n))
        forces[:: max(1, round(10.0 * rate_hz)), n // 2] = rate_hz  # 1 N s within one sample
    else:
        ground = 0.5 * level[:, 0] * rng.standard_normal(n_samples)
        forces = -ground[:, None] * model.mass_matrix().sum(axis=1)
    floors = respond_exactly(model, forces, rate_hz)
    if ground is not None:
        floors = floors + ground[:, None]
    rms = noise * float(np.sqrt((floors**2).mean(axis=0)).mean())
    floors = floors + rms * rng.standard_normal(floors.shape)
    if ground is not None:
        ground = ground + rms * rng.standard_normal(n_samples)
    return Motion(rate_hz, floors, ground)
