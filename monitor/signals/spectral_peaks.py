"""Peaks of spectra that stand out beyond chance, whether or not a mode is identified there."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from monitor.core import ComplexArray
from monitor.signals.channel_faults import FALSE_RATE
from monitor.signals.welch import MAIN_LOBE_BINS, overlap_correlation


def find_peaks(transforms: Annotated[ComplexArray, "segments bins c"], first: int = 1) -> tuple[int, ...]:
    """Find the bins, from `first` on, at which a channel's spectrum has a peak.

    A peak stands above the lowest bins on both sides of it, as far as the next higher one, by more than the ratio of two
    estimates of one density would reach by chance for any two bins of any channel: by the F distribution.  The transforms are
    of half-overlapping segments from 0 Hz up, Hann taper.
    """
    from scipy.signal import find_peaks as prominent  # takes a third of a second to load
    from scipy.special import fdtri

    n, _, c = transforms.shape
    power = (np.abs(transforms[:, first:]) ** 2).mean(axis=0)
    degrees = 2.0 * n / (1.0 + 2.0 * overlap_correlation())
    least = -np.log(fdtri(degrees, degrees, FALSE_RATE / (c * max(1, len(power)) ** 2)))
    found: dict[int, float] = {}
    for channel in power.T:
        if (channel > 0.0).all():
            at, shown = prominent(np.log(channel), prominence=least)
            for k, height in zip(at.tolist(), shown["prominences"].tolist(), strict=True):
                found[k] = max(height, found.get(k, 0.0))
    kept: list[int] = []
    for k in sorted(found, key=lambda k: -found[k]):
        if all(abs(k - other) > MAIN_LOBE_BINS for other in kept):
            kept.append(k)
    return tuple(first + k for k in sorted(kept))
