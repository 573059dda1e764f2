"""Compiled loops over samples: filters, resampling, lag sums, health."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, compiled


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
