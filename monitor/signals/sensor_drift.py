"""Drift of a sensor: a slow wander that one channel has alone, and how far up its spectrum rules."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from monitor.core import Array, ComplexArray

_FIRST_BIN = 2
"""Lowest bin that a constant offset does not reach. [bins; definition: Hann taper]"""
_SMOOTHED_BINS = 20
"""Bins over which a noise floor is averaged. [bins; judgement]"""


@dataclass(frozen=True, slots=True)
class Drift:
    """Drift of one channel."""

    channel: int
    exponent: float
    """Exponent with which its power falls as the frequency rises; 2 for a random walk."""
    end: int
    """First bin that the drift does not rule."""


def find_drift(transforms: ComplexArray, first: int) -> tuple[Drift, ...]:
    """Find the channels whose drift reaches into the compared band.

    The part of a channel that no other channel shares is white noise below the band, or falls as a power of the frequency where
    the sensor drifts.  The power law fitted there is continued into the band.  It rules the bins where it exceeds the random
    error of the channel's spectrum.

    Parameters
    ----------
    transforms : ndarray, shape (n_segments, n_bins, c)
        From 0 Hz up, Hann taper.
    first : int
        First bin of the band.

    Returns
    -------
    tuple of Drift
        None where too few bins or segments show a law.
    """
    n, n_bins, c = transforms.shape
    if first < _FIRST_BIN + c or n <= 2 * c or n_bins <= first + _SMOOTHED_BINS:
        return ()
    own, unshared = _spectra(transforms)
    k, found = np.arange(n_bins), []
    below = slice(_FIRST_BIN, first)
    for channel in range(c):
        alone = unshared[:, channel]
        if not (alone[_FIRST_BIN:] > 0.0).all():
            continue
        slope, level = np.polyfit(np.log(k[below]), np.log(alone[below]), 1)
        floor = np.convolve(alone[first:], np.ones(_SMOOTHED_BINS) / _SMOOTHED_BINS, mode="valid").min()
        drift = np.exp(level + slope * np.log(k[first:])) - floor
        ruled = drift > own[first:, channel] / np.sqrt(n)
        if slope < 0.0 and ruled[0]:
            length = int(np.argmin(ruled)) if not ruled.all() else ruled.size
            found.append(Drift(channel, float(-slope), first + length))
    return tuple(found)


def _spectra(transforms: ComplexArray) -> tuple[Array, Array]:
    """Compute each channel's power density, and of that what is not coherent with the other channels, shapes (n_bins, c)."""
    spectra = np.einsum("ska,skb->kab", transforms, transforms.conj()) / transforms.shape[0]
    own = np.einsum("kaa->ka", spectra).real
    scale = np.sqrt(np.maximum(own, np.finfo(float).tiny))
    coherence = spectra / (scale[:, :, None] * scale[:, None, :])
    inverse = np.linalg.inv(coherence + 1e-12 * np.eye(transforms.shape[2]))
    return own, own / np.einsum("kaa->ka", inverse).real
