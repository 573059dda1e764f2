"""Recognition of events: a short-term average over a long-term one, in bands of half an octave, voted by the floors.

A frame is 2 s of samples, and one begins each second.  Its power in every band and channel is divided by the long-term average of
that band and channel, so that neither a lightly damped mode nor a channel's noise decides alone.  More than half of the live
channels must show the same band raised (the lower median over channels).  Three bands must be raised (the third largest over
bands), and among them that of the structure's lowest frequency.  So one knocked, dead or disturbed sensor, a machine's line, or
doors and people, who shake floors at higher frequencies, are no motion of the whole structure.  A spike or a step touches two
frames; an event takes three in a row.

Disturbances that follow one another, or act on several floors at once, can raise three frames too.  So these three are looked at
once more before they make an event (`is_whole`): the motion must fill them, and floors that move in one direction must move
coherently.

As long as the long-term average holds less than 60 s, its own scatter is larger, and the threshold higher: stationary Gaussian
motion exceeds it as rarely as it exceeds `ratio_on` later (`_early_factor`).

References
----------
R. V. Allen, Automatic earthquake recognition and timing from single traces, BSSA 68 (1978) 1521-1532 (STA/LTA).
A. Trnkoczy, Understanding and parameter setting of STA/LTA trigger algorithm, NMSOP-2 (2012), IS 8.1 (averages of some seconds
and 60 s, threshold 4, the long-term average frozen during a trigger, votes of the channels).
J. S. Bendat, A. G. Piersol, Random Data, 4th ed. (2010), ch. 9 (distribution of the coherence of unrelated signals).
T. Goforth, E. Herrin, An automatic seismic signal detection algorithm based on the Walsh transform, BSSA 71 (1981) 1351-1360
(weights from the noise's own spectrum).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array
from monitor.events.settings import EventSettings

STEP_S = 2.0
"""Length of a frame, the short-term average, and of the samples of one step. [s; Trnkoczy 2012: some periods of the signal]"""
_LONG_TERM_S = 60.0
"""Time constant of the long-term average. [s; Trnkoczy 2012]"""
_FULL = round(_LONG_TERM_S / STEP_S)
"""Most steps that the long-term average holds. [count; definition]"""
_RAISED_BANDS = 3
"""Bands of half an octave that must be raised together. [count; earthquakes span more than an octave, a machine's line or one
mode does not]"""
FRAMES_IN_A_ROW = 3
"""Frames in a row that make an event. [count; a spike touches two]"""
DEAD = 1e-6
"""Share of the power of the strongest channel below which a channel is dead and has no vote. [ratio; -60 dB]"""
_PIECES = 4
"""Pieces of a frame, without overlap, in which motion is looked for: a disturbance shorter than one touches one or two. [count;
measurement: 8 tells the same of 2,400 pairs of disturbances and 280 quakes; 2 refuses three pairs of spikes in four]"""
_FRAMES = 2
"""Frames that one step of samples completes. [count; definition: they overlap by half]"""


_TINY = float(np.finfo(float).tiny)
"""Least power, so that there is always a ratio. [arbitrary units; definition]"""


@dataclass(frozen=True, eq=False, slots=True)
class RecognitionState:
    """State between steps of samples."""

    tail: Annotated[Array, "h c"]
    """The latest half of a frame, m/s^2."""
    long_term: Annotated[Array, "c b"]
    """Long-term average of the power in each band, in arbitrary units."""
    steps: int = 0
    """Steps in the long-term average."""
    raised: int = 0
    """Frames in a row above the threshold."""


@dataclass(frozen=True, eq=False, slots=True)
class Frames:
    """Power of the two frames that each of k steps of samples completes; frame i begins ``(i - 1) / 2`` frames after the step."""

    power: Annotated[Array, "k 2 c b"]
    """Power in each band, in arbitrary units."""
    samples: Annotated[Array, "samples c"]
    """m/s^2."""
    peaks: Annotated[Array, "k 2 c"] | None
    """Largest deviation from the mean, m/s^2; None where it is not asked for."""

    def tail(self, k: int) -> Annotated[Array, "h c"]:
        """Return the second half of a step's samples, m/s^2."""
        n = len(self.samples) // len(self.power)
        return self.samples[k * n + n // 2 : (k + 1) * n]


@dataclass(frozen=True, eq=False, slots=True)
class Trigger:
    """What the two frames of a step say, in order."""

    raised: tuple[int, ...]
    """Frames in a row above the threshold, this one included; from `FRAMES_IN_A_ROW` on they may be an event."""
    loud: tuple[bool, ...]
    """Whether the frame is above the threshold that ends an event."""


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


@lru_cache(maxsize=8)
def own_band(n: int, rate_hz: float, cutoff_hz: float, lowest_hz: float) -> int:
    """Find the index of the band of a structure's lowest frequency (Hz), in frames of `n` samples."""
    edges = _bands(n, rate_hz, cutoff_hz).edges
    own = int(np.searchsorted(edges, lowest_hz * n / rate_hz + 0.5, side="right")) - 1
    return min(max(own, 0), edges.size - 1)


def measure(
    tail: Annotated[Array, "h c"],
    samples: Annotated[Array, "samples c"],
    rate_hz: float,
    cutoff_hz: float,
    *,
    peaks: bool = False,
) -> Frames:
    """Measure the power of the frames that whole steps of conditioned samples complete, all at once, and if asked for their
    peaks.

    `tail` are the samples before, half a step.
    """
    from monitor.events.kernels import band_power, tapered_frames  # compiled code takes a while to load

    n = step_n(rate_hz)
    bands = _bands(n, rate_hz, cutoff_hz)
    power = band_power(np.fft.rfft(tapered_frames(tail, samples, bands.taper)), bands.edges, bands.end)
    peaks_at = None
    if peaks:
        frames = tapered_frames(tail, samples, np.ones(n))
        peaks_at = np.abs(frames).max(axis=2).T.reshape(len(power), _FRAMES, -1)
    return Frames(power, samples, peaks_at)


def pass_quiet(
    state: RecognitionState, frames: Frames, own: int, settings: EventSettings, *, saturated: bool = False
) -> RecognitionState | None:
    """Take all steps at once, as `step` to the last bit; None where one is above the threshold, or asks for more than this."""
    if state.raised or not state.steps or settings.level_m_s2 is not None:
        return None
    from monitor.events.kernels import average_while_quiet

    thresholds = np.full(_FULL + 1, settings.ratio_off) if saturated else _thresholds(settings.ratio_on)
    quiet, long_term, steps = average_while_quiet(
        frames.power, state.long_term, state.steps, thresholds, own, _RAISED_BANDS, DEAD, _TINY
    )
    return RecognitionState(frames.tail(len(frames.power) - 1), long_term, steps, 0) if quiet else None


def _averaged(long_term: Annotated[Array, "c b"], steps: int, power: Annotated[Array, "2 c b"]) -> tuple[Array, int]:
    """Add the power of a step's two frames to the long-term average, and return it with the number of steps in it."""
    steps = min(steps + 1, _FULL)
    return long_term + (0.5 * (power[0] + power[1]) - long_term) / steps, steps


def are_most(state: RecognitionState, channels: Annotated[NDArray[np.bool_], "c"]) -> bool:
    """Say whether more than half of the live channels are among `channels`, which are empty where nothing is known."""
    live = _live(state.long_term)
    return bool(channels.size and 2 * np.count_nonzero(channels & live) > np.count_nonzero(live))


def _live(long_term: Array) -> NDArray[np.bool_]:
    """Find the channels that are not dead; channels lie along the last axis but one."""
    strength = np.add.reduce(long_term, axis=-1)
    return np.asarray(strength > DEAD * np.maximum.reduce(strength, axis=-1, keepdims=True))


def step(
    state: RecognitionState,
    frames: Frames,
    k: int,
    own: int,
    settings: EventSettings,
    *,
    active: bool,
    saturated: bool = False,
) -> tuple[RecognitionState, Trigger]:
    """Compare the two frames that a step of samples completes with the long-term average.

    `own` is the index of the band of the structure's lowest frequency (`own_band`).  While an event is `active` the long-term
    average stays as it is.  Where more than half of the live channels reach the end of their range, `saturated`, what they show
    of the motion is less than the motion, and the threshold that ends an event begins one.

    Examples
    --------
    >>> import numpy as np
    >>> settings, rng, own = EventSettings(), np.random.default_rng(0), own_band(200, 100.0, 40.0, 2.0)
    >>> state, found = start(3, 100.0, 40.0), []
    >>> for level in [1.0] * 40 + [20.0] * 3:
    ...     frames = measure(state.tail, level * rng.standard_normal((200, 3)), 100.0, 40.0)
    ...     state, trigger = step(state, frames, 0, own, settings, active=False)
    ...     found.append(trigger)
    >>> found[39].raised, found[-1].raised
    ((0, 0), (5, 6))
    """
    ratio, live = [0.0] * _FRAMES, _live(state.long_term)
    if state.steps and live.any():
        ratio = _voted_ratio(frames.power[k][:, live], state.long_term[live], own).tolist()
    threshold = settings.ratio_off if saturated else settings.ratio_on * _early_factor(state.steps, settings.ratio_on)
    above, loud = [r >= threshold for r in ratio], [r >= settings.ratio_off for r in ratio]
    if settings.level_m_s2 is not None and frames.peaks is not None:
        level = settings.level_m_s2
        voted = _lower_median(frames.peaks[k]).tolist()
        above = [a or v >= level for a, v in zip(above, voted, strict=True)]
        loud = [a or v >= 0.5 * level for a, v in zip(loud, voted, strict=True)]
    row, raised = [], state.raised
    for is_above in above:
        raised = raised + 1 if is_above else 0
        row.append(raised)
    long_term, steps = state.long_term, state.steps
    if not (active or any(above)):  # what may be an event is no part of the average before it
        long_term, steps = _averaged(long_term, steps, frames.power[k])
    return RecognitionState(frames.tail(k), long_term, steps, raised), Trigger(tuple(row), tuple(loud))


def is_whole(
    long_term: Annotated[Array, "c b"],
    span: Annotated[Array, "samples c"],
    rate_hz: float,
    cutoff_hz: float,
    settings: EventSettings,
    *,
    one_direction: bool,
) -> bool:
    """Say whether three frames in a row above the threshold are motion of the whole structure.

    In more than half of their time, more than half of the live channels must exceed the threshold that ends an event, in more
    than half of the bands that all three frames raise: two spikes or doors one after the other leave most of it quiet.  And more
    than half of the live channels must be coherent with another one.  The coherence must be one that unrelated channels reach as
    rarely as stationary motion exceeds `ratio_on`.  Disturbances of several floors at once, each with its own cause, do not reach
    it.  `long_term` is the average before the frames, and `span` holds their conditioned samples.  Only channels that measure
    motion in `one_direction`, in which the structure ties the floors together, are asked to move coherently.

    Examples
    --------
    >>> import numpy as np
    >>> settings, rng = EventSettings(), np.random.default_rng(0)
    >>> state, quiet = start(2, 100.0, 40.0), rng.standard_normal((4000, 2))
    >>> for i in range(20):
    ...     frames = measure(state.tail, quiet[200 * i : 200 * i + 200], 100.0, 40.0)
    ...     state, _ = step(state, frames, 0, 4, settings, active=False)
    >>> apart = 10.0 * rng.standard_normal((400, 2))
    >>> [is_whole(state.long_term, x, 100.0, 40.0, settings, one_direction=True) for x in (apart, apart[:, [0, 0]])]
    [False, True]
    """
    n = span.shape[0] // 2
    bands = _bands(n, rate_hz, cutoff_hz)
    span = span - np.median(span, axis=0)  # the mean of a spike would be an offset of all pieces
    live = _live(long_term)
    if live.any():  # without a long-term average the absolute threshold alone says what an event is
        span, long_term = span[:, live], np.maximum(long_term[live], _TINY)
    frames = np.array([span[:n], span[n // 2 : n // 2 + n], span[n:]])
    transforms = _transforms(frames, bands.taper, bands)
    raised = np.all(_lower_median(_power(transforms, bands) / long_term) >= settings.ratio_off**2, axis=0)
    if not raised.any():
        raised = np.ones_like(raised)
    pieces, taper = _pieces(span, n)
    ratio = _power(_transforms(pieces, taper, bands), bands) / (long_term @ _shares(n, rate_hz, cutoff_hz))
    loud = _lower_median(_lower_median(ratio)[:, raised]) >= settings.ratio_off**2
    if settings.level_m_s2 is not None:
        loud |= _lower_median(np.abs(pieces).max(axis=1)) >= 0.5 * settings.level_m_s2
    if 2 * np.count_nonzero(loud) <= loud.size:
        return False
    if not one_direction or span.shape[1] == 1:
        return True
    related = _related(transforms[[0, 2]], bands, raised, settings.ratio_on)
    return bool(2 * np.count_nonzero(related.any(axis=1)) > len(related))


def _related(
    transforms: Annotated[NDArray[np.complex128], "2 c bins"],
    bands: _Bands,
    raised: Annotated[NDArray[np.bool_], "b"],
    ratio_on: float,
) -> Annotated[NDArray[np.bool_], "c c"]:
    """Find the pairs of channels that are more coherent than unrelated ones, shape (c, c).

    In a band of `w` bins of two frames, which the taper makes ``w + 1`` independent ones, minus `w` times the logarithm of one
    minus the coherence of unrelated Gaussian channels has an exponential distribution with mean one; their sum over bands has a
    gamma distribution.  The two frames do not overlap, and the bands that are `raised` are taken.
    """
    from scipy.special import gammaincc  # takes a while to load

    products = (transforms[:, :, None] * transforms[:, None].conj()).sum(axis=0)
    spectra = np.add.reduceat(products, bands.edges, axis=2)[:, :, raised]
    power = np.diagonal(spectra).real.T  # (c, b)
    coherence = np.abs(spectra) ** 2 / np.maximum(power[:, None] * power[None], _TINY)
    widths = np.diff([*bands.edges, bands.end])[raised]
    evidence = -(widths * np.log(np.maximum(1.0 - coherence, np.finfo(float).eps))).sum(axis=2)
    np.fill_diagonal(evidence, 0.0)
    return np.asarray(gammaincc(len(widths), evidence) <= _rarity(ratio_on))


def _transforms(
    frames: Annotated[Array, "k m c"], taper: Annotated[Array, "m"], bands: _Bands
) -> Annotated[NDArray[np.complex128], "k c bins"]:
    """Transform tapered frames to the bins of whole frames."""
    return np.fft.rfft(frames * taper[:, None], bands.taper.size, axis=1)[:, : bands.end].swapaxes(1, 2)


def _power(transforms: Annotated[NDArray[np.complex128], "k c bins"], bands: _Bands) -> Annotated[Array, "k c b"]:
    """Sum the power of transforms in each band."""
    return np.asarray(np.add.reduceat(transforms.real**2 + transforms.imag**2, bands.edges, axis=2))


def _pieces(span: Annotated[Array, "samples c"], n: int) -> tuple[Annotated[Array, "k m c"], Annotated[Array, "m"]]:
    """Cut frames of `n` samples into pieces that overlap by half, and return these and their taper."""
    m = n // _PIECES
    pieces = np.lib.stride_tricks.sliding_window_view(span, m, axis=0)[:: max(1, m // 2)]
    return pieces.swapaxes(1, 2), np.hanning(m + 1)[:m]


@lru_cache(maxsize=8)
def _shares(n: int, rate_hz: float, cutoff_hz: float) -> Annotated[Array, "b b"]:
    """Compute the power of a piece in each band by that of a frame in each band: the shorter taper of a piece leaks farther."""
    bands = _bands(n, rate_hz, cutoff_hz)
    widths = np.diff([*bands.edges, bands.end])
    taper = _pieces(np.zeros((n, 1)), n)[1]
    leaks = np.abs(np.fft.fft(taper, n)) ** 2 / (n * (bands.taper**2).sum())
    at = np.arange(bands.end)
    by_bin = leaks[np.subtract.outer(at, at) % n] + leaks[np.add.outer(at, at) % n]  # of negative frequencies too
    by_band = np.add.reduceat(np.add.reduceat(by_bin, bands.edges, axis=0), bands.edges, axis=1)
    return np.asarray(by_band / widths[:, None])


def _lower_median(values: Array) -> Array:
    """Return the value that more than half of the channels, or bands, reach; they lie along axis 1."""
    return np.asarray(np.sort(values, axis=1)[:, (values.shape[1] - 1) // 2])


def _rarity(ratio_on: float) -> float:
    """Compute the probability by which one bin of stationary Gaussian motion exceeds the threshold (`_early_factor`)."""
    full = _FRAMES * _LONG_TERM_S / STEP_S
    return float((1.0 + ratio_on**2 / full) ** -full)


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


@lru_cache(maxsize=8)
def _thresholds(ratio_on: float) -> Annotated[Array, "steps"]:
    """Compute the threshold for each number of steps in the long-term average."""
    return np.array([ratio_on * _early_factor(steps, ratio_on) for steps in range(_FULL + 1)])


def unsettled(state: RecognitionState) -> int:
    """Return the quiet steps that the long-term average still lacks; 0 once it holds all that it ever does."""
    return _FULL - state.steps


def begin_anew(state: RecognitionState) -> RecognitionState:
    """Return the state after motion that did not end: the long-term average is learnt anew."""
    return replace(state, long_term=np.zeros_like(state.long_term), steps=0, raised=0)


def _voted_ratio(power: Annotated[Array, "... c b"], long_term: Annotated[Array, "... c b"], own: int) -> Array:
    """Compute the amplitude ratio that more than half of the channels show in three bands, and in `own`, the structure's."""
    ratios = power / np.maximum(long_term, _TINY)
    ratios.sort(axis=-2)
    voted = ratios[..., (ratios.shape[-2] - 1) // 2, :]
    in_own = voted[..., own].copy()
    voted.sort(axis=-1)
    return np.asarray(np.sqrt(np.minimum(voted[..., -min(_RAISED_BANDS, voted.shape[-1])], in_own)))
