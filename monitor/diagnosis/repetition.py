"""Repetition: a recording that repeats itself, as under a periodic shaker signal, holds no data that are new to a fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from monitor.diagnosis.lack_of_fit import LackOfFit
from monitor.diagnosis.verdict import Diagnosis
from monitor.inference import Segments, information_weight
from monitor.signals import FALSE_RATE


def find_repetition(segments: Segments) -> float | None:
    """Find the time after which a recording repeats itself, s; return None where it does not.

    Segments of one distance in time are compared, bin by bin and each with its phase.  All of them must repeat by the same delay,
    over at least half the recording and in more than half of the spectrum.  Every bin and every segment counts alike, so that
    neither a tone, a mode nor a strong motion repeats by itself.  A gap between the segments is no matter.

    References
    ----------
    J. Schoukens, L. Ljung, Nonlinear System Identification: A User-Oriented Road Map, IEEE Control Systems 39 (2019) 28
    (periodic excitation, and validation by another realization of it).
    """
    scale = np.sqrt(np.maximum((np.abs(segments.values) ** 2).mean(axis=0), np.finfo(float).tiny))
    white = segments.values / scale
    white /= np.maximum(np.linalg.norm(white, axis=(1, 2), keepdims=True), np.finfo(float).tiny)
    n, n_bins, _ = white.shape
    hop_s = float(np.diff(segments.t_s).min())
    place = np.rint((segments.t_s - segments.t_s[0]) / hop_s).astype(int)
    at = np.full(place[-1] + 1, -1)
    at[place] = np.arange(n)
    nearest = int(np.ceil(1.0 / (segments.band.bin_hz * hop_s) - 1e-6))  # segments that share no sample
    for distance in range(nearest, at.size // 2 + 1):
        one, other = at[:-distance], at[distance:]
        both = (one >= 0) & (other >= 0)
        one, other = one[both], other[both]
        if one.size == 0:
            continue
        cross = np.einsum("sfc,sfc->f", white[one].conj(), white[other])
        delays = np.fft.ifft(cross, 4 * n_bins) * 4 * n_bins
        i = int(np.abs(delays).argmax())
        # Of random motion the share has Rayleigh's distribution.
        chance = np.sqrt(np.log(delays.size * at.size / FALSE_RATE) / (one.size * n_bins * information_weight()))
        if np.abs(delays[i]) > max(0.5, chance) * one.size:
            lag = (i if i < 2 * n_bins else i - 4 * n_bins) / (4 * n_bins * segments.band.bin_hz)
            return float(distance * hop_s + lag)
    return None


def state_repetition(diagnosis: Diagnosis, period_s: float) -> Diagnosis:
    """State of causes in a recording that repeats itself that none of them is confirmed."""
    if diagnosis.verdict == "none":
        return diagnosis
    says = (
        f"the recording repeats itself every {period_s:.3g} s, so that no part of it is new to a fit to the rest and no cause is "
        "confirmed: record with forces that do not repeat"
    )
    seen = LackOfFit("whole recording", 0.0, says, is_explained=True)
    return replace(diagnosis, verdict="unexplained", left_over=(seen, *diagnosis.left_over))
