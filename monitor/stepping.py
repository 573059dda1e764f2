"""Steps a system with nonlinear laws: exact for its linear part, second order in what the laws add.

Within a step the forces run straight; so do the laws' forces, from those at its start to those at the predicted end
(the exponential trapezoidal rule).  Steps are shorter than a sample where samples are slow.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, tanh

import numpy as np
from scipy.linalg import expm

from monitor.compiled import compiled
from monitor.effects import Law, LawKind, System
from monitor.results import Array

STEP_HZ = 4096.0
"""Least rate of steps."""

_CUBIC, _CONTACT, _FRICTION = int(LawKind.CUBIC), int(LawKind.CONTACT), int(LawKind.FRICTION)


@compiled()
def phi(kind: int, p0: float, p1: float, d: float, v: float) -> float:
    """Force of a law at displacement d and velocity v; `LawKind` says what the parameters are, each effect why.

    Here, not with the effects: a compiled function that calls one of another file is not compiled anew when that changes.
    """
    if kind == _CUBIC:
        return p0 * d * d * d / (1.0 + (d / p1) ** 4)
    if kind == _CONTACT:
        closed = d > p0 if p0 >= 0.0 else d < p0
        return p1 * (d - p0) if closed else 0.0
    if kind == _FRICTION:
        return p0 * tanh(v / p1)
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
    With A, B of the linear part, ``z1 = e^(A h) z0 + G0 u0 + G1 u1``; the three matrices are blocks of one matrix
    exponential (C. F. Van Loan, IEEE Trans. Automat. Control 23 (1978) 395).
    """
    size, substeps = system.mass.shape[0], max(1, ceil(step_hz / rate_hz))
    minv = np.linalg.inv(system.mass)
    rows = np.hstack([-minv @ system.stiffness, -minv @ system.damping])
    block = np.zeros((4 * size, 4 * size))
    block[:size, size : 2 * size] = np.eye(size)
    block[size : 2 * size, : 2 * size] = rows
    block[size : 2 * size, 2 * size : 3 * size] = minv
    block[: 2 * size] /= rate_hz * substeps
    block[2 * size : 3 * size, 3 * size :] = np.eye(size)
    exponential = expm(block)[: 2 * size]
    ahead = np.ascontiguousarray(exponential[:, 3 * size :])
    directions = np.zeros((len(laws), size))
    for direction, law in zip(directions, laws, strict=True):
        direction[:n] = law.direction
    stiffness = np.zeros((size, size))
    stiffness[:n, :n] = system.stiffness[:n, :n]
    return _march(
        np.ascontiguousarray(exponential[:, : 2 * size]),
        np.ascontiguousarray(exponential[:, 2 * size : 3 * size] - ahead),
        ahead,
        np.hstack([rows, minv]),
        np.array([int(law.kind) for law in laws], dtype=np.int64),
        directions,
        np.array([law.parameters for law in laws], dtype=np.float64).reshape(-1, 2),
        stiffness,
        np.ascontiguousarray(forces),
        np.zeros(0) if factor is None else factor - 1.0,
        substeps,
        n,
    )


@compiled()
def _march(
    decay: Array, behind: Array, ahead: Array, output: Array, kinds: Array, directions: Array, parameters: Array,
    stiffness: Array, forces: Array, excess: Array, substeps: int, n: int,
) -> Array:  # fmt: skip
    size, columns = ahead.shape[1], forces.shape[1]
    floors = np.empty((forces.shape[0], n))
    state, moved = np.zeros(2 * size), np.zeros(2 * size)
    start, end, given, predicted = np.zeros(size), np.zeros(size), np.zeros(size), np.zeros(size)
    warm = excess[0] if excess.size else 0.0
    for k in range(forces.shape[0]):
        for s in range(substeps):
            part = (s + 1.0) / substeps
            for i in range(columns):
                before = forces[k - 1, i] if k > 0 else 0.0
                end[i] = before + part * (forces[k, i] - before)
            if excess.size and k > 0:
                warm = excess[k - 1] + part * (excess[k] - excess[k - 1])
            for i in range(2 * size):
                total = 0.0
                for j in range(2 * size):
                    total += decay[i, j] * state[j]
                for j in range(size):
                    total += behind[i, j] * (start[j] + given[j]) + ahead[i, j] * (end[j] + given[j])
                moved[i] = total
            _reaction(moved, kinds, directions, parameters, stiffness, warm, predicted)
            for i in range(2 * size):
                total = moved[i]
                for j in range(size):
                    total += ahead[i, j] * (predicted[j] - given[j])
                state[i] = total
            _reaction(state, kinds, directions, parameters, stiffness, warm, given)
            for i in range(size):
                start[i] = end[i]
        for i in range(n):
            total = 0.0
            for j in range(2 * size):
                total += output[i, j] * state[j]
            for j in range(size):
                total += output[i, 2 * size + j] * (end[j] + given[j])
            floors[k, i] = total
    return floors


@compiled()
def _reaction(
    state: Array, kinds: Array, directions: Array, parameters: Array, stiffness: Array, warm: float, out: Array
) -> None:
    """Force of the laws and of the stiffness that warmth adds, on every dof."""
    size = out.size
    for i in range(size):
        out[i] = 0.0
    for q in range(kinds.size):
        d, v = 0.0, 0.0
        for j in range(size):
            d += directions[q, j] * state[j]
            v += directions[q, j] * state[size + j]
        force = phi(kinds[q], parameters[q, 0], parameters[q, 1], d, v)
        for j in range(size):
            out[j] -= directions[q, j] * force
    if warm != 0.0:
        for i in range(size):
            for j in range(size):
                out[i] -= warm * stiffness[i, j] * state[j]
