"""Tapered Fourier transforms of half-overlapping segments, and how the taper blurs a spectrum."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np

from monitor.core import Array, ComplexArray


@dataclass(frozen=True, slots=True)
class SegmentDesign:
    """Where segments lie and which of their frequencies are kept."""

    rate_hz: float
    n: int
    """Samples in a segment; the next one starts half a segment later."""
    n_bins: int
    """Frequencies kept, from 0 up."""

    @property
    def step_hz(self) -> float:
        """Spacing of the frequencies."""
        return self.rate_hz / self.n


@lru_cache(maxsize=8)
def taper(n: int) -> Array:
    """Periodic Hann taper of unit energy, shape (n,)."""
    window = np.sin(np.pi * np.arange(n) / n) ** 2
    return np.asarray(window / np.sqrt((window**2).sum()))


def transform(design: SegmentDesign, samples: Array) -> ComplexArray:
    """Fourier transform of one segment, shape (n_bins, c).

    Scaled so that the mean of its outer product is the two-sided cross-spectral density (unit squared per Hz).
    """
    spectrum = np.fft.rfft(taper(design.n)[:, None] * samples, axis=0)[: design.n_bins]
    return np.asarray(spectrum / np.sqrt(design.rate_hz))


def overlap_correlation() -> float:
    """Correlation of spectral estimates from two segments that share half their samples.

    The squared tapers' product over their square: 3/70 for the Hann taper (P. D. Welch, IEEE Transactions on Audio and
    Electroacoustics 15 (1967) 70-73).
    """
    return 3.0 / 70.0


LEAKAGE_OFFSETS = np.arange(-3, 4)
"""Half bins over which the taper blurs; beyond them lies less than 1e-3 of the power. [half bins; Hann taper]"""


@cache
def leakage() -> Array:
    """Weight of the true spectrum at each of LEAKAGE_OFFSETS in the mean of a bin, shape (7,), summing to 1.

    The mean of a tapered periodogram is the spectrum convolved with the taper's power transfer (A. M. Sykulski et al.,
    The debiased Whittle likelihood, Biometrika 106 (2019) 251-266); half bins sample that convolution exactly, for
    covariances that die out within a segment.
    """
    amplitude = hann_amplitude(LEAKAGE_OFFSETS / 2.0)
    return np.asarray(amplitude**2 / (amplitude**2).sum())


def hann_amplitude(offset_bins: Array) -> Array:
    """Transform of the Hann taper at an offset in bins, over the segment's length: half of one line and a quarter of each
    neighbour, with opposite sign."""
    x = offset_bins
    return np.asarray(0.5 * np.sinc(x) + 0.25 * (np.sinc(x - 1.0) + np.sinc(x + 1.0)))
