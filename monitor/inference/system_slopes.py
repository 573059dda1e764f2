"""Slopes of the expected cross-spectra by coordinates that change the matrices of the linear system, its sensors or its forces.

The spectra at one frequency are ``S = Y Q Y^H`` with the response ``Y = T W B``, where W is the accelerance of all degrees of
freedom, T what the channels record of them, and B picks those on which forces act.  A change of the matrices by dM, dC and dK
changes the response by ``T W (dK / w^2 + i dC / w - dM) W B``.  So the solutions of one linear system for each frequency give
the slopes by all coordinates, where a finite difference solves it again for each of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from monitor.core import Array, ComplexArray, compiled
from monitor.inference.arrays import PackedSlopes
from monitor.inference.cross_spectra import (
    Band,
    accelerance,
    clock_ratio,
    extra_mode_response,
    force_colour,
    force_root,
    oscillator_response,
    recorded,
)
from monitor.model import Condition, Context, Effect, ExtraMode, System
from monitor.signals import leakage

_TAPS = leakage()
_ONE_FREQUENCY = 1e-6
"""Difference of two squared frequencies, over the largest of all, up to which they are one. [ratio; rounding]"""
_BLOCK = 64
"""Frequencies that are computed together. [count; cost]"""


@dataclass(frozen=True, eq=False, slots=True)
class SystemChange:
    """Slopes of a linear system by one coordinate."""

    mass: Annotated[Array, "N N"]
    damping: Annotated[Array, "N N"]
    stiffness: Annotated[Array, "N N"]
    sensors: Annotated[Array, "c N"]
    """Of what the channels see of the degrees of freedom."""
    forces: Annotated[Array, "columns columns"]
    """Of the force densities, see `force_matrix`."""
    modes: Annotated[Array, "2*extra c 3"]
    """Of the extra modes, see `extra_mode_changes`."""


Matrices = tuple[Annotated[Array, "N N"], Annotated[Array, "N N"], Annotated[Array, "N N"]]
"""Changes of mass, damping and stiffness."""


def modal_changes(
    system: System,
    ratios: Annotated[Array, "n"],
    by_mass: Annotated[Array, "q n n"],
    by_stiffness: Annotated[Array, "q n n"],
) -> tuple[Annotated[Array, "n n"], list[Matrices]] | None:
    """Differentiate a system made by `modally_damped`, by q changes of mass and stiffness, then by the ratios' logarithms.

    The changes are in the modes' coordinates, in which those by the ratios have one entry each.  The matrix before them turns
    them back: its product with a change and with its own transpose.  Where two modes have one frequency, their shapes have no
    slopes: None.

    References
    ----------
    R. L. Fox, M. P. Kapoor, AIAA Journal 6 (1968) 2426 (slopes of eigenvalues and eigenvectors).
    """
    eigenvalues, shapes = eigh(system.stiffness, system.mass)
    apart = eigenvalues - eigenvalues[:, None]
    np.fill_diagonal(apart, 1.0)
    if not eigenvalues[0] > 0.0 or np.abs(apart).min() < _ONE_FREQUENCY * eigenvalues[-1]:
        return None
    omega, at = np.sqrt(eigenvalues), np.arange(eigenvalues.size)
    damping = 2.0 * ratios * omega
    k, m = (shapes.T @ change @ shapes for change in (by_stiffness, by_mass))
    moved = k - eigenvalues * m  # of mode b along mode a
    turned = moved / apart
    turned[:, at, at] = -0.5 * m[:, at, at]
    half = (turned + m) * damping
    half[:, at, at] += 0.5 * ratios / omega * moved[:, at, at]
    changes = list(zip(m, half + half.swapaxes(1, 2), k, strict=True))
    none = np.zeros((at.size, at.size))
    changes += [(none, np.diag(np.where(at == i, damping, 0.0)), none) for i in at]
    return system.mass @ shapes, changes


def extra_mode_changes(
    modes: Sequence[ExtraMode], moved: Annotated[Array, "extra 2+c"]
) -> Annotated[Array, "2*extra c 3"]:
    """Differentiate the responses of extra modes by a change of their frequencies (Hz), damping ratios and shapes.

    The response of mode j is its shape times ``h = w^2 / (w^2 - w_j^2 - 2 i z_j w_j w)``.  Rows are factors of every mode's h,
    then of its square; the last axis has those of 1, of i / w and of 1 / w^2.
    """
    out = np.zeros((2, len(modes), moved.shape[1] - 2, 3))
    for of_response, of_square, mode, (hz, ratio, *shape) in zip(*out, modes, moved, strict=True):
        omega, by_omega = 2.0 * np.pi * mode.frequency_hz, 2.0 * np.pi * hz
        factors = 0.0, 2.0 * (mode.damping_ratio * by_omega + omega * ratio), 2.0 * omega * by_omega
        of_response[:, 0], of_square[:] = shape, np.outer(mode.shape, factors)
    return out.reshape(2 * len(modes), *out.shape[2:])


def force_matrix(system: System, effects: Sequence[Effect], force: Array, n_extra: int) -> Array:
    """Compute the densities (N^2/Hz) of all forces: on the floors, on the coupled modes and on the extra modes."""
    root, n, mean = force_root(force, effects), force.size, float(force.mean())
    out = np.diag(np.r_[force, [mean * mode.force_ratio for mode in system.coupled], np.full(n_extra, mean)])
    out[:n, :n] = root @ root.T
    acting = np.eye(len(out))
    for j, mode in enumerate(system.coupled):
        acting[n + j, :n] = mode.arms
    return np.asarray(acting @ out @ acting.T)


def system_slopes(
    system: System,
    effects: Sequence[Effect],
    force: Annotated[Array, "n"],
    changes: Sequence[SystemChange],
    band: Band,
    context: Context,
    condition: Condition,
    basis: Annotated[Array, "N N"] | None = None,
) -> PackedSlopes:
    """Differentiate the expected cross-spectra without ground motion, packed, by coordinates that change the system.

    Changes of its matrices, and none of its sensors, may be in other coordinates, see `modal_changes`.
    """
    clock = clock_ratio(effects)
    hz, size, n = clock * band.fine_hz, system.mass.shape[0], force.size
    omega, sensors, c = 2.0 * np.pi * hz, system.sensors(context.sensors), len(context.channels)
    forced = [*range(n), *(mode.index for mode in system.coupled)]
    # The matrices are symmetric, so the channels' responses to forces on all degrees of freedom are those to forces of the
    # channels' directions.  Degrees of freedom with next to no mass have no response of their own that is a number.
    columns = np.hstack([sensors.T, np.eye(size)[:, forced]])
    response = accelerance(system.mass, system.damping, system.stiffness, omega, columns)
    through = recorded(np.eye(c, dtype=complex)[None], effects, hz, context, condition)
    left = through @ response[:, :, :c].swapaxes(1, 2)
    modes = [mode for effect in effects for mode in effect.extra_modes(context)]
    answer = left[:, :, forced]
    if modes:
        answer = np.concatenate([answer, through @ extra_mode_response(modes, hz, context)], axis=2)
    adjoint = answer.conj().swapaxes(1, 2) * force_colour(effects, hz)[:, None, None]
    driven = force_matrix(system, effects, force, len(modes)) @ adjoint
    right = response[:, :, c:] @ driven[:, : len(forced)]
    alone = oscillator_response(modes, hz)[:, :, None]
    of_modes = driven[:, len(forced) :] * alone
    if basis is not None:
        left, right = left @ basis, basis.T @ right
    everything = np.concatenate([left, np.broadcast_to(through, (hz.size, c, c)), answer], axis=2)
    acting = np.concatenate([right, 0.5 * adjoint, of_modes, of_modes * alone], axis=1)
    start, at, of_matrices = _entries(changes, size, c)
    left_re, left_im, right_re, right_im = (
        np.ascontiguousarray(a.transpose(1, 2, 0)) for m in (everything, acting) for a in (m.real, m.imag)
    )
    return _sum_changes(left_re, left_im, right_re, right_im, 1.0 / omega, start, at, of_matrices, _TAPS, band.gain)


def _entries(changes: Sequence[SystemChange], size: int, c: int) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """List the entries of all changes that are not zero, ordered by change and by row of the right factor.

    Returned are the first entry of each change; the rows of the right factor and columns of the left one; and the factors of 1,
    of i / w and of 1 / w^2.
    """
    start, at, value = [0], [], []
    for change in changes:
        columns = change.forces.shape[0]
        of_matrices = np.zeros((size + columns + len(change.modes), size + c + columns, 3))
        of_matrices[:size, :size] = np.stack([-change.mass.T, change.damping.T, change.stiffness.T], axis=2)
        of_matrices[:size, size : size + c, 0] = change.sensors.T
        of_matrices[size : size + columns, size + c :, 0] = change.forces.T
        of_matrices[size + columns :, size : size + c] = change.modes
        where = np.argwhere(of_matrices.any(axis=2))
        at.append(where)
        value.append(of_matrices[where[:, 0], where[:, 1]])
        start.append(start[-1] + len(where))
    return np.array(start), np.concatenate(at), np.concatenate(value)


@compiled(error_model="numpy")
def _sum_changes(
    left_re: Annotated[Array, "c left fine"],
    left_im: Annotated[Array, "c left fine"],
    right_re: Annotated[Array, "right c fine"],
    right_im: Annotated[Array, "right c fine"],
    period: Annotated[Array, "fine"],
    start: NDArray[np.intp],
    at: NDArray[np.intp],
    value: Array,
    taps: Annotated[Array, "taps"],
    gain: Annotated[Array, "bins"],
) -> PackedSlopes:
    """Compute ``left dZ right`` and its adjoint for every change dZ, convolved with the taper's kernel into bins.

    `period` are the reciprocals of the angular frequencies, s/rad; `start`, `at` and `value` are those of `_entries`.
    """
    c, _, n_fine = left_re.shape
    n_bins = gain.size
    out = np.empty((start.size - 1, c * c, n_bins))
    fine, some = np.empty((c * c, n_fine)), np.empty((c * c, _BLOCK))
    v_re, v_im = np.empty((2, c, _BLOCK))
    z_re, z_im = np.empty((2, _BLOCK))
    for q in range(start.size - 1):
        for first in range(0, n_fine, _BLOCK):
            m = min(_BLOCK, n_fine - first)
            some[:] = 0.0
            e = start[q]
            while e < start[q + 1]:
                b = at[e, 0]
                v_re[:], v_im[:] = 0.0, 0.0
                while e < start[q + 1] and at[e, 0] == b:
                    a = at[e, 1]
                    for k in range(m):
                        z_re[k] = value[e, 0] + value[e, 2] * period[first + k] * period[first + k]
                        z_im[k] = value[e, 1] * period[first + k]
                    for i in range(c):
                        for k in range(m):
                            x, y = left_re[i, a, first + k], left_im[i, a, first + k]
                            v_re[i, k] += x * z_re[k] - y * z_im[k]
                            v_im[i, k] += x * z_im[k] + y * z_re[k]
                    e += 1
                _add_with_adjoint(v_re, v_im, right_re[b], right_im[b], first, m, some)
            fine[:, first : first + m] = some[:, :m]
        for row in range(c * c):
            for k in range(n_bins):
                total = 0.0
                for t in range(taps.size):
                    total += taps[t] * fine[row, 2 * k + t]
                out[q, row, k] = gain[k] * total
    return out


@compiled(part=True, error_model="numpy")
def _add_with_adjoint(v_re: Array, v_im: Array, w_re: Array, w_im: Array, first: int, m: int, out: Array) -> None:
    """Add the packed products of the columns v and the rows w, and their adjoints, of m frequencies from `first` on in w."""
    for i in range(v_re.shape[0]):
        for j in range(i):
            row = i * i + 2 * j
            for k in range(m):
                x, y, u, v = v_re[i, k], v_im[i, k], w_re[j, first + k], w_im[j, first + k]
                x_too, y_too, u_too, v_too = v_re[j, k], v_im[j, k], w_re[i, first + k], w_im[i, first + k]
                out[row, k] += x * u - y * v + (x_too * u_too - y_too * v_too)
                out[row + 1, k] += x * v + y * u - (x_too * v_too + y_too * u_too)
        for k in range(m):
            out[i * i + 2 * i, k] += 2.0 * (v_re[i, k] * w_re[i, first + k] - v_im[i, k] * w_im[i, first + k])


def packed(slopes: Annotated[ComplexArray, "... bins c c"]) -> Annotated[Array, "... c*c bins"]:
    """Pack Hermitian matrices as real numbers.

    Row by row of the lower triangle: real and imaginary parts before the diagonal, then the diagonal.
    """
    c = slopes.shape[-1]
    out = np.empty((*slopes.shape[:-3], c * c, slopes.shape[-3]))
    for i in range(c):
        out[..., i * i : i * i + 2 * i : 2, :] = np.moveaxis(slopes[..., i, :i].real, -1, -2)
        out[..., i * i + 1 : i * i + 2 * i : 2, :] = np.moveaxis(slopes[..., i, :i].imag, -1, -2)
        out[..., i * i + 2 * i, :] = slopes[..., i, i].real
    return out


def unpacked(rows: Annotated[Array, "... c*c bins"]) -> Annotated[ComplexArray, "... bins c c"]:
    """Invert `packed`."""
    c = round(np.sqrt(rows.shape[-2]))
    out = np.empty((*rows.shape[:-2], rows.shape[-1], c, c), dtype=complex)
    for i in range(c):
        below = np.moveaxis(
            rows[..., i * i : i * i + 2 * i : 2, :] + 1j * rows[..., i * i + 1 : i * i + 2 * i : 2, :], -2, -1
        )
        out[..., i, :i], out[..., :i, i], out[..., i, i] = below, below.conj(), rows[..., i * i + 2 * i, :]
    return out
