"""Eigenvalues and eigenvectors of small matrices, limited to those that identification needs; LAPACK computes all.

A window has some fifteen matrices whose poles above the real axis are needed, with a few rows of the eigenvectors.  After
reduction to Hessenberg form (zero below the first subdiagonal) the double-shift QR iteration acts on the undeflated block alone,
because the triangular form is not needed.  An eigenvector follows from one step of inverse iteration with its pole as shift.
Of a symmetric matrix, whose Hessenberg form is tridiagonal, only the leading vectors are computed.

References
----------
G. H. Golub, C. F. Van Loan, Matrix Computations, 4th ed., 2013, sections 7.5 and 7.6.  I. S. Dhillon, B. N. Parlett, Multiple
representations to compute orthogonal eigenvectors of symmetric tridiagonal matrices, Linear Algebra and its Applications 387
(2004) 1-28.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, ComplexArray, compiled

Indices = NDArray[np.intp]
Poles = tuple[Indices, ComplexArray, ComplexArray, ComplexArray]
Region = tuple[float, float, float, float]
"""Bounds of a pole: least and largest magnitude of its logarithm, then least and largest damping ratio."""
EVERYWHERE: Region = (0.0, np.inf, -np.inf, np.inf)
"""A region that holds every eigenvalue. [1; definition]"""

_EPS = float(np.finfo(float).eps)
_PIVOT_IN_PLACE_OF_0 = 1e-290
"""Taken in place of a pivot that vanishes. [1; definition: near the least double]"""
_CLUSTER_DISTANCE = 1e-5
"""Distance of two eigenvalues, over the largest, within which their vectors mix. [ratio; rounding]"""
_MAX_SWEEPS = 60
"""Most iterations for one eigenvalue. [iterations; cost]"""
_MIN_GROWTH = 1e10
"""Least growth of a solution by inverse iteration; the residual of the vector is its inverse times the order. [ratio;
rounding]"""


def upper_poles(
    a: Array, c: Array, orders: Sequence[int], region: Region = EVERYWHERE, *, sweeps: int = _MAX_SWEEPS
) -> Poles:
    """Compute the eigenvalues above the real axis and within a region, of the leading part of `a` for every (increasing) order.

    Returned are the index of the order of each eigenvalue in `orders`, the eigenvalues, their logarithms, and `c` times the
    eigenvectors, scaled to unit norm.  LAPACK computes all poles where `sweeps` iterations for one do not suffice.
    """
    sizes = np.asarray(orders, dtype=np.intp)
    space, value, logarithm, shape, sound = _upper_poles(
        np.ascontiguousarray(a), np.ascontiguousarray(c), sizes, region, sweeps
    )
    return (space, value, logarithm, shape) if sound else by_lapack(a, c, orders, region)


def by_lapack(a: Array, c: Array, orders: Sequence[int], region: Region) -> Poles:
    """Compute the result of `upper_poles` by LAPACK, for use where the iteration or an eigenvector does not converge."""
    value, shape = [np.zeros(0, complex)], [np.zeros((0, len(c)), complex)]
    for n in orders:
        values, vectors = np.linalg.eig(a[:n, :n])
        kept = [k for k, one in enumerate(values) if one.imag > 0 and _within(complex(np.log(one)), region)]
        value.append(values[kept])
        shape.append((c[:, :n] @ vectors[:, kept]).T)
    space = np.repeat(np.arange(len(orders)), [part.size for part in value[1:]])
    values, shapes = np.concatenate(value), np.concatenate(shape)
    return space, values, np.log(values), shapes / np.linalg.norm(shapes, axis=1, keepdims=True)


@compiled(part=True)
def _within(logarithm: complex, region: Region) -> bool:
    """Check that a pole lies in the region."""
    slowest, fastest, least_damped, most_damped = region
    size = abs(logarithm)
    return slowest < size < fastest and least_damped < -logarithm.real / size < most_damped


@compiled(error_model="numpy", fastmath={"contract"})
def _upper_poles(
    a: Array, c: Array, orders: Indices, region: Region, most_sweeps: int
) -> tuple[Indices, ComplexArray, ComplexArray, ComplexArray, bool]:
    """Compute the result of `upper_poles`, and a flag that all iterations converged."""
    most, l, largest = orders.sum() // 2, c.shape[0], orders.max() if orders.size else 0  # noqa: E741 - the paper's letters
    space, value = np.empty(most, dtype=np.intp), np.empty(most, dtype=np.complex128)
    logarithm, shape = np.empty(most, dtype=np.complex128), np.empty((most, l), dtype=np.complex128)
    workspace, x = np.empty((largest, largest), dtype=np.complex128), np.empty(largest, dtype=np.complex128)
    m, sound = 0, True
    for s in range(orders.size):
        n = orders[s]
        h, transformed = a[:n, :n].copy(), c[:, :n].copy()
        _reduce(h, transformed)
        values = _eigenvalues(h, most_sweeps)
        sound = sound and not np.isnan(values[0])
        for k in range(n):
            if not values[k].imag > 0.0:
                continue
            space[m], value[m], logarithm[m] = s, values[k], np.log(values[k])
            if not _within(logarithm[m], region):
                continue
            sound = _eigenvector(h, values[k], workspace, x) and sound
            size = 0.0
            for i in range(l):
                total = 0j
                for j in range(n):
                    total += transformed[i, j] * x[j]
                shape[m, i] = total
                size += total.real**2 + total.imag**2
            shape[m] /= np.sqrt(size)
            m += 1
    return space[:m].copy(), value[:m].copy(), logarithm[:m].copy(), shape[:m].copy(), sound


@compiled(part=True, error_model="numpy", fastmath={"contract", "reassoc"})
def _reduce(h: Annotated[Array, "n n"], c: Annotated[Array, "l n"]) -> None:
    """Reduce `h` to Hessenberg form by reflections, and transform `c` alike, in place."""
    n = h.shape[0]
    workspace = np.empty((3, n))
    for k in range(n - 2):
        v, v_h, h_v = workspace[0, k + 1 :], workspace[1, k + 1 :], workspace[2, k + 1 :]  # v, v^T H, H v
        square = 0.0
        for i in range(k + 2, n):
            square += h[i, k] * h[i, k]
        if square == 0.0:
            continue
        first = h[k + 1, k]
        size = np.sqrt(first * first + square)
        size = size if first > 0.0 else -size
        for i in range(v.size):
            v[i], v_h[i], h[k + 1 + i, k] = h[k + 1 + i, k], 0.0, 0.0
        v[0], h[k + 1, k] = first + size, -size
        twice = 2.0 / (v[0] * v[0] + square)
        v_h_v = 0.0
        for i in range(v.size):
            row, factor, total = h[k + 1 + i, k + 1 :], v[i], 0.0
            for j in range(v.size):
                v_h[j] += factor * row[j]
                total += row[j] * v[j]
            h_v[i] = total
            v_h_v += factor * total
        for i in range(v.size):
            row, left = h[k + 1 + i, k + 1 :], twice * v[i]
            right = twice * (h_v[i] - v_h_v * left)
            for j in range(v.size):
                row[j] -= left * v_h[j] + right * v[j]
        for i in range(k + 1):
            _reflect(h[i, k + 1 :], v, twice)
        for i in range(c.shape[0]):
            _reflect(c[i, k + 1 :], v, twice)


@compiled(part=True, fastmath={"contract", "reassoc"})
def _reflect(row: Array, v: Array, twice: float) -> None:
    """Multiply `row` by the reflection along `v`, in place."""
    total = 0.0
    for j in range(v.size):
        total += row[j] * v[j]
    total *= twice
    for j in range(v.size):
        row[j] -= total * v[j]


@compiled(part=True, error_model="numpy", fastmath={"contract"})
def _eigenvalues(hessenberg: Annotated[Array, "n n"], most_sweeps: int) -> Annotated[ComplexArray, "n"]:
    """Compute all eigenvalues of a Hessenberg matrix; NaN if the iteration does not converge."""
    n = hessenberg.shape[0]
    h, values = np.zeros((n + 1, n + 1)), np.empty(n, dtype=np.complex128)  # room for a reflection of three at the end
    h[:n, :n] = hessenberg
    end, sweeps = n - 1, 0
    while end >= 0:
        begin = end  # start of the undeflated block that ends at `end`
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
        elif sweeps == most_sweeps:
            values[:] = np.nan
            return values
        else:
            sweeps += 1
            _sweep(h, begin, end, sweeps % 10 == 0)
    return values


@compiled(part=True, error_model="numpy", fastmath={"contract"})
def _sweep(h: Array, begin: int, end: int, stuck: bool) -> None:
    """Do one double-shift QR step on the block from `begin` to `end`, in place."""
    x, y, product = h[end, end], h[end - 1, end - 1], h[end, end - 1] * h[end - 1, end]
    if stuck:  # exceptional shifts break a cycle of the iteration
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
        above, row, below = h[k, k : end + 1], h[k + 1, k : end + 1], h[k + 2, k : end + 1]
        for j in range(above.size):
            one, two, three = above[j], row[j], below[j]  # load all before storing: the compiler must assume aliasing
            total = one + q * two + r * three
            above[j], row[j], below[j] = one - total * u, two - total * v, three - total * w
        for i in range(begin, min(end, k + 3) + 1):
            total = u * h[i, k] + v * h[i, k + 1] + w * h[i, k + 2]
            h[i, k] -= total
            h[i, k + 1] -= total * q
            h[i, k + 2] -= total * r


@compiled(part=True, error_model="numpy", fastmath={"contract"})
def _eigenvector(h: Array, pole: complex, u: ComplexArray, x: ComplexArray) -> bool:
    """Compute an eigenvector of `h` into `x`, of any scale, by one step of inverse iteration; `u` is a workspace.

    The result is False if the solution did not grow, that is, if the vector is not accurate.
    """
    n = h.shape[0]
    norm = 0.0
    for j in range(n):
        norm = max(norm, abs(h[0, j]))
        u[0, j] = h[0, j]
    for k in range(n - 1):
        norm = max(norm, abs(h[k + 1, k]))
    least = _EPS * norm
    u[0, 0] -= pole
    # Gaussian elimination of h - pole; a row is exchanged with the next where that has the larger pivot.
    for k in range(n - 1):
        subdiagonal = h[k + 1, k]
        for j in range(k + 1, n):
            u[k + 1, j] = h[k + 1, j]
        u[k + 1, k + 1] -= pole
        if abs(u[k, k].real) + abs(u[k, k].imag) >= abs(subdiagonal):
            x[k] = _inverse(u[k, k], least)
            if subdiagonal != 0.0:
                factor = subdiagonal * x[k]
                for j in range(k + 1, n):
                    u[k + 1, j] -= factor * u[k, j]
        else:
            x[k] = complex(1.0 / subdiagonal)
            factor = u[k, k] * x[k].real
            for j in range(k + 1, n):
                lower = u[k + 1, j]
                u[k + 1, j] = u[k, j] - factor * lower
                u[k, j] = lower
    x[n - 1] = _inverse(u[n - 1, n - 1], least)
    growth = 0.0
    for i in range(n - 1, -1, -1):  # back substitution; x still holds the inverse pivots of the rows above
        total = 1.0 + 0j
        for j in range(i + 1, n):
            total -= u[i, j] * x[j]
        x[i] *= total
        growth = max(growth, abs(x[i].real) + abs(x[i].imag))
    return growth * norm >= _MIN_GROWTH


@compiled(part=True, error_model="numpy")
def _inverse(pivot: complex, least: float) -> complex:
    """Invert a pivot, or `least` where the pivot is smaller."""
    if abs(pivot.real) + abs(pivot.imag) < least:
        return complex(1.0 / least)
    return pivot.conjugate() / (pivot.real**2 + pivot.imag**2)


@compiled(error_model="numpy")
def tridiagonal_vectors(diagonal: Array, off_diagonal: Array, values: Array) -> Annotated[Array, "m n"]:
    """Compute unit eigenvectors, as rows, of a symmetric tridiagonal matrix for known eigenvalues in order.

    Each vector follows from the factorizations of the shifted matrix from the top and from the bottom (twisted factorization),
    joined at the row of the smallest pivot.  Its error is rounding over the distance to the next eigenvalue.  Its components
    along the vectors of close eigenvalues are therefore removed.
    """
    n, near = diagonal.size, _CLUSTER_DISTANCE * np.abs(values).max()
    out, down, up = np.empty((values.size, n)), np.empty(n), np.empty(n)
    for k in range(values.size):
        down[0], up[n - 1] = diagonal[0] - values[k], diagonal[n - 1] - values[k]
        for i in range(1, n):
            down[i - 1] = down[i - 1] or _PIVOT_IN_PLACE_OF_0
            down[i] = diagonal[i] - values[k] - off_diagonal[i - 1] ** 2 / down[i - 1]
        for i in range(n - 2, -1, -1):
            up[i + 1] = up[i + 1] or _PIVOT_IN_PLACE_OF_0
            up[i] = diagonal[i] - values[k] - off_diagonal[i] ** 2 / up[i + 1]
        joint, least = 0, np.inf
        for i in range(n):
            left = abs(down[i] + up[i] - (diagonal[i] - values[k]))
            if left < least:
                joint, least = i, left
        row = out[k]
        row[joint] = 1.0
        for i in range(joint - 1, -1, -1):
            row[i] = -off_diagonal[i] / down[i] * row[i + 1]
        for i in range(joint + 1, n):
            row[i] = -off_diagonal[i - 1] / up[i] * row[i - 1]
        for j in range(k - 1, -1, -1):
            if abs(values[j] - values[k]) > near:
                break
            row -= (out[j] * row).sum() * out[j]
        row /= np.sqrt((row * row).sum())
    return out
