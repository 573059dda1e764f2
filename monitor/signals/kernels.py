"""Compiled loops over samples: filters, resampling, lag sums, health."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, compiled


@compiled()
def filtered(sos: Array, x: Array, memory: Array) -> tuple[Array, Array]:
    """Filter by second-order sections in cascade, with the result of ``scipy.signal.sosfilt`` to the last bit.

    Parameters
    ----------
    sos : ndarray, shape (n_sections, 6)
    x : ndarray, shape (n_samples, c)
    memory : ndarray, shape (n_sections, 2, c)
        State of the sections before the first sample.

    Returns
    -------
    out : ndarray, shape (n_samples, c)
    memory : ndarray, shape (n_sections, 2, c)
        State of the sections after the last sample.
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
    """Interpolate: output k is the sum of ``taps[phase[k]]`` times the samples from ``first[k]`` on, summed in the taps' order.

    Parameters
    ----------
    x : ndarray, shape (n_samples, c)
    first : ndarray of int, shape (n_output,)
    phase : ndarray of int, shape (n_output,)
    taps : ndarray, shape (n_phases, n_taps)

    Returns
    -------
    ndarray, shape (n_output, c)
    """
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
    """Sum ``x[:, k] x[:, k + tau]^T`` and ``x[:, k + tau]`` over k < n, for every lag tau.

    The compiler may reorder the sums, so that the processor adds many numbers at once.

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
            for tau in range(0, n_lags, 2):  # two lags at once: each sample is loaded once for both
                after = min(tau + 1, n_lags - 1)
                one, two, first, second = x[j, tau : tau + n], x[j, after : after + n], 0.0, 0.0
                for k in range(n):
                    first += now[k] * one[k]
                    second += now[k] * two[k]
                products[tau, i, j], products[after, i, j] = first, second
    return products, shifted


@compiled(fastmath={"contract"})
def flatness(lag_sum: Array, weights: Array) -> float:
    """Compute the spectral flatness: geometric over arithmetic mean of the channels' summed spectrum.

    Each channel is scaled to unit variance, so that a channel of large amplitude does not mask noise in the others.

    Parameters
    ----------
    lag_sum : ndarray, shape (n_lags, c, c)
    weights : ndarray, shape (n_frequencies, n_lags)
        Weight of every lag in the spectrum at every frequency.
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
    """Remove the mean of each channel and compute the statistics of its health.

    Samples count as piled up at the channel's largest or least value if at least `fewest` lie at that value, and more than
    `ratio` times as many as at the value next to it.  Motion does not stay at an extreme; a clipped channel does.

    Parameters
    ----------
    x : ndarray, shape (c, n)
    factor : float
        Size of a spike, in mean steps from one sample to the next.

    Returns
    -------
    centred : ndarray, shape (c, n)
    statistics : ndarray, shape (6, c)
        Mean; RMS and largest magnitude about the mean; number of spikes, of nonzero steps, and of piled-up samples.
    """
    c, n = x.shape
    centred, statistics = np.empty((c, n)), np.zeros((6, c))
    for i in range(c):
        row, out = x[i], centred[i]
        mean = row.sum() / n
        square, top, least, path, still = 0.0, row[0], row[0], 0.0, 0
        for k in range(n):
            out[k] = row[k] - mean
            square += out[k] * out[k]
            top, least = max(top, row[k]), min(least, row[k])
        for k in range(1, n):
            path += abs(row[k] - row[k - 1])
            still += row[k] == row[k - 1]
        statistics[0, i], statistics[1, i], statistics[2, i] = mean, np.sqrt(square / n), max(top - mean, mean - least)
        statistics[3, i], statistics[4, i] = _count_spikes(row, factor * path / max(n - 1, 1)), n - 1 - still
        if top > least:
            statistics[5, i] = _count_piled(row, top, fewest, ratio) + _count_piled(-row, -least, fewest, ratio)
    return centred, statistics


@compiled(part=True)
def _count_spikes(row: Array, limit: float) -> int:
    """Count the samples that differ from both neighbours by more than the limit, or than three median nonzero steps."""
    found = _count_outliers(row, limit)
    if found:
        # In a channel mostly at rest the mean step is small, and a step of the sensor's resolution is no spike.
        sizes = np.abs(row[1:] - row[:-1])
        found = _count_outliers(row, max(limit, 3.0 * np.median(sizes[sizes > 0.0])))
    return found


@compiled(part=True)
def _count_outliers(row: Array, limit: float) -> int:
    """Count the samples that differ from both neighbours by more than the limit, in the same direction."""
    found = 0
    for k in range(1, row.size - 1):
        before, after = row[k] - row[k - 1], row[k] - row[k + 1]
        found += max(min(before, after), min(-before, -after)) > limit
    return found


@compiled(part=True)
def _count_piled(row: Array, top: float, fewest: int, ratio: int) -> int:
    """Count the samples at the largest value `top` of a row, shape (n,); 0 if they are not piled up (see `described`)."""
    count = 0
    for k in range(row.size):
        count += row[k] == top
    if count < fewest:
        return 0
    others = row[row < top]
    return count if others.size and count > ratio * np.count_nonzero(others == others.max()) else 0


@compiled()
def extreme_gains(
    shown: Array, predicted: Array, own: Array, counts: NDArray[np.int64], least: float, stds: float, normal_mad: float
) -> tuple[float, float]:
    """Compute the largest and the least gain of a channel in any block, each `stds` standard deviations nearer to the other.

    Parameters
    ----------
    shown, predicted, own : ndarray, shape (n_blocks,)
        Product of the channel with its prediction, power of the prediction and of the channel.
    counts : ndarray, shape (n_blocks,)
        Samples of each block.
    least : float
        Power of the prediction beyond which a block counts; at least one has more.
    normal_mad : float
        Standard deviation of a normal variable over its median absolute deviation.
    """
    known = np.flatnonzero(predicted > least)
    gain = shown[known] / predicted[known]
    # What the neighbours do not explain may be a slow motion, of which a block has far fewer values than samples: the scatter
    # of most blocks' gains says so.
    ordered = np.sort(gain)
    middle = (ordered[(gain.size - 1) // 2] + ordered[gain.size // 2]) / 2.0
    ordered = np.sort(np.abs(gain - middle))
    scatter = normal_mad * ((ordered[(gain.size - 1) // 2] + ordered[gain.size // 2]) / 2.0)
    largest, smallest = -np.inf, np.inf
    for k, g in enumerate(gain):
        at = known[k]
        rest = max(own[at] - 2.0 * shown[at] + predicted[at], 0.0)
        std = max(np.sqrt(rest / (counts[at] * predicted[at])), scatter)
        largest, smallest = max(largest, g - stds * std), min(smallest, g + stds * std)
    return largest, smallest


@compiled()
def count_repetitions(
    last: Array, x: Array, resolution: Array, counts: tuple[int, int, int, int, int, int]
) -> tuple[Array, tuple[int, int, int, int, int, int]]:
    """Count samples that repeat the one before in all channels; one that is not finite says nothing.

    Parameters
    ----------
    last : ndarray, shape (0, c) or (1, c)
        The sample before the first.
    x : ndarray, shape (n_samples, c)
    resolution : ndarray, shape (c,)
        Least change of each channel so far.
    counts : tuple of int
        Repetitions, those of the longest run in this stretch, those of the present run in it, the present run, the longest run
        that steps of the resolution ended, and the longest that larger ones ended.

    Returns
    -------
    resolution : ndarray, shape (c,)
    counts : tuple of int
    """
    resolution = resolution.copy()
    repeated, longest, here, run, rest, hold = counts
    for k in range(x.shape[0]):
        if k == 0 and last.shape[0] == 0:
            continue
        before = last[0] if k == 0 else x[k - 1]
        moved = large = False
        for i in range(x.shape[1]):
            step = abs(x[k, i] - before[i])
            if step > 0.0:
                moved = True
                resolution[i] = min(resolution[i], step)
                large = large or step > 1.5 * resolution[i]
        if not moved:
            repeated, here, run = repeated + 1, here + 1, run + 1
            longest = max(longest, here)
        else:
            if large:
                hold = max(hold, run)
            else:
                rest = max(rest, run)
            here = run = 0
    return resolution, (repeated, longest, here, run, rest, hold)
