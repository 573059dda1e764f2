"""Compiled loops of identification: blocks of lag sums, matching of poles."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, ComplexArray, compiled


@compiled()
def scatter(products: Array, shifted: Array, mean: Array, counts: NDArray[np.int64], past: NDArray[np.intp]) -> Array:
    """Compute the deviation of each block's lagged products, about the window's mean, from those of the mean block.

    The products are as in `LagSums`; `past` are the channels of the first factors.  The axes are lags from 1 on, first
    and second factor, and blocks.
    """
    n_blocks, n_lags, c, _ = products.shape
    out, share = np.empty((n_lags - 1, past.size, c, n_blocks)), counts / counts.sum()
    for tau in range(1, n_lags):
        for k in range(past.size):
            i = past[k]
            for j in range(c):
                row, total = out[tau - 1, k, j], 0.0
                for b in range(n_blocks):
                    moved = shifted[b, 0, i] * mean[j] + mean[i] * shifted[b, tau, j]
                    row[b] = products[b, tau, i, j] - moved + counts[b] * (mean[i] * mean[j])
                    total += row[b]
                for b in range(n_blocks):
                    row[b] -= total * share[b]
    return out


@compiled()
def displaced(lag_sum: Annotated[Array, "lags c c"], head: Array, tail: Array) -> Array:
    """Compute the Gram matrix of the block Hankel matrix from its first block row, the lag sums.

    A block equals the previous block on its diagonal, minus the product at the window's head, plus the product at its tail.
    """
    lags, c, _ = lag_sum.shape
    out = np.empty((lags * c, lags * c))
    for tau in range(lags):
        for i in range(c):
            for j in range(c):
                total = lag_sum[tau, i, j]
                out[i, tau * c + j] = out[tau * c + j, i] = total
                for a in range(lags - tau - 1):
                    total += tail[a, i] * tail[a + tau, j] - head[a, i] * head[a + tau, j]
                    row, column = (a + 1) * c + i, (a + 1 + tau) * c + j
                    out[row, column] = out[column, row] = total
    return out


@compiled(part=True)
def _mac(a: ComplexArray, b: ComplexArray) -> float:
    """Compute the modal assurance criterion of two shapes of unit norm."""
    total = 0j
    for i in range(a.size):
        total += np.conj(a[i]) * b[i]
    return float(total.real**2 + total.imag**2)


@compiled()
def recurring(
    space: NDArray[np.intp], frequency: Array, shape: ComplexArray, most_change: float, least_likeness: float
) -> Array:
    """Mark each pole with 1 if the next lower order has a matching pole, with a shape of unit norm, else 0.

    `space` is the number of the pole's order, increasing; `most_change` the largest relative change of frequency between matching
    poles, and `least_likeness` the least modal assurance criterion.
    """
    found = np.zeros(frequency.size)
    for p in range(frequency.size):
        for q in range(p):
            if (
                space[q] == space[p] - 1
                and abs(frequency[p] / frequency[q] - 1.0) < most_change
                and _mac(shape[p], shape[q]) > least_likeness
            ):
                found[p] = 1.0
    return found


@compiled()
def grouped(
    space: NDArray[np.intp],
    frequency: Array,
    shape: ComplexArray,
    most_change: float,
    least_likeness: float,
    enough: float,
) -> NDArray[np.intp]:
    """Group the poles into modes, with at most one pole from each order, and at least `enough` poles in all.

    The result is the number of the mode of each pole, -1 for none.  Parameters are as in `recurring`.
    """
    n = frequency.size
    near = np.zeros((n, n), dtype=np.bool_)
    for i in range(n):
        for j in range(n):
            if abs(frequency[i] / frequency[j] - 1.0) < most_change:
                near[i, j] = _mac(shape[i], shape[j]) > least_likeness
    group, free, modes = np.full(n, -1), np.ones(n, dtype=np.bool_), 0
    while True:
        # The pole with most matching poles is the best centre of a mode; if even this pole has too few, no other has enough.
        seed, most = 0, 0
        for i in range(n):
            companions = 0
            for j in range(n):
                companions += free[i] and free[j] and near[i, j]
            if companions > most:
                seed, most = i, companions
        if most < enough:
            return group
        best, away = np.full(space[-1] + 1, -1), np.abs(frequency - frequency[seed])
        for j in range(n):
            if free[j] and near[seed, j]:
                free[j] = False
                rival = best[space[j]]
                if rival < 0 or away[j] < away[rival]:
                    best[space[j]] = j
        best = best[best >= 0]
        if best.size >= enough:
            group[best] = modes
            modes += 1


@compiled()
def compared(
    group: Annotated[NDArray[np.intp], "poles"],
    frequency: Annotated[Array, "poles"],
    shape: Annotated[ComplexArray, "poles c"],
    n_orders: int,
    model_ln_f: Annotated[Array, "k"],
    model_shape: Annotated[Array, "k c"],
) -> tuple[Annotated[Array, "k modes"], Annotated[Array, "k modes"], Annotated[Array, "modes"]]:
    """Compare each of the model's modes with each identified mode.

    Returned are the distance in ln f (the median over orders), the modal assurance criterion, and the share of orders in which
    the identified mode was found.  `group` is the number of each pole's mode, -1 for none.
    """
    n_modes = group.max() + 1 if group.size else 0
    away, like = np.empty((model_ln_f.size, n_modes)), np.empty((model_ln_f.size, n_modes))
    share = np.empty(n_modes)
    for j in range(n_modes):
        members = np.flatnonzero(group == j)
        ln_f, middle = np.log(np.median(frequency[members])), shape[members[members.size // 2]]
        share[j] = members.size / n_orders
        for i in range(model_ln_f.size):
            total, power = 0j, 0.0
            for s in range(middle.size):
                total += model_shape[i, s] * middle[s]
                power += model_shape[i, s] ** 2
            away[i, j] = abs(ln_f - model_ln_f[i])
            like[i, j] = (total.real**2 + total.imag**2) / power if power > 0.0 else 0.0
    return away, like, share
