"""Compiled loops over samples: filters, resampling, lag sums, health."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, compiled


@compiled()
def filtered(
    sos: Annotated[Array, "sections 6"], x: Annotated[Array, "n c"], memory: Annotated[Array, "sections 2 c"]
) -> tuple[Annotated[Array, "n c"], Annotated[Array, "sections 2 c"]]:
    """Filter by second-order sections in cascade, with the result of ``scipy.signal.sosfilt`` to the last bit.

    `memory` is the state of the sections before the first sample; that after the last one is returned.
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
def interpolate(
    x: Annotated[Array, "n c"],
    first: Annotated[NDArray[np.int64], "out"],
    phase: Annotated[NDArray[np.int64], "out"],
    taps: Annotated[Array, "phases taps"],
) -> Annotated[Array, "out c"]:
    """Interpolate: output k is the sum of ``taps[phase[k]]`` times the samples from ``first[k]`` on, in the taps' order."""
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
def lag_products(
    x: Annotated[Array, "c columns"], n: int, n_lags: int
) -> tuple[Annotated[Array, "lags c c"], Annotated[Array, "lags c"]]:
    """Sum ``x[:, k] x[:, k + tau]^T`` and ``x[:, k + tau]`` over k < n, for every lag tau.

    `x` has at least n + n_lags - 1 columns.  The compiler may reorder the sums, so that the processor adds many numbers at once.
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
def flatness(lag_sum: Annotated[Array, "lags c c"], weights: Annotated[Array, "frequencies lags"]) -> float:
    """Compute the spectral flatness: geometric over arithmetic mean of the channels' summed spectrum.

    Each channel is scaled to unit variance, so that a channel of large amplitude does not mask noise in the others.
    `weights` are those of the lags in the spectrum.
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
def described(
    x: Annotated[Array, "c n"], factor: float, fewest: int, ratio: int
) -> tuple[Annotated[Array, "c n"], Annotated[Array, "6 c"]]:
    """Remove the mean of each channel and compute the statistics of its health.

    These are mean, RMS and largest magnitude about the mean, and the numbers of spikes, of nonzero steps and of piled-up samples.
    A spike has `factor` mean steps from one sample to the next.

    Samples count as piled up at the channel's largest or least value if at least `fewest` lie at that value, and more than
    `ratio` times as many as at the value next to it.  Motion does not stay at an extreme; a clipped channel does.
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
    """Count the samples at the largest value `top` of a row; 0 if they are not piled up (see `described`)."""
    count = 0
    for k in range(row.size):
        count += row[k] == top
    if count < fewest:
        return 0
    others = row[row < top]
    return count if others.size and count > ratio * np.count_nonzero(others == others.max()) else 0


@compiled()
def extreme_gains(
    shown: Annotated[Array, "blocks"],
    predicted: Annotated[Array, "blocks"],
    own: Annotated[Array, "blocks"],
    counts: Annotated[NDArray[np.int64], "blocks"],
    least: float,
    stds: float,
    normal_mad: float,
) -> tuple[float, float]:
    """Compute the largest and the least gain of a channel in any block, each `stds` standard deviations nearer to the other.

    `shown` is the channel's product with its prediction, `predicted` the power of the prediction, `own` that of the channel.  The
    blocks count whose prediction has more power than `least`, as at least one has.
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
    last: Array,
    x: Annotated[Array, "n c"],
    resolution: Annotated[Array, "c"],
    counts: tuple[int, int, int, int, int, int],
) -> tuple[Annotated[Array, "c"], tuple[int, int, int, int, int, int]]:
    """Count samples that repeat the one before in all channels; one that is not finite says nothing.

    `last` is the sample before the first, if there was one, `resolution` the least change of each channel so far.  `counts` are
    the repetitions, those of the longest run in this stretch, those of the present run in it, the present run, the longest run
    that steps of the resolution ended, and the longest that larger ones ended.
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
