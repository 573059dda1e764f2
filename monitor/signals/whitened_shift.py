"""Where readings fit a reference, as of clocks that do not agree."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from monitor.core import Array

_LEAST_CROSS = 1e-6
"""Part of the largest cross-spectrum below which a frequency counts less. [ratio; rounding]"""


@dataclass(frozen=True, slots=True)
class Shift:
    """Shift at which readings fit a reference best, and the next best one."""

    shift: int
    """Place of the first reading in the reference, steps; negative if it lies before."""
    correlation: float
    """Whitened correlation there; negative for a sensor that was mounted the other way round."""
    other: int
    """Next best shift, not beside the best one, steps."""
    other_correlation: float


def best_shift(reference: Annotated[Array, "n"], readings: Annotated[Array, "m"]) -> Shift:
    """Find the shift at which readings fit a reference best, by the correlation of both whitened (phase transform).

    All frequencies count alike: by the plain correlation a structure's record fits itself once a period of its mode.
    Reference and readings are on the same step and without mean; lost ones are 0 (Knapp and Carter, IEEE Trans. ASSP 24, 1976).

    Examples
    --------
    >>> noise = np.random.default_rng(0).normal(size=1000)
    >>> best_shift(noise, noise[300:900]).shift
    300
    """
    from scipy.fft import irfft, next_fast_len, rfft

    n = next_fast_len(len(reference) + len(readings), real=True)
    cross = rfft(reference, n) * np.conj(rfft(readings, n))
    size = np.abs(cross)
    if not size.any():
        return Shift(0, 0.0, 0, 0.0)
    white = cross / np.maximum(size, _LEAST_CROSS * size.max())
    correlation = irfft(white, n) * (n / (2.0 * np.abs(white).sum()))
    best = int(np.argmax(np.abs(correlation)))
    apart = np.abs(correlation)
    apart[np.arange(best - 1, best + 2) % n] = 0.0  # a delay of half a sample shows at both
    other = int(np.argmax(apart))
    return Shift(
        *(best if best < len(reference) else best - n, float(correlation[best])),
        *(other if other < len(reference) else other - n, float(correlation[other])),
    )
