"""What the channels' coherence and phase tell without a model: clocks that drift apart, delays, copies; and folded power.

References
----------
J. S. Bendat, A. G. Piersol, Random Data, 4th ed., 2010, section 9.2: variance of the phase of a cross-spectrum.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from monitor.core import Array, ComplexArray
from monitor.signals.channel_faults import FALSE_RATE
from monitor.signals.welch import bin_correlation, overlap_correlation

_LEAST_COHERENCE = 0.5
"""Coherence of two channels from which a bin tells their phase. [1; judgement]"""
_LEAST_DELAY = 0.1
"""Least delay that is told. [samples; judgement: shapes that are slightly complex look like less]"""
_DELAY_STRETCHES = 8
"""Stretches of a recording in each of which a delay is measured. [count; judgement]"""
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
    transforms: Annotated[ComplexArray, "segments bins c"], step_hz: float, rate_hz: float, stretch_s: float
) -> tuple[Delay, ...]:
    """Find the channels whose delay against the channel most coherent with them grows, or differs from zero.

    Modes turn the phase between two channels by half a turn, whatever the frequency; a delay turns it in proportion to the
    frequency.  Only what is significant among all channels is told, and only where the lower and the upper frequencies, and the
    first and the second half of the time, show it each by itself and agree: a shaker's sweep, or complex shapes, turn phases too,
    but not alike.

    Parameters
    ----------
    transforms
        Half-overlapping, from 0 Hz up, Hann taper.
    stretch_s
        Time that the segments span.
    """
    from scipy.special import stdtrit  # takes a while to load

    n, _, c = transforms.shape
    per = n // _DELAY_STRETCHES
    if c < 2 or per < _LEAST_STRETCH_SEGMENTS:
        return ()
    spectra = np.array(
        [
            np.einsum("ska,skb->kab", part, part.conj()) / per
            for part in transforms[: per * _DELAY_STRETCHES].reshape(_DELAY_STRETCHES, per, *transforms.shape[1:])
        ]
    )
    whole = spectra.mean(axis=0)
    coherence = _coherence(whole)
    informative = np.clip(coherence, 0.0, 1.0 - 1e-9)
    informative = np.where(coherence >= _LEAST_COHERENCE, informative / (1.0 - informative), 0.0)
    informative[0] = 0.0
    total = informative.sum(axis=0) * (1.0 - np.eye(c))
    found = []
    for a in range(c):
        b = int(total[a].argmax())
        if a > b and int(total[b].argmax()) == a:  # the same pair
            continue
        bins = np.flatnonzero(informative[:, a, b])
        if len(bins) < 2:
            continue
        # Student's quantile: fewer bins tell less of how uncertain their delay is.
        limit = float(stdtrit(len(bins) / bin_correlation() - 1.0, 1.0 - FALSE_RATE / (4.0 * c)))
        independent = per / (1.0 + 2.0 * overlap_correlation())
        omega = np.asarray(2.0 * np.pi * step_hz * bins, dtype=float)
        # Of a phase, by Bendat and Piersol; neighbouring bins share half their data.
        weight = np.asarray(0.5 * 2.0 * independent * informative[bins, a, b])
        phases = _Phases(spectra[:, bins, a, b], omega, weight, stretch_s)
        delay, parts = _delay(phases), [_delay(part) for part in phases.parts()]
        drifts = _is_told([(one.drift, one.drift_std) for one in (delay, *parts)], limit)
        drifts = drifts and abs(delay.drift) > _LEAST_DELAY / (rate_hz * stretch_s)
        late = abs(delay.delay_s) > _LEAST_DELAY / rate_hz
        if drifts or (late and _is_told([(one.delay_s, one.delay_std_s) for one in (delay, *parts)], limit)):
            found.append(replace(delay, channel=a, against=b, drift=delay.drift if drifts else 0.0))
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
    omega: Annotated[Array, "k"]
    weight: Annotated[Array, "k"]
    """One over the variance of a stretch's phase."""
    stretch_s: float
    """Time that all stretches span."""

    def parts(self) -> tuple[_Phases, _Phases, _Phases, _Phases]:
        """Return the lower and the upper frequencies, of equal information, and the first and the second half of the time."""
        information = np.cumsum(self.weight * self.omega**2)
        middle = int(np.clip(np.searchsorted(information, 0.5 * information[-1]), 1, len(information) - 1))
        s = len(self.cross) // 2
        low, high = (
            replace(self, cross=self.cross[:, k], omega=self.omega[k], weight=self.weight[k])
            for k in (slice(0, middle), slice(middle, None))
        )
        first, second = (
            replace(self, cross=part, stretch_s=0.5 * self.stretch_s) for part in np.split(self.cross, [s])
        )
        return low, high, first, second


def _is_told(values: Sequence[tuple[float, float]], limit: float) -> bool:
    """Test that a value and those of two pairs of disjoint parts differ from zero alike, each by more than chance."""
    (_, *parts), signs = values, {np.sign(value) for value, _ in values}
    pairs = (parts[:2], parts[2:])
    agree = all(abs(a - b) <= limit * np.hypot(a_std, b_std) for (a, a_std), (b, b_std) in pairs)
    return len(signs) == 1 and agree and all(abs(value) > limit * std for value, std in values)


def _delay(phases: _Phases) -> Delay:
    """Measure delay and drift from the cross-spectra of the stretches, and of all of them."""
    cross, omega, weight, stretch_s = phases.cross, phases.omega, phases.weight, phases.stretch_s
    information = float(weight @ omega**2)
    # From one stretch to the next the phase turns by less than half a turn, unless the clocks differ by much.
    turned = np.angle(cross[1:] * cross[:-1].conj())
    steps = -(turned @ (weight * omega)) / information
    s = len(cross)
    at = (np.arange(s) - 0.5 * (s - 1)) * stretch_s / s
    growing = np.concatenate([[0.0], np.cumsum(steps)])
    drift = float(at @ growing / (at @ at))
    rest = turned + np.diff(at)[:, None] * drift * omega
    excess = max(1.0, 0.5 * float((rest**2 @ weight).mean()) / len(omega))
    drift_std = float(np.sqrt(excess / (information * float(at @ at))))
    # Up to half turns, which are the modes' own.
    slope = -0.5 * np.angle(cross.mean(axis=0) ** 2)
    delay = float(slope @ (weight * omega)) / information
    scatter = slope - delay * omega
    # Shapes that are complex, and forces, add to chance.
    excess = max(1.0, float(weight @ scatter**2) * s / max(1, len(omega) - 1))
    return Delay(0, 0, delay, float(np.sqrt(excess / (information * s))), drift, drift_std)


def find_copies(transforms: Annotated[ComplexArray, "segments bins c"]) -> tuple[tuple[int, int], ...]:
    """List the pairs of channels one of which is a copy of the other."""
    coherence = _coherence(np.einsum("ska,skb->kab", transforms, transforms.conj()))
    middle = np.median(1.0 - coherence[1:], axis=0)
    c = transforms.shape[2]
    return tuple(
        (a, b) for a in range(c) for b in range(a + 1, c) if len(transforms) > 1 and middle[a, b] < _COPY_INCOHERENCE
    )


def folded_share(power: Annotated[Array, "bins c"]) -> Annotated[Array, "c"]:
    """Compare the power density just below half the rate with the median of the upper half of the band.

    A lowpass before the samples were taken leaves next to nothing there; about 1 means that none was at work.
    """
    return np.asarray(top_density(power) / np.maximum(np.median(power[len(power) // 2 :], axis=0), 1e-300))


def top_density(power: Annotated[Array, "bins c"]) -> Annotated[Array, "c"]:
    """Average the power density just below half the rate."""
    n = len(power)
    return np.asarray(power[n - max(1, round(_TOP_SHARE * n)) :].mean(axis=0))
