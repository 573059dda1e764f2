"""Compiled loops of the recognition of events: what every hop does while the motion is quiet."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, compiled


@compiled(error_model="numpy")
def tapered_frames(tail: Array, samples: Array, taper: Array) -> Array:
    """Cut samples into frames that overlap by half, each without its mean and tapered, shape (c, frames, n).

    Parameters
    ----------
    tail : ndarray, shape (n / 2, c)
        The samples before.
    samples : ndarray, shape (k n, c)
    taper : ndarray, shape (n,)
    """
    n, half, channels = taper.size, len(tail), tail.shape[1]
    frames = np.empty((channels, 2 * (len(samples) // n), n))
    for j in range(channels):
        for f in range(frames.shape[1]):
            frame, first = frames[j, f], (f - 1) * half
            for i in range(n):
                frame[i] = samples[first + i, j] if first + i >= 0 else tail[half + first + i, j]
            mean = frame.sum() / n
            for i in range(n):
                frame[i] = (frame[i] - mean) * taper[i]
    return frames


@compiled(error_model="numpy")
def band_power(transforms: NDArray[np.complex128], edges: NDArray[np.int64], end: int) -> Array:
    """Sum the power of frames' transforms in each band, shape (k, 2, c, b).

    Parameters
    ----------
    transforms : ndarray, shape (c, 2 k, bins)
    edges : ndarray of int, shape (b,)
        First bin of each band.
    end : int
        Bin past the last band.
    """
    channels, frames, _ = transforms.shape
    power = np.zeros((frames // 2, 2, channels, edges.size))
    for j in range(channels):
        for f in range(frames):
            for b in range(edges.size):
                for i in range(edges[b], edges[b + 1] if b + 1 < edges.size else end):
                    value = transforms[j, f, i]
                    power[f // 2, f % 2, j, b] += value.real**2 + value.imag**2
    return power


@compiled(error_model="numpy")
def average_while_quiet(
    power: Array, long_term: Array, steps: int, thresholds: Array, own: int, raised: int, dead: float, tiny: float
) -> tuple[bool, Array, int]:
    """Add steps to the long-term average as long as nothing is above the threshold.

    Parameters
    ----------
    power : ndarray, shape (k, 2, c, b)
        Power of the two frames of each step.
    long_term : ndarray, shape (c, b)
    steps : int
        Steps in the average.
    thresholds : ndarray, shape (m + 1,)
        Threshold of the voted ratio for each number of steps in the average, of which there are at most m.
    own : int
        Band that must be raised.
    raised : int
        Number of bands that must be.
    dead : float
        Share of the strongest channel's power below which a channel is dead.
    tiny : float
        Least power of which a ratio is taken.

    Returns
    -------
    quiet : bool
        Whether all channels were live, and all frames below the threshold.
    long_term : ndarray, shape (c, b)
    steps : int
    """
    channels, bands = long_term.shape
    average, shares, voted = long_term.copy(), np.empty(channels), np.empty(bands)
    for k in range(len(power)):
        strongest = 0.0
        for j in range(channels):
            strongest = max(strongest, average[j].sum())
        for j in range(channels):
            if not average[j].sum() > dead * strongest:
                return False, average, steps
        for half in range(2):
            for b in range(bands):
                for j in range(channels):
                    shares[j] = power[k, half, j, b] / max(average[j, b], tiny)
                shares.sort()
                voted[b] = shares[(channels - 1) // 2]
            in_own = voted[own]
            voted.sort()
            if np.sqrt(min(voted[max(bands - raised, 0)], in_own)) >= thresholds[steps]:
                return False, average, steps
        steps = min(steps + 1, thresholds.size - 1)
        for j in range(channels):
            for b in range(bands):
                average[j, b] += (0.5 * (power[k, 0, j, b] + power[k, 1, j, b]) - average[j, b]) / steps
    return True, average, steps
