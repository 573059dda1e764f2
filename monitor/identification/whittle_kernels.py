"""Compiled loops of the refinement (`whittle`)."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, ComplexArray, compiled


@compiled()
def pool_products(x: ComplexArray, first: NDArray[np.intp], sizes: NDArray[np.intp], out: ComplexArray) -> None:
    """Average the cross-spectra of one segment over pools of bins, given by first bin and size, packed into `out`."""
    c = x.shape[1]
    for p in range(first.size):
        begin, size = first[p], sizes[p]
        pair = 0
        for i in range(c):
            for j in range(i, c):
                total = 0j
                for k in range(begin, begin + size):
                    total += x[k, i] * np.conj(x[k, j])
                out[pair, p] = total / size
                pair += 1


@compiled()
def pack_columns(u: Array | ComplexArray, v: Annotated[ComplexArray, "pools c columns"]) -> ComplexArray:
    """Compute the upper triangles of ``u v^H + v u^H`` of every column; u may be the same for all pools."""
    pools, c, columns = v.shape
    out = np.empty((columns, c * (c + 1) // 2, pools), dtype=np.complex128)
    for p in range(pools):
        up, vp = u[p if len(u) > 1 else 0], v[p]
        pair = 0
        for i in range(c):
            for j in range(i, c):
                for k in range(columns):
                    out[k, pair, p] = up[i, k] * np.conj(vp[j, k]) + vp[i, k] * np.conj(up[j, k])
                pair += 1
    return out


@compiled(error_model="numpy", fastmath={"contract"})
def modal_products(w: Array, weights: Array, omega: Array, damping: Array, colour: Array) -> ComplexArray:
    """Compute the products of modal transfer functions g of acceleration, and of their derivatives, with every conjugate g.

    g includes the amplitude of the forces' spectrum, whose tilt and curvature are `colour`.  The five are of g itself, then of
    its derivatives by ln omega, ln damping, tilt and curvature.  `w` has a row of taps a pool, rad/s, whose sum has `weights`.
    """
    (pools, taps), m = w.shape, omega.size
    out, each, middle = np.zeros((pools, 5, m, m), dtype=np.complex128), np.empty((5, m), dtype=np.complex128), w.mean()
    for p in range(pools):
        for tap in range(taps):
            at = w[p, tap]
            x = np.log(at / middle)
            amplitude = -(at**2) * np.exp(colour[0] * x + colour[1] * x**2)
            for k in range(m):
                cross = 2j * damping[k] * omega[k] * at
                response = 1.0 / (omega[k] ** 2 - at**2 + cross)
                g = amplitude * response
                slope = g * response
                each[0, k], each[3, k], each[4, k] = g, g * x, g * x**2
                each[1, k], each[2, k] = -slope * (2.0 * omega[k] ** 2 + cross), -slope * cross
            for s in range(5):
                for k in range(m):
                    weighed = weights[tap] * each[s, k]
                    for other in range(m):
                        out[p, s, k, other] += weighed * np.conj(each[0, other])
    return out


@compiled(error_model="numpy")
def inverses(matrices: Annotated[ComplexArray, "n c c"]) -> ComplexArray:
    """Invert Hermitian matrices; the inverse is not finite where a pivot vanishes."""
    n, c, _ = matrices.shape
    a, out = matrices.copy(), np.zeros((n, c, c), dtype=np.complex128)
    for k in range(n):
        for i in range(c):
            out[k, i, i] = 1.0
        for p in range(c):  # Gauss-Jordan; definite matrices need no exchange of pivots
            scale = 1.0 / a[k, p, p].real
            for j in range(c):
                a[k, p, j] *= scale
                out[k, p, j] *= scale
            for i in range(c):
                factor = a[k, i, p]
                if i == p or factor == 0.0:
                    continue
                for j in range(c):
                    a[k, i, j] -= factor * a[k, p, j]
                    out[k, i, j] -= factor * out[k, p, j]
    return out
