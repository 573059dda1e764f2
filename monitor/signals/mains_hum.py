"""Hum of the mains in single channels or in all alike: a sinusoid of constant amplitude that is no motion of the structure."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from monitor.core import Array, ComplexArray
from monitor.signals.channel_faults import FALSE_RATE
from monitor.signals.welch import hann_amplitude

_MAINS_HZ = (50.0, 60.0)
"""Nominal frequencies of mains. [Hz; definition]"""
_TOLERANCE_HZ = 0.2
"""Largest deviation of the mains frequency. [Hz; EN 50160: within 1 % of 50 Hz for 99.5 % of a year, mostly within 0.2 Hz]"""
_HARMONICS = 6
"""Highest harmonic of the mains that is looked for: that of a six-pulse rectifier. [1; judgement]"""
_BACKGROUND_BINS = 20
"""Bins on each side of a line, beyond its leakage, from which the background is taken. [bins; judgement]"""
_GAIN_STD = 0.02
"""Differences of the channels' gains beside which a hum of all channels is alike. [ratio; judgement: data sheets]"""


@dataclass(frozen=True, slots=True)
class Hum:
    """Line of the mains that is no motion of the structure."""

    hz: float
    """Frequency as seen."""
    channel: int | None
    """Channel that has it; None for all channels alike."""
    mains_hz: float
    harmonic: int
    is_aliased: bool
    """Whether the harmonic lies above half the source's rate and is seen at its alias."""
    low_hz: float
    """Lower end of the frequencies that the line's leakage rules."""
    high_hz: float
    """Upper end of them."""


def find_hum(transforms: Annotated[ComplexArray, "segments bins c"], step_hz: float, rate_hz: float) -> tuple[Hum, ...]:
    """Find the hum of the mains in the transforms of a recording's segments.

    A line is hum where it lies at a harmonic of the mains or at its alias; where its power is constant over the segments, as that
    of a sinusoid is, while that of a mode's random response is exponentially distributed; and where it is in one channel alone or
    alike in all, and not in the proportions in which the structure moves at this frequency.  A single
    channel shows no proportions.

    Parameters
    ----------
    transforms
        From 0 Hz up, Hann taper.
    rate_hz
        Rate of the source.
    """
    if transforms.shape[2] < 2:
        return ()
    found: dict[float, Hum] = {}
    for mains_hz, harmonic, first, last in _candidates(rate_hz, step_hz, transforms.shape[1] - 2):
        power = (np.abs(transforms[:, first : last + 1]) ** 2).mean(axis=0)
        background = np.median(
            (np.abs(transforms[:, _around(first, last, transforms.shape[1])]) ** 2).mean(axis=0), axis=0
        )
        if not (background > 0.0).all():
            continue
        k = first + int((power / background).max(axis=1).argmax())
        line = _line(transforms, k, (last - first + 1) * transforms.shape[2])
        if line is None:
            continue
        channel, width = line
        is_aliased = 2.0 * harmonic * mains_hz > rate_hz
        ends = (k - width) * step_hz, (k + width) * step_hz
        found.setdefault(k * step_hz, Hum(k * step_hz, channel, mains_hz, harmonic, is_aliased, *ends))
    return tuple(found.values())


def harmonic_bins(rate_hz: float, step_hz: float, last_bin: int) -> list[tuple[float, int, int]]:
    """List the mains frequency, the first and the last bin of every harmonic, or of its alias at the source's rate."""
    return [(mains_hz, first, last) for mains_hz, _, first, last in _candidates(rate_hz, step_hz, last_bin)]


def _candidates(rate_hz: float, step_hz: float, last_bin: int) -> Iterator[tuple[float, int, int, int]]:
    """Yield the mains frequency, the harmonic, and its first and last bin as seen at a rate, low harmonics first."""
    for harmonic in range(1, _HARMONICS + 1):
        for mains_hz in _MAINS_HZ:
            alias_hz = abs(harmonic * mains_hz - rate_hz * round(harmonic * mains_hz / rate_hz))
            reach = harmonic * _TOLERANCE_HZ
            first, last = (int(np.rint((alias_hz + side * reach) / step_hz)) for side in (-1, 1))
            first, last = max(first, 1), min(last, last_bin)
            if first <= last:
                yield mains_hz, harmonic, first, last


def _around(first: int, last: int, n_bins: int) -> Array:
    """Return the indices of the background's bins on both sides of some bins."""
    below = np.arange(max(1, first - _BACKGROUND_BINS), first)
    above = np.arange(last + 1, min(n_bins, last + 1 + _BACKGROUND_BINS))
    return np.concatenate([below, above])


def _line(transforms: ComplexArray, k: int, tests: int) -> tuple[int | None, int] | None:
    """Tell of a hum in bin k its channel, None for all channels, and the half-width in bins of its leakage.

    None where there is no line, or where it may be the structure's motion.  `tests` bins and channels were looked at for it.
    """
    from scipy.special import gammaincc  # takes a while to load

    n, n_bins, c = transforms.shape
    at = transforms[:, k]
    spectrum = at.T @ at.conj() / n
    noise, width = _background(transforms, k, 3), 3
    for _ in range(2):  # a strong line leaks further, and its leakage is no background
        width = _leakage_bins(float((np.diag(spectrum) / np.diag(noise)).real.max()), n)
        if not len(_around(k - width, k + width, n_bins)):
            return None
        noise = _background(transforms, k, width)
    own = np.diag(noise).real
    excess = np.diag(spectrum).real / own - 1.0
    i = int(excess.argmax())
    if excess[i] <= 0.0 or constancy(np.abs(at[:, i]) ** 2, own[i]) < np.log(tests / FALSE_RATE):
        return None
    amplitude = (spectrum - noise)[:, i] / np.sqrt(excess[i] * own[i])
    others = np.arange(c) != i

    def explains(expected: ComplexArray, variance: Array) -> bool:
        """Test an amplitude of the other channels against the measured one (chi-squared)."""
        distance = float((np.abs(amplitude - expected)[others] ** 2 / variance[others]).sum())
        return bool(gammaincc(c - 1, distance) >= FALSE_RATE)

    if explains(noise[:, i] / own[i] * amplitude[i], own / n):  # as the structure moves at this frequency
        return None
    if explains(np.zeros(c, dtype=complex), own / n):
        return i, width
    alike = np.full(c, amplitude[i])
    return (None, width) if explains(alike, (own + own[i]) / n + np.abs(_GAIN_STD * alike) ** 2) else None


def _background(transforms: ComplexArray, k: int, width: int) -> Annotated[ComplexArray, "c c"]:
    """Average the cross-spectra of the bins around a line beyond its leakage."""
    around = transforms[:, _around(k - width, k + width, transforms.shape[1])].reshape(-1, transforms.shape[2])
    return np.asarray(around.T @ around.conj() / len(around))


def _leakage_bins(ratio: float, n: int) -> int:
    """Compute the bins from a line, `ratio` times the background, to where its leakage is within the spectrum's random error."""
    offsets = np.arange(2, 1000)
    leaked = ratio * (hann_amplitude(offsets.astype(float) - 0.5) / 0.5) ** 2
    return int(offsets[np.flatnonzero(leaked > 1.0 / np.sqrt(n))].max(initial=2)) + 1


def constancy(power: Annotated[Array, "segments"], noise: float) -> float:
    """Compute the log likelihood ratio of a sinusoid in noise against a random response, nats.

    The power of a sinusoid in noise has the distribution of Rice, that of a random response is exponential.
    `noise` is the mean power of the background.
    """
    from scipy.special import i0e  # takes a while to load

    line = max(float(power.mean()) - noise, 0.0)
    z = 2.0 * np.sqrt(line * power) / noise
    rice = -np.log(noise) - (power + line) / noise + np.log(i0e(z)) + z
    random = -np.log(power.mean()) - power / power.mean()
    return float((rice - random).sum())
