"""Recognition of events: a short-term average over a long-term one, in bands of half an octave, voted by the floors.

A frame is 2 s of samples, and one begins each second.  Its power in every band and channel is divided by the long-term average of
that band and channel, so that neither a lightly damped mode nor a channel's noise decides alone.  More than half of the live
channels must show the same band raised (the lower median over channels).  Three bands must be raised (the third largest over
bands), and among them that of the structure's lowest frequency.  So one knocked, dead or disturbed sensor, a machine's line, or
doors and people, who shake floors at higher frequencies, are no motion of the whole structure.  A spike or a step touches two
frames; an event takes three in a row.

As long as the long-term average holds less than 60 s, its own scatter is larger, and the threshold higher: stationary Gaussian
motion exceeds it as rarely as it exceeds `ratio_on` later (`_early_factor`).

References
----------
R. V. Allen, Automatic earthquake recognition and timing from single traces, BSSA 68 (1978) 1521-1532 (STA/LTA).
A. Trnkoczy, Understanding and parameter setting of STA/LTA trigger algorithm, NMSOP-2 (2012), IS 8.1 (averages of some seconds
and 60 s, threshold 4, the long-term average frozen during a trigger, votes of the channels).
T. Goforth, E. Herrin, An automatic seismic signal detection algorithm based on the Walsh transform, BSSA 71 (1981) 1351-1360
(weights from the noise's own spectrum).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array
from monitor.events.settings import EventSettings

STEP_S = 2.0
"""Length of a frame, the short-term average, and of the samples of one step. [s; Trnkoczy 2012: some periods of the signal]"""
_LONG_TERM_S = 60.0
"""Time constant of the long-term average. [s; Trnkoczy 2012]"""
_RAISED_BANDS = 3
"""Bands of half an octave that must be raised together. [count; earthquakes span more than an octave, a machine's line or one
mode does not]"""
FRAMES_IN_A_ROW = 3
"""Frames in a row that make an event. [count; a spike touches two]"""
DEAD = 1e-6
"""Share of the power of the strongest channel below which a channel is dead and has no vote. [ratio; -60 dB]"""
_FRAMES = 2
"""Frames that one step of samples completes. [count; definition: they overlap by half]"""


@dataclass(frozen=True, eq=False, slots=True)
class RecognitionState:
    """State between steps of samples."""

    tail: Array
    """Shape (n, c): the latest half of a frame, m/s^2."""
    long_term: Array
    """Shape (c, b): long-term average of the power in each band, in arbitrary units."""
    steps: int = 0
    """Steps in the long-term average."""
    raised: int = 0
    """Frames in a row above the threshold."""


@dataclass(frozen=True, eq=False, slots=True)
class Trigger:
    """What two frames say, in order; frame k begins ``(k - 1) / 2`` frames after the step's first sample."""

    on: NDArray[np.bool_]
    """Shape (2,): whether this and the two frames before are above the threshold."""
    loud: NDArray[np.bool_]
    """Shape (2,): whether the frame is above the threshold that ends an event."""


@dataclass(frozen=True, eq=False, slots=True)
class _Bands:
    """Taper of a frame, and the first bin of each band of half an octave."""

    taper: Array
    edges: NDArray[np.int64]
    end: int
    """Bin past the last."""


@lru_cache(maxsize=8)
def _bands(n: int, rate_hz: float, cutoff_hz: float) -> _Bands:
    """Design the bands of frames of `n` samples, from the first bin up to `cutoff_hz` (Hz)."""
    bin_hz = rate_hz / n
    last = max(_RAISED_BANDS, int(cutoff_hz / bin_hz))
    edges = np.unique(np.round(2.0 ** np.arange(0.0, np.log2(last), 0.5)).astype(np.int64))
    return _Bands(np.hanning(n + 1)[:n], edges, last + 1)


def step_n(rate_hz: float) -> int:
    """Return the samples of one step, an even number."""
    return 2 * max(8, round(0.5 * STEP_S * rate_hz))


def start(n_channels: int, rate_hz: float, cutoff_hz: float) -> RecognitionState:
    """Return the state before the first sample."""
    n = step_n(rate_hz)
    n_bands = _bands(n, rate_hz, cutoff_hz).edges.size
    return RecognitionState(np.zeros((n // 2, n_channels)), np.zeros((n_channels, n_bands)))


def step(
    state: RecognitionState,
    span: Array,
    rate_hz: float,
    cutoff_hz: float,
    lowest_hz: float,
    settings: EventSettings,
    *,
    active: bool,
) -> tuple[RecognitionState, Trigger]:
    """Compare the two frames that a step of samples completes with the long-term average.

    Parameters
    ----------
    state : RecognitionState
    span : ndarray, shape (`step_n`, c), m/s^2
        The next conditioned samples.
    rate_hz, cutoff_hz : float
        Rate and cutoff of the samples.
    lowest_hz : float
        Lowest frequency of the structure.
    active : bool
        Whether an event is going on: the long-term average then stays as it is.

    Returns
    -------
    RecognitionState
    Trigger

    Examples
    --------
    >>> import numpy as np
    >>> settings, rng = EventSettings(), np.random.default_rng(0)
    >>> state, found = start(3, 100.0, 40.0), []
    >>> for level in [1.0] * 40 + [20.0] * 3:
    ...     span = level * rng.standard_normal((200, 3))
    ...     state, trigger = step(state, span, 100.0, 40.0, 2.0, settings, active=False)
    ...     found.append(trigger)
    >>> bool(found[39].on.any()), bool(found[-1].on.all())
    (False, True)
    """
    n = span.shape[0]
    bands = _bands(n, rate_hz, cutoff_hz)
    half = n // 2
    joined = np.concatenate([state.tail, span]).T
    joined = joined - np.add.reduce(joined, axis=1, keepdims=True) / joined.shape[1]
    frames = np.array([joined[:, :n], joined[:, half:]])
    transforms = np.fft.rfft(frames * bands.taper)[:, :, : bands.end]
    power = np.add.reduceat(transforms.real**2 + transforms.imag**2, bands.edges, axis=2)
    own = int(np.searchsorted(bands.edges, lowest_hz * n / rate_hz + 0.5, side="right")) - 1
    own = min(max(own, 0), bands.edges.size - 1)
    ratio = _voted_ratio(power, state.long_term, own) if state.steps else np.zeros(_FRAMES)
    threshold = settings.ratio_on * _early_factor(state.steps, settings.ratio_on)
    above, loud = ratio >= threshold, ratio >= settings.ratio_off
    if settings.level_m_s2 is not None:
        peaks = np.sort(np.abs(frames).max(axis=2), axis=1)
        voted = peaks[:, (peaks.shape[1] - 1) // 2]
        above, loud = above | (voted >= settings.level_m_s2), loud | (voted >= 0.5 * settings.level_m_s2)
    raised, on = state.raised, np.zeros(_FRAMES, dtype=bool)
    for k in range(_FRAMES):
        raised = raised + 1 if above[k] else 0
        on[k] = raised >= FRAMES_IN_A_ROW
    long_term, steps = state.long_term, state.steps
    if not (active or above.any()):  # what may be an event is no part of the average before it
        steps = min(steps + 1, round(_LONG_TERM_S / STEP_S))
        long_term = long_term + (0.5 * (power[0] + power[1]) - long_term) / steps
    state = replace(state, tail=span[half:], long_term=long_term, steps=steps, raised=raised)
    return state, Trigger(on, loud)


@lru_cache(maxsize=64)
def _early_factor(steps: int, ratio_on: float) -> float:
    """Compute the factor on the threshold while the long-term average holds few steps.

    The power of one bin of a frame of Gaussian motion over the average of `k` such powers exceeds `x` with the probability
    ``(1 + x / k) ** -k`` (the F distribution with 2 and 2 k degrees of freedom).  The factor keeps this probability at that of
    a full average.  The two frames of a step, which overlap by half, count as two.

    Examples
    --------
    >>> [round(_early_factor(steps, 4.0), 2) for steps in (1, 3, 10, 30)]
    [12.25, 1.9, 1.14, 1.0]
    """
    full = _FRAMES * _LONG_TERM_S / STEP_S
    k = float(_FRAMES * max(steps, 1))
    rarity = (1.0 + ratio_on**2 / full) ** (full / k)
    return float(np.sqrt(k * (rarity - 1.0)) / ratio_on)


def is_settled(state: RecognitionState) -> bool:
    """Say whether the long-term average holds all that it ever does."""
    return state.steps * STEP_S >= _LONG_TERM_S


def begin_anew(state: RecognitionState) -> RecognitionState:
    """Return the state after motion that did not end: the long-term average is learnt anew."""
    return replace(state, long_term=np.zeros_like(state.long_term), steps=0, raised=0)


def _voted_ratio(power: Array, long_term: Array, own: int) -> Array:
    """Compute the amplitude ratio that more than half of the live channels show in three bands and in one, shape (2,).

    Parameters
    ----------
    power : ndarray, shape (2, c, b)
    long_term : ndarray, shape (c, b)
    own : int
        Index of the band of the structure's lowest frequency.
    """
    strength = long_term.sum(axis=1)
    live = strength > DEAD * strength.max()
    if not live.all():
        if not live.any():
            return np.zeros(_FRAMES)
        power, long_term = power[:, live], long_term[live]
    ratios = np.sort(power / np.maximum(long_term, np.finfo(float).tiny), axis=1)
    voted = ratios[:, (ratios.shape[1] - 1) // 2]
    several = np.sort(voted, axis=1)[:, -min(_RAISED_BANDS, voted.shape[1])]
    return np.asarray(np.sqrt(np.minimum(several, voted[:, own])))
