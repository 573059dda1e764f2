"""Eigenvalues and vectors of small matrices in Hessenberg form, without the rest that LAPACK would give.

A window asks some fifteen matrices for their poles, of which those above the real axis and a few rows of the eigenvectors are
looked at.  After LAPACK's reduction to Hessenberg form (zero below the first subdiagonal) the double-shift QR iteration acts on
what is not yet split off alone, for it need not keep the triangular form, and a vector follows from one solution with its pole as
shift.  Of a symmetric one, whose form is tridiagonal, the leading vectors are wanted alone.

References
----------
G. H. Golub, C. F. Van Loan, Matrix Computations, 4th ed., 2013, sections 7.5 and 7.6.  I. S. Dhillon, B. N. Parlett, Multiple
representations to compute orthogonal eigenvectors of symmetric tridiagonal matrices, Linear Algebra and its Applications 387
(2004) 1-28.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import lapack

from monitor.compiled import compiled
from monitor.results import Array, ComplexArray

_EPS = 2.0**-52
_TINY = 1e-290
"""Instead of a pivot that vanishes."""
_NEAR = 1e-5
"""Distance of two values, over the largest, within which their vectors mix."""
_MOST_SWEEPS = 60
_LEAST_GROWTH = 1e10
"""Of a solution with a pole as shift over the right side: the vector's residual is its inverse, times the order."""


def upper_poles(a: Array, c: Array) -> tuple[ComplexArray, ComplexArray]:
    """Eigenvalues of `a` above the real axis, shape (m,), and `c` times their eigenvectors, of any scale, shape (m, l).

    Parameters
    ----------
    a : ndarray, shape (n, n)
    c : ndarray, shape (l, n)
    """
    reduced, scales, _ = lapack.dgehrd(a)
    values, shapes, sound = _upper_poles(reduced.T, scales, c)
    if sound:
        return values, shapes
    values, vectors = np.linalg.eig(a)
    above = values.imag > 0
    return values[above], (c @ vectors[:, above]).T


@compiled(error_model="numpy", fastmath={"contract"})
def _upper_poles(reduced_t: Array, scales: Array, c: Array) -> tuple[ComplexArray, ComplexArray, bool]:
    """As `upper_poles`, from the transposed result of dgehrd; and whether it succeeded."""
    n, l = reduced_t.shape[0], c.shape[0]  # noqa: E741 - the paper's letters
    h, turned = np.zeros((n, n)), c.copy()
    for i in range(n):
        for j in range(max(i - 1, 0), n):
            h[i, j] = reduced_t[j, i]
    for k in range(n - 2):  # C times the reflections that reduced A
        for i in range(l):
            total = turned[i, k + 1]
            for j in range(k + 2, n):
                total += reduced_t[k, j] * turned[i, j]
            total *= scales[k]
            turned[i, k + 1] -= total
            for j in range(k + 2, n):
                turned[i, j] -= total * reduced_t[k, j]
    values = _eigenvalues(h)
    sound = not np.isnan(values[0])
    values = values[values.imag > 0.0]
    shapes = np.empty((values.size, l), dtype=np.complex128)
    u, x = np.empty((n, n), dtype=np.complex128), np.empty(n, dtype=np.complex128)
    for k in range(values.size):
        sound = _vector(h, values[k], u, x) and sound
        for i in range(l):
            total = 0j
            for j in range(n):
                total += turned[i, j] * x[j]
            shapes[k, i] = total
    return values, shapes, sound


@compiled(error_model="numpy", fastmath={"contract"})
def _eigenvalues(hessenberg: Array) -> ComplexArray:
    """All eigenvalues, shape (n,); not a number if they do not converge."""
    n = hessenberg.shape[0]
    h, values = np.zeros((n + 1, n + 1)), np.empty(n, dtype=np.complex128)  # room for a reflection of three at the end
    h[:n, :n] = hessenberg
    end, sweeps = n - 1, 0
    while end >= 0:
        begin = end  # of the block that ends at `end` and does not fall apart
        while begin > 0 and abs(h[begin, begin - 1]) > _EPS * (abs(h[begin - 1, begin - 1]) + abs(h[begin, begin])):
            begin -= 1
        if begin == end:
            values[end] = h[end, end]
            end, sweeps = end - 1, 0
        elif begin == end - 1:
            half, product = 0.5 * (h[begin, begin] - h[end, end]), h[end, begin] * h[begin, end]
            root = np.sqrt(complex(half * half + product))
            values[begin], values[end] = h[end, end] + half + root, h[end, end] + half - root
            end, sweeps = end - 2, 0
        elif sweeps == _MOST_SWEEPS:
            values[:] = np.nan
            return values
        else:
            sweeps += 1
            _sweep(h, begin, end, sweeps % 10 == 0)
    return values


@compiled(error_model="numpy", fastmath={"contract"})
def _sweep(h: Array, begin: int, end: int, stuck: bool) -> None:
    """One double-shift QR step on the block from `begin` to `end`, in place."""
    x, y, product = h[end, end], h[end - 1, end - 1], h[end, end - 1] * h[end - 1, end]
    if stuck:  # other shifts leave a cycle
        size = abs(h[end, end - 1]) + abs(h[end - 1, end - 2])
        x = y = h[end, end] + 0.75 * size
        product = -0.4375 * size * size
    first = end - 2
    while True:  # the step may begin below two small subdiagonals in a row
        z = h[first, first]
        p = ((x - z) * (y - z) - product) / h[first + 1, first] + h[first, first + 1]
        q, r = h[first + 1, first + 1] + z - x - y, h[first + 2, first + 1]
        if first == begin:
            break
        around = abs(h[first - 1, first - 1]) + abs(z) + abs(h[first + 1, first + 1])
        if abs(h[first, first - 1]) * (abs(q) + abs(r)) <= _EPS * abs(p) * around:
            h[first, first - 1] *= -1.0
            break
        first -= 1
    for k in range(first, end):
        if k > first:
            p, q, r = h[k, k - 1], h[k + 1, k - 1], h[k + 2, k - 1]
        size = np.sqrt(p * p + q * q + r * r)
        if size == 0.0:
            continue
        size = -size if p < 0.0 else size
        if k > first:
            h[k, k - 1], h[k + 1, k - 1], h[k + 2, k - 1] = -size, 0.0, 0.0
        p += size  # the reflection is 1 - (u, v, w)^T (1, q, r)
        u, v, w, q, r = p / size, q / size, r / size, q / p, r / p
        above, row, below = h[k], h[k + 1], h[k + 2]
        for j in range(k, end + 1):
            total = above[j] + q * row[j] + r * below[j]
            above[j] -= total * u
            row[j] -= total * v
            below[j] -= total * w
        for i in range(begin, min(end, k + 3) + 1):
            total = u * h[i, k] + v * h[i, k + 1] + w * h[i, k + 2]
            h[i, k] -= total
            h[i, k + 1] -= total * q
            h[i, k + 2] -= total * r


@compiled(error_model="numpy", fastmath={"contract"})
def _vector(h: Array, pole: complex, u: ComplexArray, x: ComplexArray) -> bool:
    """Eigenvector of `h` into `x`, of any scale, by one step of inverse iteration; `u` is room.  False if it did not grow."""
    n = h.shape[0]
    norm = 0.0
    for j in range(n):
        norm = max(norm, abs(h[0, j]))
        u[0, j] = h[0, j]
    u[0, 0] -= pole
    for k in range(
        n - 1
    ):  # Gaussian elimination of h - pole; a row is exchanged with the next where that has the larger pivot
        beside = h[k + 1, k]
        norm = max(norm, abs(beside))
        for j in range(k + 1, n):
            u[k + 1, j] = h[k + 1, j]
        u[k + 1, k + 1] -= pole
        if abs(u[k, k].real) + abs(u[k, k].imag) >= abs(beside):
            if beside != 0.0:
                factor = beside / u[k, k]
                for j in range(k + 1, n):
                    u[k + 1, j] -= factor * u[k, j]
        else:
            factor = u[k, k] / beside
            u[k, k] = beside
            for j in range(k + 1, n):
                lower = u[k + 1, j]
                u[k + 1, j] = u[k, j] - factor * lower
                u[k, j] = lower
    growth = 0.0
    for i in range(n - 1, -1, -1):
        total = 1.0 + 0j
        for j in range(i + 1, n):
            total -= u[i, j] * x[j]
        pivot = u[i, i]
        if abs(pivot.real) + abs(pivot.imag) < _EPS * norm:
            pivot = complex(_EPS * norm)
        x[i] = total / pivot
        growth = max(growth, abs(x[i].real) + abs(x[i].imag))
    return growth * norm >= _LEAST_GROWTH


@compiled(error_model="numpy")
def tridiagonal_vectors(diagonal: Array, beside: Array, values: Array) -> Array:
    """Unit eigenvectors of a symmetric tridiagonal matrix for known eigenvalues, as rows, shape (m, n).

    Each follows from the factors of the shifted matrix from the top and from the bottom, joined where they tell it best.  It is
    as good as rounding over the distance to the next value; what that leaves in it of the vectors of near values is taken off.

    Parameters
    ----------
    diagonal : ndarray, shape (n,)
    beside : ndarray, shape (n - 1,)
    values : ndarray, shape (m,)
        In order.
    """
    n, near = diagonal.size, _NEAR * np.abs(values).max()
    out, down, up = np.empty((values.size, n)), np.empty(n), np.empty(n)
    for k in range(values.size):
        down[0], up[n - 1] = diagonal[0] - values[k], diagonal[n - 1] - values[k]
        for i in range(1, n):
            down[i - 1] = down[i - 1] or _TINY
            down[i] = diagonal[i] - values[k] - beside[i - 1] ** 2 / down[i - 1]
        for i in range(n - 2, -1, -1):
            up[i + 1] = up[i + 1] or _TINY
            up[i] = diagonal[i] - values[k] - beside[i] ** 2 / up[i + 1]
        joint, least = 0, np.inf
        for i in range(n):
            left = abs(down[i] + up[i] - (diagonal[i] - values[k]))
            if left < least:
                joint, least = i, left
        row = out[k]
        row[joint] = 1.0
        for i in range(joint - 1, -1, -1):
            row[i] = -beside[i] / down[i] * row[i + 1]
        for i in range(joint + 1, n):
            row[i] = -beside[i - 1] / up[i] * row[i - 1]
        for j in range(k - 1, -1, -1):
            if abs(values[j] - values[k]) > near:
                break
            row -= (out[j] * row).sum() * out[j]
        row /= np.sqrt((row * row).sum())
    return out
