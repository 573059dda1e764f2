"""Channels that no longer follow the structure's motion, told by their neighbours from a window's lag sums.

A linear structure ties its channels together: a filter on the neighbours predicts a channel.  Its coefficients follow from the
lag sums of the whole window, and each block's lag sums then say how much of the predicted motion the channel shows there (its
gain: 1 where it is well, 0 where it is dead, stuck or gives nothing but noise).  Neither the strength of the motion nor noise in
the channel moves the gain, and damage moves it little, because the filter has to fit the structure before and after.

References
----------
J. Kullaa, Detection, identification, and quantification of sensor fault in a sensor network, Mechanical Systems and Signal
Processing 40 (2013) 208-221 (a sensor predicted by the others).
"""

from __future__ import annotations

from functools import lru_cache
from statistics import NormalDist
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, LagSums

FILTER_LENGTH = 20
"""Lags of the filter on each neighbour: half of them to either side, or all in the past. [samples after resampling; judgement:
longer filters gain nothing]"""
MOST_PREDICTORS = 5
"""Neighbours that predict a channel, those of the largest correlation. [count; cost]"""
ASSUMED_NOISE = 1e-3
"""White noise that is assumed in each channel beside what it shows, over its power: the lowpass leaves none near the Nyquist
frequency, and a prediction would rest on that. [ratio; judgement: anything from 1e-5 to 1e-2 finds the same channels, since for
blocks below 10 000 samples a prediction from neighbours rests on more]"""
_WHITER = 2.0
"""Share of a channel's power that its own past does not explain, over that of its only neighbour, from which the channel rather
than the neighbour is noise. [ratio; judgement]"""
FALSE_RATE_A_SPAN = 1e-6
"""Probability that chance makes a step, a dropout, a hum or a loss of gain in one channel of one span: less than one a month for
three channels and spans of 10 s. [1; judgement]"""
NORMAL_MAD = 1.4826
"""Standard deviation of a normal variable over its median absolute deviation. [ratio; definition]"""
_LEAST_PREDICTED = 0.1
"""Share of the prediction's mean power below which a block says nothing of the channel: its neighbours stand still, or stood
still before an earthquake. [ratio; judgement]"""


def silent_channels(
    sums: LagSums, channels: tuple[int, ...], min_gain: float, min_explained: float
) -> dict[int, tuple[float, float]]:
    """Find the channels that do not show the motion that their neighbours say they should: share explained, least gain.

    Of `channels` (0 = first) all move.  None is found where the channels left do not confirm one another: the motion is then not
    one that ties them together, which is no fault of a sensor.  The settings are those of `HealthSettings`.
    """
    covariances = _block_covariances(sums)
    found: dict[int, tuple[float, float]] = {}
    left, flagged = channels, _flagged(covariances, sums.counts, channels, min_gain, min_explained)
    while flagged and len(left) > 2:
        # A channel at fault spoils the prediction of its neighbours: it is the one without which fewest are flagged.
        tried = {c: tuple(other for other in left if other != c) for c in flagged}
        after = {c: _flagged(covariances, sums.counts, rest, min_gain, min_explained) for c, rest in tried.items()}
        worst = min(flagged, key=lambda c: (len(after[c]), flagged[c][1]))
        found[worst] = flagged[worst]
        left, flagged = tried[worst], after[worst]
    if len(left) == 2 and flagged:
        return _of_the_last_two(covariances, found, left, flagged)
    return {} if flagged else found


def _of_the_last_two(
    covariances: Array,
    found: dict[int, tuple[float, float]],
    left: tuple[int, ...],
    flagged: dict[int, tuple[float, float]],
) -> dict[int, tuple[float, float]]:
    """Decide which of the last two channels is at fault: of a pair the one flagged alone, else the one nearer to white noise."""
    if len(flagged) == 1 and not found:
        return found | flagged
    white, coloured = sorted(left, key=lambda c: _predictability(covariances, c))
    if white in flagged and 1.0 - _predictability(covariances, white) > _WHITER * (
        1.0 - _predictability(covariances, coloured)
    ):
        return found | {white: flagged[white]}
    return {}


def _block_covariances(sums: LagSums) -> Annotated[Array, "blocks lags c c"]:
    """Form the lagged products of every block about the window's mean, at up to FILTER_LENGTH lags beside 0."""
    n = 2 * min(FILTER_LENGTH // 2, (sums.products.shape[1] - 1) // 2) + 1  # as many lags to either side
    shifted, mean = sums.shifted[:, :n], sums.mean
    moved = shifted[:, :1, :, None] * mean + mean[:, None] * shifted[:, :, None, :]
    return np.asarray(sums.products[:, :n] - moved + sums.counts[:, None, None, None] * np.outer(mean, mean))


def _flagged(
    covariances: Array, counts: NDArray[np.int64], channels: tuple[int, ...], min_gain: float, min_explained: float
) -> dict[int, tuple[float, float]]:
    """Find the channels that are not as their neighbours among `channels` predict: share explained, and least gain, of each."""
    if len(channels) < 2:
        return {}
    power = covariances[:, 0].sum(axis=0)
    found = {}
    for channel in channels:
        explained, gain = _gain(covariances, counts, channel, _neighbours(power, channel, channels))
        if explained < min_explained or gain < min_gain:
            found[channel] = explained, gain
    return found


def _neighbours(power: Array, channel: int, channels: tuple[int, ...]) -> tuple[int, ...]:
    """List the channels that predict a channel, those of the largest correlation."""
    others = [c for c in channels if c != channel]
    if len(others) > MOST_PREDICTORS:
        scale = np.sqrt(power.diagonal())
        others.sort(key=lambda c: -abs(power[channel, c]) / scale[c])
        others = sorted(others[:MOST_PREDICTORS])
    return tuple(others)


def _gain(covariances: Array, counts: NDArray[np.int64], channel: int, others: tuple[int, ...]) -> tuple[float, float]:
    """Compute the share of a channel's power that its neighbours explain, and its least gain over its largest, in any block.

    Both gains are taken nearer to each other by the deviation that chance exceeds at the rate `FALSE_RATE_A_SPAN`.  Where no
    block has a gain the ratio is 1, and where the lag sums admit no prediction both are 1.
    """
    from monitor.signals.kernels import extreme_gains  # compiled code takes a while to load

    total = covariances.sum(axis=0)
    past, pairs = _places(channel, others, *total.shape[:2])
    gram = total.take(pairs)
    # The products that reach over a block's ends count for one of the blocks alone, which large coefficients of opposite signs
    # magnify: a prediction may not rest on less than their share of the power.
    gram.ravel()[:: len(gram) + 1] *= 1.0 + max(ASSUMED_NOISE, FILTER_LENGTH // 2 / float(counts.min()))
    weights = np.linalg.solve(gram, total.take(past))
    # Both sums are linear in a block's lag sums: their coefficients are formed once for all blocks.
    shown = np.bincount(past, weights, total.size)
    predicted = np.bincount(pairs.ravel(), np.outer(weights, weights).ravel(), total.size)
    shares = covariances.reshape(len(covariances), -1) @ np.stack([shown, predicted], axis=1)
    explained = float(2.0 * shares[:, 0].sum() - shares[:, 1].sum()) / float(total[0, channel, channel])
    if not shares[:, 1].sum() > 0.0 or explained > 1.0:
        # The lag sums of a motion that begins or dies out in the window need not be those of any stationary motion.
        return 1.0, 1.0
    most, least = extreme_gains(
        shares[:, 0],
        shares[:, 1],
        covariances[:, 0, channel, channel],
        counts,
        _LEAST_PREDICTED * float(shares[:, 1].mean()),
        NormalDist().inv_cdf(1.0 - FALSE_RATE_A_SPAN),
        NORMAL_MAD,
    )
    return explained, least / most if most > 0.0 else 1.0


def _predictability(covariances: Array, channel: int) -> float:
    """Compute the least share of a channel's power in a block that its own past explains, 0 for white noise."""
    least = 1.0
    for block in covariances[:, :, channel, channel]:
        n = len(block) - 1
        at = np.arange(n)
        gram = block[np.abs(at[:, None] - at)] + ASSUMED_NOISE * block[0] * np.eye(n)
        past = block[1:]
        least = min(least, float(past @ np.linalg.solve(gram, past)) / float(block[0])) if block[0] > 0.0 else 0.0
    return least


@lru_cache(maxsize=1024)
def _places(
    channel: int, others: tuple[int, ...], n_lags: int, n_channels: int
) -> tuple[Annotated[NDArray[np.intp], "k"], Annotated[NDArray[np.intp], "k k"]]:
    """Find where lag sums of shape (n_lags, c, c), flattened, hold what k coefficients of the filters on other channels need.

    These are the products of the channel with each filtered sample, and those of the filtered samples with one another.
    """
    half = n_lags // 2
    lags = np.tile(np.arange(-half, half + 1), len(others))
    owner = np.repeat(np.asarray(others), 2 * half + 1)

    def at(first: NDArray[np.intp] | int, second: NDArray[np.intp], lag: NDArray[np.intp]) -> NDArray[np.intp]:
        """Find the products of `first` at k with `second` at k + lag; a negative lag is that of the pair in reverse."""
        forward = np.where(lag >= 0, first, second), np.where(lag >= 0, second, first)
        return np.asarray(np.ravel_multi_index((np.abs(lag), *forward), (n_lags, n_channels, n_channels)))

    return at(channel, owner, lags), at(owner[:, None], owner[None, :], lags[None, :] - lags[:, None])
