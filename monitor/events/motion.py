"""Motion of floors and stories during an event: peaks, integrated velocities and drifts, intensities, frequencies.

Integration is in the frequency domain, above a corner: without phase, and with a taper of the quiet stretches before and after.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from scipy.constants import g
from scipy.signal import find_peaks

from monitor.core import Array
from monitor.events.event import FloorMotion, Spectrum
from monitor.signals import Conditioner

_CORNER_ORDER = 4
"""Order of the high-pass filter's power response (Butterworth). [1; D. Boore, J. Bommer, Soil Dynamics and Earthquake
Engineering 25 (2005) 93: low orders ring less]"""
_INTERPOLATION = 4
"""Factor by which motions are interpolated before their peak is taken. [ratio; a peak at a tenth of the rate lies less than 1 %
above its nearest sample]"""
_SPECTRUM_DAMPING = 0.05
"""Damping ratio of response spectra. [ratio; convention]"""
_PERIODS = 50
"""Periods of a response spectrum. [count; cost]"""
_PERIOD_RANGE_S = (0.05, 4.0)
"""Shortest and longest period of a response spectrum. [s; two samples at the usual cutoff of 40 Hz, and tall frames]"""
SEARCHED = (0.6, 1.25)
"""Range about a mode's frequency in which its frequency is looked for. [ratio; a frequency falls by a quarter where half of the
stiffness gives]"""
_PADDING = 8
"""Factor by which spectra are interpolated. [ratio; cost]"""
_BY_ACCELERATION = ((2.20, 1.00), (3.66, -1.66))
"""Slope and offset of the intensity over the decimal logarithm of the peak acceleration in cm/s^2, of weak and of strong
motion. [MMI; D. Wald et al., Earthquake Spectra 15 (1999) 557]"""
_BY_VELOCITY = ((2.10, 3.40), (3.47, 2.35))
"""The same over that of the peak velocity in cm/s. [MMI; D. Wald et al. 1999]"""
_STRONG = 5.0
"""Intensity from which the relations of strong motion hold. [MMI; Wald et al. 1999]"""
_VELOCITY_ALONE = 7.0
"""Intensity from which the peak velocity alone decides. [MMI; Wald et al. 1999]"""


def integrated(
    acceleration: Annotated[Array, "samples k"], rate_hz: float, corner_hz: float, times: int
) -> Annotated[Array, "samples k"]:
    """Integrate accelerations once or twice above a corner, at which the filter halves the power; 0 times, only filter them.

    Examples
    --------
    >>> t = np.arange(0.0, 60.0, 0.01)
    >>> wave = np.sin(2.0 * np.pi * 2.0 * t)[:, None] * np.hanning(t.size)[:, None]
    >>> moved = integrated(-((4.0 * np.pi) ** 2) * wave, 100.0, 0.2, 2)
    >>> bool(abs(abs(moved).max() - 1.0) < 0.01)
    True
    """
    n = acceleration.shape[0]
    hz = np.fft.rfftfreq(2 * n, 1.0 / rate_hz)
    response = np.zeros(hz.size, dtype=complex)
    response[1:] = (2j * np.pi * hz[1:]) ** -times / (1.0 + (corner_hz / hz[1:]) ** (2 * _CORNER_ORDER))
    centred = acceleration - acceleration.mean(axis=0)
    spectra = np.fft.rfft(centred, 2 * n, axis=0) * response[:, None]
    return np.asarray(np.fft.irfft(spectra, axis=0)[:n])


def without_filter(
    values: Annotated[Array, "samples k"], rate_hz: float, conditioner: Conditioner
) -> Annotated[Array, "samples k"]:
    """Take the ripple and the dispersion of the conditioning lowpass out of samples, below its cutoff."""
    n, mean = values.shape[0], values.mean(axis=0)
    hz = np.asarray(np.fft.rfftfreq(2 * n, 1.0 / rate_hz), dtype=float)
    response = np.ones(hz.size, dtype=complex)
    inside = hz <= conditioner.cutoff_hz
    response[inside] = conditioner.response(hz[inside])
    spectra = np.fft.rfft(values - mean, 2 * n, axis=0) / response[:, None]
    return np.asarray(np.fft.irfft(spectra, axis=0)[:n] + mean)


def floor_motion(
    channel: str, acceleration: Annotated[Array, "samples"], rate_hz: float, corner_hz: float, strong: slice
) -> FloorMotion:
    """Measure one channel's motion, m/s^2, with quiet stretches before and after the strong motion."""
    moved = acceleration - acceleration[: strong.start].mean() if strong.start else acceleration - acceleration.mean()
    velocity = integrated(moved[:, None], rate_hz, corner_hz, 1)[:, 0]
    part = moved[strong]
    return FloorMotion(
        channel,
        float(np.abs(part).max()),
        float(np.sqrt(np.mean(part**2))),
        float(np.abs(velocity[strong]).max()),
        float(np.pi / (2.0 * g) * np.sum(part**2) / rate_hz),
        float(np.sum(np.abs(part)) / rate_hz),
    )


def unknown_motion(channel: str) -> FloorMotion:
    """Return the motion of a channel of which nothing is known."""
    return FloorMotion(channel, *(np.nan,) * 5)


def peak_drifts(
    drift_acceleration: Annotated[Array, "samples k"],
    rate_hz: float,
    corners_hz: Annotated[Array, "corners"],
    strong: slice,
) -> tuple[Annotated[Array, "k"], Annotated[Array, "k"], float]:
    """Compute the largest dynamic drift of stories from the acceleration of their upper floor less that of their lower one.

    A high corner leaves out slow motion, a low one lets noise in.  For each story that corner is taken whose drift has the least
    standard deviation.  Return the drifts and their standard deviations, m, and the highest corner taken.
    """
    found = [_peaks_above(drift_acceleration, rate_hz, f, strong) for f in corners_hz]
    peaks, stds = (np.array(values) for values in zip(*found, strict=True))
    best, stories = stds.argmin(axis=0), np.arange(peaks.shape[1])
    return peaks[best, stories], stds[best, stories], float(corners_hz[best].max())


def _peaks_above(
    drift_acceleration: Annotated[Array, "samples k"], rate_hz: float, corner_hz: float, strong: slice
) -> tuple[Annotated[Array, "k"], Annotated[Array, "k"]]:
    """Compute the largest drifts above a corner and their standard deviation, m.

    The standard deviation joins what the same integration makes of the motion before the event, noise and ambient vibration, and
    what half and a quarter of the corner change.
    """
    drift, *slower = (integrated(drift_acceleration, rate_hz, share * corner_hz, 2) for share in (1.0, 0.5, 0.25))
    peak, *others = (_peaks(d, strong) for d in (drift, *slower))
    # The ends of the record are tapered by nothing but quiet motion, so the first seconds of its integral are left out.
    quiet = drift[strong.start // 2 : strong.start]
    noise = np.sqrt((quiet**2).mean(axis=0)) if len(quiet) else np.zeros_like(peak)
    # The corner changes all stories by like shares, though that of one may happen to be none.
    changes = np.array(others) / np.maximum(peak, np.finfo(float).tiny) - 1.0
    changed = np.sqrt((changes**2).mean(axis=1).sum()) * peak
    return peak, np.hypot(noise, changed)


def _peaks(motion: Annotated[Array, "n k"], strong: slice) -> Annotated[Array, "k"]:
    """Find the largest magnitude of motions within a slice, between samples too."""
    n = motion.shape[0]
    between = np.fft.irfft(np.fft.rfft(motion, axis=0), _INTERPOLATION * n, axis=0) * _INTERPOLATION
    return np.asarray(np.abs(between[_INTERPOLATION * strong.start : _INTERPOLATION * strong.stop]).max(axis=0))


def response_spectrum(acceleration: Annotated[Array, "samples"], rate_hz: float) -> Spectrum:
    """Compute the response spectrum of a ground acceleration, m/s^2, at 5 % damping.

    The recursion is exact for an acceleration that is linear between samples.

    References
    ----------
    N. Nigam, P. Jennings, Calculation of response spectra from strong-motion earthquake records, BSSA 59 (1969) 909.
    """
    from scipy.signal import lfilter

    longest = max(_PERIOD_RANGE_S[0] * 2.0, _PERIOD_RANGE_S[1])
    period = np.geomspace(max(_PERIOD_RANGE_S[0], 2.5 / rate_hz), longest, _PERIODS)
    dt, z = 1.0 / rate_hz, _SPECTRUM_DAMPING
    peak = np.empty(period.size)
    for i, w in enumerate(2.0 * np.pi / period):
        b, a = _oscillator(w, z, dt)
        peak[i] = np.abs(lfilter(b, a, acceleration)).max()
    return Spectrum(period, (2.0 * np.pi / period) ** 2 * peak)


def _oscillator(w: float, z: float, dt: float) -> tuple[Array, Array]:
    """Design the recursion of an oscillator's displacement by a piecewise linear ground acceleration (a first-order hold).

    `w` is the angular frequency, rad/s, `z` the damping ratio, and `dt` the sampling interval, s.
    """
    from scipy.signal import cont2discrete

    continuous = (np.array([-1.0]), np.array([1.0, 2.0 * z * w, w * w]))
    numerator, denominator, _ = cont2discrete(continuous, dt, method="foh")
    return np.asarray(numerator).ravel(), np.asarray(denominator).ravel()


def instrumental_intensity(peak_m_s2: float, peak_m_s: float) -> float:
    """Estimate the modified Mercalli intensity by peak ground acceleration and velocity (Wald et al. 1999), from 1 to 10.

    Examples
    --------
    >>> round(instrumental_intensity(1.8, 0.16), 1)  # 18 % g and 16 cm/s: strong shaking
    6.6
    """
    acceleration = _intensity(100.0 * peak_m_s2, *_BY_ACCELERATION)
    velocity = _intensity(100.0 * peak_m_s, *_BY_VELOCITY)
    if acceleration < _STRONG:
        return float(max(acceleration, 1.0))
    value = velocity if velocity >= _VELOCITY_ALONE else 0.5 * (acceleration + velocity)
    return float(min(value, 10.0))


def _intensity(peak: float, weak: tuple[float, float], strong: tuple[float, float]) -> float:
    """Compute the intensity of one peak by the relation of strong motion, or below its range by that of weak motion."""
    log = float(np.log10(max(peak, 1e-12)))
    value = strong[0] * log + strong[1]
    return value if value >= _STRONG else weak[0] * log + weak[1]


def modal_frequencies(
    motion: Annotated[Array, "samples c"],
    shapes: Annotated[Array, "m c"],
    near_hz: Annotated[Array, "m"],
    rate_hz: float,
) -> Annotated[Array, "m"]:
    """Find the frequency of the largest power of each mode's motion near a known one, Hz.

    NaN where none is known, where the power has no peak within the range, or one that lies nearer to another mode.
    """
    n, c = motion.shape
    used = shapes[:c]
    coordinates = (motion - motion.mean(axis=0)) @ np.linalg.pinv(used)
    power = np.abs(np.fft.rfft(coordinates * np.hanning(n)[:, None], _PADDING * n, axis=0)) ** 2
    hz = np.fft.rfftfreq(_PADDING * n, 1.0 / rate_hz)
    found = np.full(near_hz.size, np.nan)
    for k in range(len(used)):
        inside = np.flatnonzero((hz > SEARCHED[0] * near_hz[k]) & (hz < SEARCHED[1] * near_hz[k]))
        if inside.size < 3:
            continue
        own = power[inside, k]
        peaks, _ = find_peaks(own)
        if peaks.size:
            best = peaks[own[peaks].argmax()]
            at_hz = hz[inside[best]]
            if own[best] >= own[[0, -1]].max() and np.nanargmin(np.abs(np.log(near_hz / at_hz))) == k:
                found[k] = at_hz
    return found
