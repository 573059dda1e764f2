"""Compiled loops of the recognition of events: what every hop does while the motion is quiet."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, compiled


@compiled(error_model="numpy")
def tapered_frames(
    tail: Annotated[Array, "h c"], samples: Annotated[Array, "samples c"], taper: Annotated[Array, "n"]
) -> Annotated[Array, "c frames n"]:
    """Cut samples, after the half frame before them, into frames that overlap by half, each without its mean and tapered."""
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
def band_power(
    transforms: Annotated[NDArray[np.complex128], "c frames bins"], edges: Annotated[NDArray[np.int64], "b"], end: int
) -> Annotated[Array, "k 2 c b"]:
    """Sum the power of frames' transforms in each band; `edges` are the first bins of the bands, `end` the bin past the last."""
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
    power: Annotated[Array, "k 2 c b"],
    long_term: Annotated[Array, "c b"],
    steps: int,
    thresholds: Annotated[Array, "m+1"],
    own: int,
    raised: int,
    dead: float,
    tiny: float,
) -> tuple[bool, Annotated[Array, "c b"], int]:
    """Add steps to the long-term average, which holds `steps`, as long as nothing is above the threshold.

    `power` is that of the two frames of each step.  `thresholds` has that of the voted ratio for each number of steps in the
    average, `own` is the band that must be raised, and `raised` the number of bands that must be.  Below the share `dead` of the
    strongest channel's power a channel is dead; of less power than `tiny` no ratio is taken.  Return whether all channels were
    live and all frames below the threshold, and the average with its steps.
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
