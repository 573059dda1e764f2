"""Steps a system with nonlinear laws: exact for its linear part, second order in what the laws add.

Within a step the forces run straight; so do the laws' forces, from those at its start to those at the predicted end
(the exponential trapezoidal rule).  Steps are shorter than a sample where samples are slow.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, exp

import numpy as np

from monitor.core import Array, ComplexArray, compiled
from monitor.model.effects import Law, LawKind, System

STEP_HZ = 4096.0
"""Least rate of steps. [Hz; accuracy of the integration]"""

_CUBIC, _CONTACT, _FRICTION = int(LawKind.CUBIC), int(LawKind.CONTACT), int(LawKind.FRICTION)
_TEMPERATURE_LAW = -1
"""Kind of law of a story whose stiffness follows the temperature. [index; definition]"""


@compiled(error_model="numpy")
def phi(kind: int, p0: float, p1: float, d: float, v: float) -> float:
    """Force of a law at displacement d and velocity v; `LawKind` says what the parameters are, each effect why.

    Here, not with the effects: a compiled function that calls one of another file is not compiled anew when that changes.
    """
    if kind == _CUBIC:
        faded = (d / p1) * (d / p1)
        return p0 * d * d * d / (1.0 + faded * faded)
    if kind == _CONTACT:
        closed = d > p0 if p0 >= 0.0 else d < p0
        return p1 * (d - p0) if closed else 0.0
    if kind == _FRICTION:
        return p0 * (1.0 - 2.0 / (1.0 + exp(2.0 * v / p1)))  # tanh, at a third of its time
    return p0 * v * abs(v)


def march(
    system: System,
    n: int,
    laws: Sequence[Law],
    forces: Array,
    rate_hz: float,
    factor: Array | None = None,
    step_hz: float = STEP_HZ,
) -> Array:
    """Accelerations of the structure's dofs, at rest before the first sample, shape (n_samples, n), m/s^2.

    Parameters
    ----------
    system : System
        The linear part, N dofs.
    n : int
        How many of them are the structure's.
    forces : ndarray, shape (n_samples, n to N), N
        Straight between samples.
    factor : ndarray, shape (n_samples,), optional
        On the stiffness of the structure's dofs.

    Notes
    -----
    Each of the linear part's complex modes makes a step by ``q1 = e^(p h) q0 + behind u0 + ahead u1``, where u is the force
    on it.  What warmth adds to the stiffness acts as one more law for each dof.
    """
    size, columns, substeps = system.mass.shape[0], forces.shape[1], max(1, ceil(step_hz / rate_hz))
    h = 1.0 / (rate_hz * substeps)
    poles, shapes, drive = system.decoupled()
    decay = np.exp(poles * h)
    held = np.expm1(poles * h) / poles
    ahead = (held - h) / (poles * h)
    acting = np.array([law.direction for law in laws]).reshape(-1, n)
    heard, kinds = acting, [int(law.kind) for law in laws]
    parameters = np.array([law.parameters for law in laws], dtype=np.float64).reshape(-1, 2)
    if factor is not None:
        acting, heard = np.vstack([acting, np.eye(n)]), np.vstack([acting, system.stiffness[:n, :n]])
        kinds, parameters = kinds + n * [_TEMPERATURE_LAW], np.vstack([parameters, np.zeros((n, 2))])
    given = np.linalg.inv(system.mass)[:n]
    moved = _march(
        decay,
        held - ahead,
        ahead,
        np.ascontiguousarray(drive[:, :columns]),
        drive[:, :n] @ acting.T,
        heard @ shapes[:n],
        heard @ shapes[size : size + n],
        poles * shapes[size : size + n],
        given[:, :n] @ acting.T,
        np.array(kinds, dtype=np.int64),
        parameters,
        np.ascontiguousarray(forces),
        np.zeros(0) if factor is None else factor - 1.0,
        substeps,
    )
    return np.asarray(moved + forces @ given[:, :columns].T)


def loaded() -> None:
    """Have the loop compiled, or read from the disk, in this process: else every process that it forks does so by itself."""
    march(System(np.eye(1), np.eye(1), np.eye(1)), 1, (), np.zeros((2, 1)), STEP_HZ)


@compiled(error_model="numpy")
def _march(
    decay: ComplexArray, behind: ComplexArray, ahead: ComplexArray, drive: ComplexArray, acting: ComplexArray,
    drift: ComplexArray, speed: ComplexArray, output: ComplexArray, direct: Array, kinds: Array, parameters: Array,
    forces: Array, excess: Array, substeps: int,
) -> Array:  # fmt: skip
    """Accelerations but for the forces' direct part, shape (n_samples, n).

    Parameters
    ----------
    decay, behind, ahead : ndarray, shape (m,)
        Of the m modes.
    drive, acting : ndarray, shape (m, columns), (m, q)
        Of the forces and of the q laws on the modes.
    drift, speed, output : ndarray, shape (q, m), (q, m), (n, m)
        The modes in what the laws hear and in the accelerations, as real parts.
    direct : ndarray, shape (n, q)
        Accelerations that the laws' forces cause at once.
    """
    m, q, columns, n = decay.size, kinds.size, forces.shape[1], output.shape[0]
    floors = np.empty((forces.shape[0], n))
    predicted, here, change, force = np.zeros((4, m), dtype=np.complex128)
    given, late, d, v = np.zeros((4, q))
    both, carried = np.empty((2, m, q), dtype=np.complex128)
    last = np.empty((m, q), dtype=np.complex128)
    for p in range(m):
        both[p], last[p] = (behind[p] + ahead[p]) * acting[p], ahead[p] * acting[p]
        carried[p] = decay[p] * last[p]
    own_drift, own_speed, own_output = (
        (drift @ last).real.copy(),
        (speed @ last).real.copy(),
        (output @ last).real.copy(),
    )
    warm = excess[0] if excess.size else 0.0
    for k in range(forces.shape[0]):
        for p in range(m):
            new = 0.0j
            for j in range(columns):
                new += drive[p, j] * forces[k, j]
            step = (new - force[p]) / substeps
            change[p] = (behind[p] + ahead[p]) * step
            here[p] = (behind[p] + ahead[p]) * force[p] + ahead[p] * step
            force[p] = new
        for s in range(substeps):
            if excess.size and k > 0:
                warm = excess[k - 1] + (s + 1.0) / substeps * (excess[k] - excess[k - 1])
            d[:], v[:] = 0.0, 0.0
            for p in range(m):
                state = decay[p] * predicted[p] + here[p]
                here[p] += change[p]
                for j in range(q):
                    state += carried[p, j] * late[j] + both[p, j] * given[j]
                    d[j] += drift[j, p].real * state.real - drift[j, p].imag * state.imag
                    v[j] += speed[j, p].real * state.real - speed[j, p].imag * state.imag
                predicted[p] = state
            for j in range(q):
                late[j] = -_force(kinds[j], parameters[j], warm, d[j], v[j]) - given[j]
            for j in range(q):
                for i in range(q):
                    d[j] += own_drift[j, i] * late[i]
                    v[j] += own_speed[j, i] * late[i]
                given[j] = -_force(kinds[j], parameters[j], warm, d[j], v[j])
        for i in range(n):
            total = 0.0
            for j in range(q):
                total += direct[i, j] * given[j] + own_output[i, j] * late[j]
            for p in range(m):
                total += output[i, p].real * predicted[p].real - output[i, p].imag * predicted[p].imag
            floors[k, i] = total
    return floors


@compiled(error_model="numpy")
def _force(kind: int, parameters: Array, warm: float, d: float, v: float) -> float:
    return warm * d if kind == _TEMPERATURE_LAW else phi(kind, parameters[0], parameters[1], d, v)
