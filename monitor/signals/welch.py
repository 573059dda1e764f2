"""Tapered Fourier transforms of half-overlapping segments, and the spectral leakage of the taper."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Annotated

import numpy as np

from monitor.core import Array, ComplexArray


@dataclass(frozen=True, slots=True)
class SegmentDesign:
    """Length, spacing and kept frequencies of the segments.

    Examples
    --------
    >>> SegmentDesign(rate_hz=100.0, n=2000, n_bins=801).step_hz
    0.05
    """

    rate_hz: float
    n: int
    """Samples in a segment; the next one starts half a segment later."""
    n_bins: int
    """Number of frequencies kept, from 0 Hz up."""

    @property
    def step_hz(self) -> float:
        """Spacing of the frequencies, Hz."""
        return self.rate_hz / self.n


@lru_cache(maxsize=8)
def taper(n: int) -> Annotated[Array, "n"]:
    """Return the periodic Hann taper of unit energy.

    Examples
    --------
    >>> round(float((taper(1000) ** 2).sum()), 9)
    1.0
    """
    window = np.sin(np.pi * np.arange(n) / n) ** 2
    return np.asarray(window / np.sqrt((window**2).sum()))


def transform(design: SegmentDesign, samples: Annotated[Array, "n c"]) -> Annotated[ComplexArray, "bins c"]:
    """Compute the tapered Fourier transform of one segment, m/s^2 to m/s^2/sqrt(Hz).

    The mean of its outer product is the two-sided cross-spectral density (unit squared per Hz).
    """
    spectrum = np.fft.rfft(taper(design.n)[:, None] * samples, axis=0)[: design.n_bins]
    return np.asarray(spectrum / np.sqrt(design.rate_hz))


def overlap_correlation() -> float:
    """Return the correlation of spectral estimates from two segments that share half their samples.

    It is the sum of products of the squared tapers over the sum of their squares: 3/70 for the Hann taper.

    References
    ----------
    P. D. Welch, IEEE Transactions on Audio and Electroacoustics 15 (1967) 70-73.
    """
    return 3.0 / 70.0


def bin_correlation() -> float:
    """Return the sum of the squared correlations of a bin's estimate with those of all bins: 35/18 for the Hann taper.

    Neighbours are correlated as the transform of the squared taper, a line of three coefficients convolved with itself.
    """
    line = np.array([-0.25, 0.5, -0.25])
    squared = np.convolve(line, line)
    return float((squared / squared.max()) @ (squared / squared.max()))


MAIN_LOBE_BINS = 2
"""Half width of the taper's main lobe: what lies further apart is told apart. [bins; definition: Hann taper]"""
LEAKAGE_OFFSETS = np.arange(-3, 4)
"""Half bins over which the taper blurs; beyond them lies less than 1e-3 of the power. [half bins; Hann taper]"""


@cache
def leakage() -> Annotated[Array, "7"]:
    """Return the weights of the true spectrum at LEAKAGE_OFFSETS in the mean of a bin, summing to 1.

    The mean of a tapered periodogram is the spectrum convolved with the taper's power transfer.  Half bins sample that
    convolution exactly, for covariances that die out within a segment.

    References
    ----------
    A. M. Sykulski et al., The debiased Whittle likelihood, Biometrika 106 (2019) 251-266.
    """
    amplitude = hann_amplitude(LEAKAGE_OFFSETS / 2.0)
    return np.asarray(amplitude**2 / (amplitude**2).sum())


def hann_amplitude(offset_bins: Array) -> Array:
    """Evaluate the Fourier transform of the Hann taper over the segment's length, at offsets in bins.

    The transform is half of one line and a quarter of each neighbour, with opposite sign.
    """
    x = offset_bins
    return np.asarray(0.5 * np.sinc(x) + 0.25 * (np.sinc(x - 1.0) + np.sinc(x + 1.0)))
