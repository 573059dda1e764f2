"""What the channels' coherence and phase tell without a model: clocks that drift apart, delays, copies; and folded power.

References
----------
J. S. Bendat, A. G. Piersol, Random Data, 4th ed., 2010, section 9.2: variance of the phase of a cross-spectrum.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import Annotated

import numpy as np

from monitor.core import Array, ComplexArray
from monitor.signals.channel_faults import FALSE_RATE
from monitor.signals.welch import overlap_correlation

_LEAST_COHERENCE = 0.5
"""Coherence of two channels from which a bin tells their phase. [1; judgement]"""
_LEAST_DELAY = 0.1
"""Least delay that is told. [samples; judgement: shapes that are slightly complex look like less]"""
_DELAY_STRETCHES = 8
"""Stretches of a recording in each of which a delay is measured. [count; judgement]"""
_LEAST_STRETCHES = 2.0
"""Stretches in which a frequency moves, from which its phase tells a drift. [count; definition]"""
_LEAST_STRETCH_SEGMENTS = 4
"""Segments in a stretch from which its coherence means something. [count; judgement]"""
_COPY_INCOHERENCE = 1e-6
"""Incoherent share of two channels' power, in the median of all bins, below which one is a copy of the other. [1; judgement:
two sensors have noise of their own]"""
_TOP_SHARE = 0.05
"""Share of the band below half the rate in which folded power is looked for. [1; judgement]"""


@dataclass(frozen=True, slots=True)
class Delay:
    """Delay of one channel against another one, by the slope of their phase."""

    channel: int
    against: int
    delay_s: float
    """Mean delay."""
    delay_std_s: float
    drift: float
    """Rate at which the delay grows, s per s: the difference of two clocks; 0 where it is chance."""
    drift_std: float


def find_delays(
    transforms: Annotated[ComplexArray, "segments bins c"],
    step_hz: float,
    rate_hz: float,
    middles_s: Annotated[Array, "segments"],
) -> tuple[Delay, ...]:
    """Find the channels whose delay against the channel most coherent with them grows, or differs from zero.

    Modes turn the phase between two channels by half a turn, whatever the frequency; a delay turns it in proportion to the
    frequency.  Only what is significant among all channels by the scatter between ranges of frequency is told, and only where the
    lower and the upper frequencies, and the first and the second half of the time, show it each by itself and agree: a shaker's
    sweep, or complex shapes, turn phases too, but not alike.  Frequencies that move once, as in a sweep, show no drift.
    Segments overlap by half, from 0 Hz up, Hann taper.
    """
    from scipy.special import stdtrit  # takes a while to load

    n, _, c = transforms.shape
    per = n // _DELAY_STRETCHES
    if c < 2 or per < _LEAST_STRETCH_SEGMENTS:
        return ()
    stretches = transforms[: per * _DELAY_STRETCHES].reshape(_DELAY_STRETCHES, per, *transforms.shape[1:])[:, 1:]
    times = middles_s[: per * _DELAY_STRETCHES].reshape(_DELAY_STRETCHES, per, 1)[:, 1:]
    coherence = _coherence(np.einsum("tska,tskb->kab", stretches, stretches.conj()))
    informative = np.clip(coherence, 0.0, 1.0 - 1e-9)
    informative = np.where(coherence >= _LEAST_COHERENCE, informative / (1.0 - informative), 0.0)
    informative[0] = 0.0
    total = informative.sum(axis=0) * (1.0 - np.eye(c))
    limit = float(stdtrit(_DELAY_STRETCHES - 1.0, 1.0 - FALSE_RATE / (4.0 * c)))
    found = []
    for a in range(c):
        b = int(total[a].argmax())
        if a > b and int(total[b].argmax()) == a:  # the same pair
            continue
        bins = np.flatnonzero(informative[:, a, b])
        if len(bins) < 2:
            continue
        omega = np.asarray(2.0 * np.pi * step_hz * bins, dtype=float)
        # Of a phase, by Bendat and Piersol; neighbouring bins share half their data.
        weight = np.asarray(per / (1.0 + 2.0 * overlap_correlation()) * informative[bins, a, b])
        products = stretches[..., bins, a] * stretches[..., bins, b].conj()
        size = np.maximum(np.abs(products), 1e-300)
        at = (size * times).sum(axis=1) / size.sum(axis=1)
        cross = products.mean(axis=1)
        phases = _Phases(cross, at, omega, weight * np.abs(cross) / np.maximum(np.abs(cross).mean(axis=0), 1e-300))
        delay, parts = _delay(phases), [_delay(part) for part in phases.parts()]
        size_s, told = (
            abs(delay.drift) * float(np.ptp(middles_s)),
            [(one.drift, one.drift_std) for one in (delay, *parts)],
        )
        if abs(delay.drift) <= limit * delay.drift_std:
            size_s, told = abs(delay.delay_s), [(one.delay_s, one.delay_std_s) for one in (delay, *parts)]
            delay = replace(delay, drift=0.0)
        if size_s > _LEAST_DELAY / rate_hz and _is_told(told, limit):
            found.append(replace(delay, channel=a, against=b))
    return tuple(found)


def _coherence(spectra: Annotated[ComplexArray, "bins c c"]) -> Annotated[Array, "bins c c"]:
    """Compute the coherence of every two channels from their cross-spectra."""
    power = np.einsum("kaa->ka", spectra).real
    return np.asarray(np.abs(spectra) ** 2 / np.maximum(power[:, :, None] * power[:, None, :], 1e-300))


@dataclass(frozen=True, eq=False, slots=True)
class _Phases:
    """What tells the phase between two channels in stretches of a recording."""

    cross: Annotated[ComplexArray, "stretches k"]
    """Cross-spectra."""
    at: Annotated[Array, "stretches k"]
    """Middle of what moved at a frequency in a stretch, s."""
    omega: Annotated[Array, "k"]
    told: Annotated[Array, "stretches k"]
    """One over the variance of a phase: what is told of a frequency goes with the share of its motion in a stretch."""

    def parts(self) -> tuple[_Phases, ...]:
        """Return the lower and the upper frequencies, of equal information, and the first and the second half of the time."""
        information = np.cumsum(self.told.sum(axis=0) * self.omega**2)
        middle = int(np.clip(np.searchsorted(information, 0.5 * information[-1]), 1, len(information) - 1))
        s, every = len(self.cross) // 2, slice(None)
        cuts = (every, slice(middle)), (every, slice(middle, None)), (slice(s), every), (slice(s, None), every)
        return tuple(_Phases(self.cross[t, k], self.at[t, k], self.omega[k], self.told[t, k]) for t, k in cuts)


def _is_told(values: Sequence[tuple[float, float]], limit: float) -> bool:
    """Test that a value and those of two pairs of disjoint parts differ from zero alike, each by more than chance."""
    (_, *parts), signs = values, {np.sign(value) for value, _ in values}
    agree = all(abs(a - b) <= limit * np.hypot(a_std, b_std) for (a, a_std), (b, b_std) in (parts[:2], parts[2:]))
    return len(signs) == 1 and agree and all(abs(value) > limit * std for value, std in values)


def _delay(phases: _Phases) -> Delay:
    """Measure delay and drift from the cross-spectra of the stretches, and of all of them."""
    cross, at, omega, told = phases.cross, phases.at, phases.omega, phases.told
    # Up to half turns, which are the modes' own.
    weight, slope = told.sum(axis=0), -0.5 * np.angle(cross.mean(axis=0) ** 2)
    delay = float(slope @ (weight * omega)) / float(weight @ omega**2)
    delay_std = _scatter(weight[None], omega[None], (slope - delay * omega)[None])
    # A frequency's phase is the shape's, and a clock turns it in time; that moves once, as in a sweep, tells none.
    again = weight**2 > _LEAST_STRETCHES * (told**2).sum(axis=0)
    if not again.any():
        return Delay(0, 0, delay, delay_std, 0.0, inf)
    cross, at, omega, told = cross[:, again], at[:, again], omega[again], told[:, again]
    # From one stretch to the next the phase turns by less than half a turn.
    fastest = np.pi * (len(cross) - 1) / (np.ptp(at.mean(axis=1)) * omega.max())
    tried = np.linspace(-fastest, fastest, _DELAY_STRETCHES * len(cross) + 1)
    unit, turn = np.sign(cross), 1j * at * omega
    drift = float(max(tried, key=lambda d: np.abs((told * unit * np.exp(d * turn)).sum(axis=0)).sum()))
    lever = (at - (told * at).sum(axis=0) / told.sum(axis=0)) * omega
    for _ in range(3):  # by least squares from there
        straight = unit * np.exp(drift * turn)
        rest = np.angle(straight * (told * straight).sum(axis=0).conj())
        drift -= float((told * lever * rest).sum() / (told * lever**2).sum())
    return Delay(0, 0, delay, delay_std, drift, _scatter(told, lever, rest))


def _scatter(told: Array, lever: Array, rest: Array) -> float:
    """Estimate the standard deviation of a slope from what it leaves over in disjoint ranges of frequency, or of chance.

    Complex shapes, and forces that change, turn the phase in neighbouring bins alike.
    """
    information = (told * lever**2).sum(axis=0)
    total = max(float(information.sum()), 1e-300)
    at = np.minimum(np.cumsum(information) / total * _DELAY_STRETCHES, _DELAY_STRETCHES - 1).astype(int)
    pulls = np.bincount(at, (told * lever * rest).sum(axis=0))
    excess = max(1.0, float((told * rest**2).sum()) / max(1, max(1, len(rest) - 1) * rest.shape[1] - 1))
    return float(np.sqrt(max(excess * total, pulls @ pulls * _DELAY_STRETCHES / (_DELAY_STRETCHES - 1)))) / total


def find_copies(transforms: Annotated[ComplexArray, "segments bins c"]) -> tuple[tuple[int, int], ...]:
    """List the pairs of channels one of which is a copy of the other."""
    coherence = _coherence(np.einsum("ska,skb->kab", transforms, transforms.conj()))
    middle = np.median(1.0 - coherence[1:], axis=0)
    pairs = np.argwhere(np.triu(middle < _COPY_INCOHERENCE, 1)) if len(transforms) > 1 else ()
    return tuple((int(a), int(b)) for a, b in pairs)


def folded_share(power: Annotated[Array, "bins c"]) -> Annotated[Array, "c"]:
    """Compare the power density just below half the rate with the median of the upper half of the band.

    A lowpass before the samples were taken leaves next to nothing there; about 1 means that none was at work.
    """
    return np.asarray(top_density(power) / np.maximum(np.median(power[len(power) // 2 :], axis=0), 1e-300))


def top_density(power: Annotated[Array, "bins c"]) -> Annotated[Array, "c"]:
    """Average the power density just below half the rate."""
    n = len(power)
    return np.asarray(power[n - max(1, round(_TOP_SHARE * n)) :].mean(axis=0))
