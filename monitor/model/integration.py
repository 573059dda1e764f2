"""Time integration of a system with nonlinear laws: exact for its linear part, second order in the laws' forces.

Within a step the applied forces are linear in time.  So are the laws' forces, between their values at the start of the step
and at its predicted end (the exponential trapezoidal rule).  Steps are shorter than a sample where the sampling rate is low.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, exp, tanh
from typing import Annotated

import numpy as np

from monitor.core import Array, ComplexArray, compiled
from monitor.model.effects import Law, LawKind, System

STEP_HZ = 4096.0
"""Least rate of steps. [Hz; accuracy of the integration]"""

_CUBIC, _CONTACT, _FRICTION = int(LawKind.CUBIC), int(LawKind.CONTACT), int(LawKind.FRICTION)
_SLIP = int(LawKind.SLIP)
_SMALL = 0.2
"""Argument up to which five terms of the continued fraction of the hyperbolic tangent are exact to 1e-14. [1; rounding]"""
_TEMPERATURE_LAW = -1
"""Kind of law of a story whose stiffness follows the temperature. [index; definition]"""


@compiled(part=True, error_model="numpy")
def phi(kind: int, p0: float, p1: float, d: float, v: float) -> float:
    """Evaluate the force of a nonlinear law at displacement d and velocity v.

    `LawKind` defines the parameters p0 and p1; each effect gives their reasons.  The function is in this file, not with the
    effects, since a compiled function that calls one of another file is not compiled again when that file changes.
    """
    if kind == _CUBIC:
        squared = (d / p1) * (d / p1)
        return p0 * d * d * d / (1.0 + squared * squared)
    if kind == _CONTACT:
        closed = d > p0 if p0 >= 0.0 else d < p0
        return p1 * (d - p0) if closed else 0.0
    if kind == _FRICTION:
        return p0 * (1.0 - 2.0 / (1.0 + exp(2.0 * v / p1)))  # tanh, at a third of its time
    if kind == _SLIP:
        return p0 * (slipped(0.0, d / p1) - d / p1)  # from rest
    return p0 * v * abs(v)


@compiled(part=True, error_model="numpy")
def slipped(z: float, moved: float) -> float:
    """Move a hysteretic element from the force z, over its largest, by a drift, over that at slip; return the new force.

    Unloaded, the force follows the drift.  Loaded, the solution of ``dz = (1 - z^2) dd`` is a hyperbolic tangent.
    """
    way, sign = abs(moved), 1.0 if moved > 0.0 else -1.0
    along = sign * z
    if along < 0.0:
        if way <= -along:
            return z + moved
        way, along = way + along, 0.0
    more = _tanh(way)
    return sign * (along + more) / (1.0 + along * more)  # the addition theorem of the hyperbolic tangent


@compiled(part=True, error_model="numpy")
def _tanh(x: float) -> float:
    """Compute the hyperbolic tangent of x >= 0; of the small x of a step by the continued fraction, which is faster."""
    if x > _SMALL:
        return tanh(x)
    squared = x * x
    return x * (945.0 + squared * (105.0 + squared)) / (945.0 + squared * (420.0 + 15.0 * squared))


def march(
    system: System,
    n: int,
    laws: Sequence[Law],
    forces: Array,
    rate_hz: float,
    factor: Array | None = None,
    step_hz: float = STEP_HZ,
    *,
    appended: bool = False,
) -> Annotated[Array, "samples n"]:
    """Integrate the accelerations of the structure's degrees of freedom, m/s^2, from rest before the first sample.

    A step of each complex mode of the linear part is ``q1 = e^(p h) q0 + behind u0 + ahead u1``, where u is the modal force.
    The stiffness that temperature adds acts as one more law for each degree of freedom.

    The system is the linear part, N degrees of freedom, of which the first n are the structure's.  The applied forces, N, act
    on the first n to N of them, and are linear in time between samples.  `factor` is the factor on the stiffness of the
    structure's degrees of freedom at every sample, `step_hz` the least rate of the integration steps.  If `appended`, the
    accelerations of the degrees of freedom that effects add are returned too.
    """
    size, columns, substeps = system.mass.shape[0], forces.shape[1], max(1, ceil(step_hz / rate_hz))
    h = 1.0 / (rate_hz * substeps)
    poles, shapes, drive = system.decoupled()
    decay = np.exp(poles * h)
    constant = np.expm1(poles * h) / poles  # response to a force that is constant within the step
    ahead = (constant - h) / (poles * h)
    acting = np.array([law.direction for law in laws]).reshape(-1, n)
    sensing, kinds = acting, [int(law.kind) for law in laws]
    parameters = np.array([law.parameters for law in laws], dtype=np.float64).reshape(-1, 2)
    if factor is not None:
        acting, sensing = np.vstack([acting, np.eye(n)]), np.vstack([acting, system.stiffness[:n, :n]])
        kinds, parameters = kinds + n * [_TEMPERATURE_LAW], np.vstack([parameters, np.zeros((n, 2))])
    rows = size if appended else n
    inverse_mass = np.linalg.inv(system.mass)[:rows]
    moved = _march(
        decay,
        constant - ahead,
        ahead,
        np.ascontiguousarray(drive[:, :columns]),
        drive[:, :n] @ acting.T,
        sensing @ shapes[:n],
        sensing @ shapes[size : size + n],
        poles * shapes[size : size + rows],
        inverse_mass[:, :n] @ acting.T,
        np.array(kinds, dtype=np.int64),
        parameters,
        np.ascontiguousarray(forces),
        np.zeros(0) if factor is None else factor - 1.0,
        substeps,
    )
    return np.asarray(moved + forces @ inverse_mass[:, :columns].T)


def loaded() -> None:
    """Compile the integration loop, or read it from the disk, in this process.

    Otherwise every process that this process forks would do so by itself.
    """
    march(System(np.eye(1), np.eye(1), np.eye(1)), 1, (), np.zeros((2, 1)), STEP_HZ)


@compiled(error_model="numpy")
def _march(
    decay: ComplexArray, behind: ComplexArray, ahead: ComplexArray, drive: ComplexArray, acting: ComplexArray,
    drift: ComplexArray, speed: ComplexArray, output: ComplexArray, direct: Array, kinds: Array, parameters: Array,
    forces: Array, excess: Array, substeps: int,
) -> Array:  # fmt: skip
    """Integrate the accelerations without the direct part of the applied forces, m/s^2.

    `decay`, `behind` and `ahead` are the coefficients of a step of the m modes, `drive` and `acting` the modal forces of the
    applied forces and of the q laws.  The product of `drift`, `speed` and `output` with the modal coordinates has as its real
    part the displacements and velocities on which the laws depend, and the accelerations; `direct` are accelerations that the
    laws' forces cause at once.  `excess` is the factor on the stiffness less one; empty where the stiffness is constant.
    """
    m, q, columns, n = decay.size, kinds.size, forces.shape[1], output.shape[0]
    floors = np.empty((forces.shape[0], n))
    predicted, pending, change, force = np.zeros((4, m), dtype=np.complex128)
    law_force, force_change, d, v = np.zeros((4, q))
    # Force of each hysteretic law over its largest, and displacement, at the start of the step.
    held, before = np.zeros((2, q))
    both, carried = np.empty((2, m, q), dtype=np.complex128)
    last = np.empty((m, q), dtype=np.complex128)
    for p in range(m):
        both[p], last[p] = (behind[p] + ahead[p]) * acting[p], ahead[p] * acting[p]
        carried[p] = decay[p] * last[p]
    own_drift, own_speed = (drift @ last).real.copy(), (speed @ last).real.copy()
    own_output = (output @ last).real.copy()
    stiffness_excess = excess[0] if excess.size else 0.0
    for k in range(forces.shape[0]):
        for p in range(m):
            new = 0.0j
            for j in range(columns):
                new += drive[p, j] * forces[k, j]
            step = (new - force[p]) / substeps
            change[p] = (behind[p] + ahead[p]) * step
            pending[p] = (behind[p] + ahead[p]) * force[p] + ahead[p] * step
            force[p] = new
        for s in range(substeps):
            if excess.size and k > 0:
                stiffness_excess = excess[k - 1] + (s + 1.0) / substeps * (excess[k] - excess[k - 1])
            d[:], v[:] = 0.0, 0.0
            for p in range(m):
                state = decay[p] * predicted[p] + pending[p]
                pending[p] += change[p]
                for j in range(q):
                    state += carried[p, j] * force_change[j] + both[p, j] * law_force[j]
                for j in range(q):
                    d[j] += drift[j, p].real * state.real - drift[j, p].imag * state.imag
                    v[j] += speed[j, p].real * state.real - speed[j, p].imag * state.imag
                predicted[p] = state
            for j in range(q):
                own = _force(kinds[j], parameters[j], stiffness_excess, d[j], v[j], held[j], before[j])
                force_change[j] = -own - law_force[j]
            for j in range(q):
                for i in range(q):
                    d[j] += own_drift[j, i] * force_change[i]
                    v[j] += own_speed[j, i] * force_change[i]
                own = _force(kinds[j], parameters[j], stiffness_excess, d[j], v[j], held[j], before[j])
                law_force[j] = -own
                if kinds[j] == _SLIP:
                    held[j] = own / parameters[j, 0] + d[j] / parameters[j, 1]
                    before[j] = d[j]
        for i in range(n):
            total = 0.0
            for j in range(q):
                total += direct[i, j] * law_force[j] + own_output[i, j] * force_change[j]
            for p in range(m):
                total += output[i, p].real * predicted[p].real - output[i, p].imag * predicted[p].imag
            floors[k, i] = total
    return floors


@compiled(part=True, error_model="numpy")
def _force(
    kind: int, parameters: Array, stiffness_excess: float, d: float, v: float, held: float, before: float
) -> float:
    """Evaluate the force of a law, or that of the stiffness that temperature adds.

    `held` and `before` are the force of a hysteretic law over its largest, and its displacement, at the start of the step.
    """
    if kind == _TEMPERATURE_LAW:
        return stiffness_excess * d
    if kind == _SLIP:
        return float(parameters[0] * (slipped(held, (d - before) / parameters[1]) - d / parameters[1]))
    return float(phi(kind, parameters[0], parameters[1], d, v))
