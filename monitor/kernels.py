"""Compiled kernels of a window's way: loops that numpy would spread over dozens of small arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from monitor.compiled import compiled
from monitor.results import Array, ComplexArray

IMPOSSIBLE = 1e3
"""Cost of what must not be."""


@compiled()
def scatter(products: Array, shifted: Array, mean: Array, counts: NDArray[np.int64], past: NDArray[np.intp]) -> Array:
    """How far every block's lagged products about the window's mean lie off the mean block's, at lags from 1 on, for the first
    factors `past`; shape (2 i - 1, r, c, n_blocks), other parameters as in `LagSums`.
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
def displaced(lag_sum: Array, head: Array, tail: Array) -> Array:
    """Gram matrix of the block Hankel matrix with these lag sums as first block row, shape (n_lags c, n_lags c).

    A block is the one above it on its diagonal with the product at the window's head taken off and the one at its tail put on.

    Parameters
    ----------
    lag_sum : ndarray, shape (n_lags, c, c)
    head, tail : ndarray, shape (n_lags - 1, c)
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


@compiled(fastmath={"contract"})
def flatness(lag_sum: Array, weights: Array) -> float:
    """Geometric over arithmetic mean of the channels' summed spectrum.

    Each channel counts at unit variance, so that a loud one does not hide that the others are noise.

    Parameters
    ----------
    lag_sum : ndarray, shape (n_lags, c, c)
    weights : ndarray, shape (n_frequencies, n_lags)
        Of every lag in the spectrum at every frequency.
    """
    logs, mean = 0.0, 0.0
    for f in range(weights.shape[0]):
        total = 0.0
        for i in range(lag_sum.shape[1]):
            power = 0.0
            for tau in range(lag_sum.shape[0]):
                power += weights[f, tau] * lag_sum[tau, i, i]
            total += max(power / lag_sum[0, i, i], 1e-12)
        logs += np.log(total)
        mean += total
    n = weights.shape[0]
    return float(np.exp(logs / n) / (mean / n))


@compiled()
def filtered(sos: Array, x: Array, memory: Array) -> tuple[Array, Array]:
    """Second-order sections one after the other, to the last bit as ``scipy.signal.sosfilt``; and what they remember.

    Parameters
    ----------
    sos : ndarray, shape (n_sections, 6)
    x : ndarray, shape (n_samples, c)
    memory : ndarray, shape (n_sections, 2, c)
    """
    out, memory = np.empty(x.shape), memory.copy()
    for k in range(x.shape[0]):
        for i in range(x.shape[1]):
            value = x[k, i]
            for s in range(sos.shape[0]):
                now = sos[s, 0] * value + memory[s, 0, i]
                memory[s, 0, i] = sos[s, 1] * value - sos[s, 4] * now + memory[s, 1, i]
                memory[s, 1, i] = sos[s, 2] * value - sos[s, 5] * now
                value = now
            out[k, i] = value
    return out, memory


@compiled()
def interpolate(x: Array, first: NDArray[np.int64], phase: NDArray[np.int64], taps: Array) -> Array:
    """Output k is the sum of ``taps[phase[k]]`` times the samples from ``first[k]`` on; the order of sums is the taps'."""
    c, n_taps = x.shape[1], taps.shape[1]
    out = np.empty((first.size, c))
    for k in range(first.size):
        for i in range(c):
            total = 0.0
            for tap in range(n_taps):
                total += taps[phase[k], tap] * x[first[k] + tap, i]
            out[k, i] = total
    return out


@compiled(fastmath={"reassoc", "contract"})
def lag_products(x: Array, n: int, n_lags: int) -> tuple[Array, Array]:
    """Sums over k < n of ``x[:, k] x[:, k + tau]^T`` and of ``x[:, k + tau]``, for every lag.

    Sums may be taken in another order than written, so that the processor adds many numbers at once.

    Parameters
    ----------
    x : ndarray, shape (c, at least n + n_lags - 1)

    Returns
    -------
    ndarray, shape (n_lags, c, c); ndarray, shape (n_lags, c)
    """
    c = x.shape[0]
    products, shifted = np.empty((n_lags, c, c)), np.empty((n_lags, c))
    for j in range(c):
        total = 0.0
        for k in range(n):
            total += x[j, k]
        shifted[0, j] = total
        for tau in range(1, n_lags):
            total += x[j, tau - 1 + n] - x[j, tau - 1]
            shifted[tau, j] = total
    for i in range(c):
        now = x[i, :n]
        for j in range(c):
            for tau in range(0, n_lags, 2):  # two lags at once: each sample is fetched for both
                after = min(tau + 1, n_lags - 1)
                one, two, first, second = x[j, tau : tau + n], x[j, after : after + n], 0.0, 0.0
                for k in range(n):
                    first += now[k] * one[k]
                    second += now[k] * two[k]
                products[tau, i, j], products[after, i, j] = first, second
    return products, shifted


@compiled()
def _likeness(a: ComplexArray, b: ComplexArray) -> float:
    """Modal assurance criterion of two shapes of unit norm."""
    total = 0j
    for i in range(a.size):
        total += np.conj(a[i]) * b[i]
    return float(total.real**2 + total.imag**2)


@compiled()
def recurring(
    space: NDArray[np.intp], frequency: Array, shape: ComplexArray, most_change: float, least_likeness: float
) -> Array:
    """For each pole 1 if the order below has the same, else 0.

    Parameters
    ----------
    space : ndarray, shape (n_poles,)
        Number of the order, rising.
    frequency : ndarray, shape (n_poles,)
    shape : ndarray, shape (n_poles, c)
        Of unit norm.
    """
    found = np.zeros(frequency.size)
    for p in range(frequency.size):
        for q in range(p):
            if (
                space[q] == space[p] - 1
                and abs(frequency[p] / frequency[q] - 1.0) < most_change
                and _likeness(shape[p], shape[q]) > least_likeness
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
    """Number of the mode of each pole, -1 for none; parameters as in `recurring`.

    A mode has one pole an order, in `enough` of them or more.
    """
    n = frequency.size
    near = np.zeros((n, n), dtype=np.bool_)
    for i in range(n):
        for j in range(n):
            if abs(frequency[i] / frequency[j] - 1.0) < most_change:
                near[i, j] = _likeness(shape[i], shape[j]) > least_likeness
    group, free, modes = np.full(n, -1), np.ones(n, dtype=np.bool_), 0
    while True:
        # The pole with most companions is the best centre of a mode; where even that has too few, no other has enough.
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
def unlikeness(
    group: NDArray[np.intp],
    frequency: Array,
    shape: ComplexArray,
    n_orders: int,
    model_ln_f: Array,
    model_shape: Array,
    most_distance: float,
    least_likeness: float,
) -> Array:
    """How unlike each of the model's modes every identified one is, shape (k, n_modes); IMPOSSIBLE beyond the bounds.

    Frequency (the median over orders), shape, and how many orders show it, which says more than how near the drawing it lies.

    Parameters
    ----------
    group : ndarray, shape (n_poles,)
        Number of each pole's mode, -1 for none.
    frequency : ndarray, shape (n_poles,)
    shape : ndarray, shape (n_poles, c)
        Of unit norm.
    model_ln_f : ndarray, shape (k,)
    model_shape : ndarray, shape (k, c)
    """
    n_modes = group.max() + 1 if group.size else 0
    out = np.full((model_ln_f.size, n_modes), IMPOSSIBLE)
    for j in range(n_modes):
        members = np.flatnonzero(group == j)
        ln_f, middle = np.log(np.median(frequency[members])), shape[members[members.size // 2]]
        for i in range(model_ln_f.size):
            distance, total, power = abs(ln_f - model_ln_f[i]), 0j, 0.0
            for s in range(middle.size):
                total += model_shape[i, s] * middle[s]
                power += model_shape[i, s] ** 2
            likeness = (total.real**2 + total.imag**2) / power if power > 0.0 else 0.0
            if distance <= most_distance and likeness >= least_likeness:
                shown = members.size / n_orders
                out[i, j] = 0.5 * distance / most_distance + 2.0 * (1.0 - likeness) + (1.0 - shown)
    return out


@compiled(fastmath={"reassoc", "nnan", "nsz"})
def described(x: Array, factor: float, fewest: int, ratio: int) -> tuple[Array, Array]:
    """Each row of `x`, shape (c, n), about its mean; and its mean, RMS and largest magnitude about it, spikes, steps that are
    not zero, and samples piled up at its ends, shape (6, c).

    Samples are piled up if `fewest` and more than `ratio` times those at the value next to it lie at an end: no motion stays
    there.
    """
    c, n = x.shape
    about, told = np.empty((c, n)), np.zeros((6, c))
    for i in range(c):
        row, out = x[i], about[i]
        mean = row.sum() / n
        square, top, least, path, still = 0.0, row[0], row[0], 0.0, 0
        for k in range(n):
            out[k] = row[k] - mean
            square += out[k] * out[k]
            top, least = max(top, row[k]), min(least, row[k])
        for k in range(1, n):
            path += abs(row[k] - row[k - 1])
            still += row[k] == row[k - 1]
        told[0, i], told[1, i], told[2, i] = mean, np.sqrt(square / n), max(top - mean, mean - least)
        told[3, i], told[4, i] = _spikes(row, factor * path / max(n - 1, 1)), n - 1 - still
        if top > least:
            told[5, i] = _piled(row, top, fewest, ratio) + _piled(-row, -least, fewest, ratio)
    return about, told


@compiled()
def _spikes(row: Array, limit: float) -> int:
    """Samples more than the limit off both neighbours."""
    found = _off(row, limit)
    if found:
        # Between long rests a step of the sensor's resolution is none.
        sizes = np.abs(row[1:] - row[:-1])
        found = _off(row, max(limit, 3.0 * np.median(sizes[sizes > 0.0])))
    return found


@compiled()
def _off(row: Array, limit: float) -> int:
    """Samples that lie farther than the limit off both neighbours, to the same side."""
    found = 0
    for k in range(1, row.size - 1):
        before, after = row[k] - row[k - 1], row[k] - row[k + 1]
        found += max(min(before, after), min(-before, -after)) > limit
    return found


@compiled()
def _piled(row: Array, top: float, fewest: int, ratio: int) -> int:
    """Samples at the row's `top`, if they are piled up there."""
    count = 0
    for k in range(row.size):
        count += row[k] == top
    if count < fewest:
        return 0
    others = row[row < top]
    return count if others.size and count > ratio * np.count_nonzero(others == others.max()) else 0


@compiled()
def evidence_of_loss(
    means: Array, covariance: Array, model_form: float, significant: float, credit: float
) -> tuple[Array, Array]:
    """`sequential.statistic`, for which a change is `significant` and a story's loss has `credit` from so many deviations."""
    k, n = means.shape
    z, std = np.empty((k, n)), np.empty((k, n))
    leak, weight = np.zeros(n), np.zeros(n)
    for s in range(k):
        mean = means[s]
        for j in range(n):
            leak[j] = 0.0
            for i in range(n):
                leak[j] = max(leak[j], model_form * abs(mean[i])) if i != j else leak[j]
            std[s, j] = np.sqrt(covariance[s, j, j] + leak[j] ** 2)
            z[s, j] = mean[j] / std[s, j]
        for j in range(n if n > 1 else 0):
            least = 1 if j == 0 else 0  # the other story that changed least
            for i in range(n):
                if i != j and abs(mean[i]) < abs(mean[least]):
                    least = i
            for i in range(n):
                spread = np.sqrt(std[s, i] ** 2 + std[s, least] ** 2)
                agrees = i != j and abs(mean[i] - mean[least]) <= significant * spread
                weight[i] = 1.0 / std[s, i] ** 2 if agrees else 0.0
            contrast = -weight / weight.sum()
            contrast[j] = 1.0
            against, square = 0.0, 0.0
            for i in range(n):
                against += contrast[i] * mean[i]
                square += (contrast[i] * leak[i]) ** 2
                for other in range(n):
                    square += contrast[i] * covariance[s, i, other] * contrast[other]
            z[s, j] = min(z[s, j], against / np.sqrt(square) + credit)
    return z, std
