"""Health of the sensors and of the stream over spans of data time, and the check which channels a window can use.

Reported for each channel: level, spikes, stuck, clipped and lost samples, noise floor, resolution, steps of the offset, drift,
dropouts and hum; for the stream: availability, gaps, overlaps.
A channel is left out of a window (`channel_watch`) only where it tells nothing.  A moderately clipped one is left to the
diagnosis.

References
----------
SeisComP, scqc: quality parameters of waveforms.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from monitor.core import Array, Settings
from monitor.signals.alignment import Piece
from monitor.signals.span_faults import BATCHES, SpanFaults, find_span_faults

_MAX_SPAN_SAMPLES = 1 << 18
"""A span is cut shorter than this whatever the rate: it is kept in memory until it ends. [samples; cost]"""
_SPIKE_STEPS = 12.0
"""Difference of a sample from both neighbours from which it is a spike. [mean steps; judgement]"""
_MIN_PILED_SAMPLES = 8
"""Samples at the largest magnitude that show a clipped channel. [samples; judgement]"""
_PILED_RATIO = 4
"""Samples at the largest magnitude over those just below it, from which the channel is clipped. [ratio; judgement]"""
_FFT_N = 2048
"""Length of the periodograms from which noise is read. [samples; judgement]"""
_LOWER_TENTH = -np.log(0.9)
"""The lower tenth of a periodogram's bins over their mean, for white noise. [1; definition: exponential
distribution]"""


class HealthSettings(Settings):
    """``[health]``: sensor checks."""

    span_s: float = Field(default=10.0, gt=0)
    """Length of data of one health report."""
    max_stuck: float = Field(default=0.1, gt=0, le=1)
    """Share of a window in which a channel may give one constant value while another moves."""
    max_clipped: float = Field(default=0.5, gt=0, le=1)
    """Share of a window's samples that may lie at a channel's limits."""
    min_gain: float = Field(default=0.6, gt=0, lt=1)
    """A channel that shows, in any ten seconds of a window, less than this share of the motion it shows in others is left out.
    The other channels say how much it should show."""
    min_explained: float = Field(default=0.05, gt=0, lt=1)
    """Share of a channel's power that the other channels explain; one with less is left out: it is noise, or drifts."""


@dataclass(frozen=True, slots=True)
class ChannelHealth:
    """Health of one channel in one span."""

    channel: str
    mean_m_s2: float
    rms_m_s2: float
    """RMS about the mean."""
    peak_m_s2: float
    """Largest magnitude about the mean."""
    spikes: int
    """Number of single samples that differ from both neighbours by twelve times the mean step or more."""
    repeated: float
    """Share of samples that equal the one before; 1: the channel is stuck."""
    clipped: float
    """Share of samples at the largest or least value, where samples pile up there."""
    noise_floor: float
    """Noise floor from the lowest tenth of the spectrum, m/s^2/sqrt(Hz)."""
    resolution_m_s2: float = 0.0
    """Step between the channel's values; 0 where it is too fine to be seen."""
    step_m_s2: float = 0.0
    """Step of the offset; 0 where there is none."""
    drift_m_s2: float = 0.0
    """Change of the mean over the span by its slope; 0 where there is a step."""
    held_s: float = 0.0
    """Time in which the channel held one value for longer than chance explains."""
    hum_hz: float | None = None
    """Frequency of a hum of the mains, as seen; None where there is none."""
    mains_hz: float | None = None
    """Frequency of the mains whose harmonic, or its alias, the hum is."""
    lost: float = 0.0
    """Share of samples that are not finite; the other figures are those of the rest, zeros where there is none."""


@dataclass(frozen=True, slots=True)
class Health:
    """Health of all channels and of the stream in one span."""

    t_ns: int
    """UTC of the first sample."""
    t_end_ns: int
    """Exclusive end, UTC."""
    rate_hz: float
    samples: int
    availability: float
    """Share of the span's samples that arrived."""
    gaps: int
    lost_s: float
    overlaps: int
    """Samples that were repeated, late or not finite in any channel, and dropped."""
    channels: tuple[ChannelHealth, ...]


@dataclass(frozen=True, eq=False, slots=True)
class HealthState:
    """State of the health checks: the span that is being filled, and completed spans that a window may still need."""

    t_ns: int = 0
    t_end_ns: int = 0
    rate_hz: float = 1.0
    parts: tuple[Array, ...] = ()
    """The span's samples so far, each of shape (.., c), m/s^2."""
    n: int = 0
    gaps: int = 0
    lost_s: float = 0.0
    dropped: int = 0
    """Dropped samples of the stream when the span began."""
    spans: tuple[Health, ...] = ()


def step(
    state: HealthState, piece: Piece, dropped: int, channels: tuple[str, ...], settings: HealthSettings, keep_s: float
) -> tuple[HealthState, list[Health]]:
    """Add samples and report the health of every span that they complete.

    `dropped` samples of the stream were dropped so far.  Completed spans are kept for `check` for `keep_s` of data.
    """
    found: list[Health] = []
    rate, t_ns, values = piece.rate_hz, piece.t_ns, piece.values
    size = max(2, min(round(settings.span_s * rate), _MAX_SPAN_SAMPLES))

    def close() -> None:
        """Report the present span and begin the next."""
        nonlocal state
        span = _span_health(state, dropped, channels)
        found.append(span)
        spans = tuple(s for s in (*state.spans, span) if abs(piece.t_ns - s.t_end_ns) <= keep_s * 1e9)
        state = HealthState(t_ns, t_ns, rate, dropped=dropped, spans=spans)

    if piece.gap is not None:
        state = replace(state, gaps=state.gaps + 1, lost_s=state.lost_s + piece.gap.duration_s)
    if state.n and (rate != state.rate_hz or state.n + state.lost_s * rate >= size):
        close()
    while values.shape[0]:
        room = max(1, size - state.n - round(state.lost_s * rate))
        part, values = values[:room], values[room:]
        begun_ns, n = state.t_ns if state.n else t_ns, state.n + part.shape[0]
        t_ns += round(part.shape[0] / rate * 1e9)
        state = HealthState(
            begun_ns, t_ns, rate, (*state.parts, part), n, state.gaps, state.lost_s, state.dropped, state.spans
        )
        if part.shape[0] == room:
            close()
    return state, found


def check(state: HealthState, begin_ns: int, end_ns: int, settings: HealthSettings) -> dict[str, str]:
    """Say what is wrong with each channel, by its name, that cannot be used in the window from `begin_ns` to `end_ns` (UTC).

    The spans wholly within it tell it.  What is said is a clause whose subject is the channel.
    """
    inside = [s for s in state.spans if begin_ns <= s.t_ns and s.t_end_ns <= end_ns + 1000]  # times are rounded
    n = sum(s.samples for s in inside)
    if not n:
        return {}
    stuck: defaultdict[str, int] = defaultdict(int)
    clipped: defaultdict[str, float] = defaultdict(float)
    for s in inside:
        for c in s.channels:
            # Where all channels are constant the structure is at rest, below the sensors' resolution.
            if c.repeated == 1.0 and any(other.repeated < 0.5 for other in s.channels):
                stuck[c.channel] += s.samples
            if c.clipped:
                clipped[c.channel] += s.samples * c.clipped
    found = {}
    for c in inside[0].channels:
        if stuck[c.channel] > settings.max_stuck * n:
            found[c.channel] = f"is stuck ({100 * stuck[c.channel] / n:.0f} % of the window)"
        elif clipped[c.channel] / n > settings.max_clipped:
            found[c.channel] = f"is clipped ({100 * clipped[c.channel] / n:.0f} % of its samples)"
    return found


def saturated(state: HealthState, begin_ns: int, end_ns: int) -> Annotated[NDArray[np.bool_], "c"]:
    """Find the channels whose samples pile up at their largest or least value between two times (UTC).

    The spans that overlap this time tell it, the one that is not complete among them.
    """
    found = [[c.clipped > 0.0 for c in s.channels] for s in state.spans if s.t_ns < end_ns and s.t_end_ns > begin_ns]
    if state.n and state.t_ns < end_ns and state.t_end_ns > begin_ns:
        x = np.concatenate(state.parts).T
        names = tuple(map(str, range(len(x))))
        found.append([c.clipped > 0.0 for c in _channel_health(np.ascontiguousarray(x), state.rate_hz, names)])
    return np.any(found, axis=0) if found else np.zeros(0, dtype=bool)


def _span_health(state: HealthState, dropped: int, channels: tuple[str, ...]) -> Health:
    """Compute the health of all channels and of the stream in the span that is complete."""
    x = np.ascontiguousarray(np.concatenate(state.parts).T)
    wanted = state.n + state.lost_s * state.rate_hz
    return Health(
        t_ns=state.t_ns,
        t_end_ns=state.t_end_ns,
        rate_hz=state.rate_hz,
        samples=state.n,
        availability=state.n / wanted,
        gaps=state.gaps,
        lost_s=state.lost_s,
        overlaps=dropped - state.dropped,
        channels=_channel_health(x, state.rate_hz, channels),
    )


def _channel_health(x: Annotated[Array, "c n"], rate_hz: float, channels: tuple[str, ...]) -> tuple[ChannelHealth, ...]:
    """Compute the health of each channel, a row of `x`, m/s^2, which may hold samples that are not finite."""
    finite = np.isfinite(x)
    whole = finite.all(axis=1)
    if whole.all():
        return _finite_health(x, rate_hz, channels)
    sound = _finite_health(np.ascontiguousarray(x[whole]), rate_hz, channels) if whole.any() else ()
    left, found = list(sound), []
    for name, row, has in zip(channels, x, finite, strict=True):
        if has.all():
            found.append(replace(left.pop(0), channel=name))
            continue
        known = has.sum() >= BATCHES
        (one,) = _finite_health((row[has] if known else np.zeros(BATCHES))[None], rate_hz, (name,))
        repeated = one.repeated if known else 0.0
        found.append(replace(one, repeated=repeated, lost=1.0 - float(has.mean())))
    return tuple(found)


def _finite_health(x: Annotated[Array, "c n"], rate_hz: float, channels: tuple[str, ...]) -> tuple[ChannelHealth, ...]:
    """Compute the health of the first channels, each a row of `x`, m/s^2, of finite samples."""
    from monitor.signals.kernels import described  # compiled code takes a while to load

    centred, (mean, rms, peak, spikes, moves, clipped) = described(x, _SPIKE_STEPS, _MIN_PILED_SAMPLES, _PILED_RATIO)
    n = x.shape[1]
    repeated, floor = 1.0 - moves / max(n - 1, 1), _noise_floor(centred, rate_hz)
    fields = mean, rms, peak, spikes.astype(int), repeated, clipped / n, floor
    found = find_span_faults(x, rate_hz)
    return tuple(
        ChannelHealth(*one, **{name: getattr(faults, name) for name in SpanFaults.__slots__})
        for one, faults in zip(zip(channels, *(values.tolist() for values in fields), strict=False), found, strict=True)
    )


def _noise_floor(x: Annotated[Array, "c n"], rate_hz: float) -> Annotated[Array, "c"]:
    """Estimate the noise floor of each row of `x`, m/s^2/sqrt(Hz), by a Hann window at mid-span."""
    n = min(x.shape[1], _FFT_N)
    start = (x.shape[1] - n) // 2
    spectrum = np.fft.rfft(x[:, start : start + n] * _taper(n), axis=1)
    power, tenth = spectrum.real**2 + spectrum.imag**2, spectrum.shape[1] // 10
    power.partition(tenth, axis=1)
    return np.asarray(np.sqrt(power[:, tenth] * (2.0 / (rate_hz * _LOWER_TENTH))))


@lru_cache(maxsize=8)
def _taper(n: int) -> Annotated[Array, "n"]:
    """Return the symmetric Hann taper of unit energy."""
    taper = np.hanning(n + 2)[1:-1]
    return np.asarray(taper / np.sqrt(taper @ taper))
