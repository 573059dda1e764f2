"""What a recording says: averaged cross-spectra of its segments in classes of level and of temperature."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, ComplexArray
from monitor.inference import ground_response
from monitor.inference.cross_spectra import Band
from monitor.inference.ground_response import Drive
from monitor.inference.segments import Segments
from monitor.signals import overlap_correlation

_LEVEL_CLASSES = 5
"""Most classes of vibration level. [count; judgement]"""
_MIN_SEGMENTS_A_CLASS = 12
"""Fewest segments of a class. [segments; judgement]"""
_TEMPERATURE_CLASSES = 4
"""Most classes of temperature. [count; judgement]"""
_MIN_RANGE_DEGC = 2.0
"""Range of temperature from which there are such classes. [K; judgement]"""
_READINGS_A_SEGMENT = 21
"""Times at which a segment's temperature is read. [count; cost]"""


@dataclass(frozen=True, eq=False, slots=True)
class ObservedSpectra:
    """Cross-spectra of one recording by class: what every model is scored against."""

    spectra: ComplexArray
    """Shape (classes, n_bins, c, c), (m/s^2)^2/Hz."""
    counts: Array
    """Shape (classes,): segments in each class."""
    weight: float
    """Independent pieces of information a segment and bin: overlap and taper correlate neighbours."""
    rms: Array
    """RMS of every channel's source samples, shape (classes, c)."""
    peak: Array
    """Largest magnitude of every channel's source samples, shape (c,)."""
    piled: NDArray[np.int64]
    """How many of a channel's samples share it, shape (c,)."""
    members: tuple[NDArray[np.intp], ...]
    """Segments of every class."""
    t_s: Array
    """Middle of every segment."""
    temperature: Array
    """Readings, shape (n, 2)."""
    band: Band
    rate_hz: float
    samples: int
    segments: Segments
    """What was averaged."""
    level: Array
    """Level of every segment over its class's, shape (n_segments,)."""
    power: Array | None
    """Where the ground was measured: the channels' power in which a model's own error is told, shape (n_bins, c)."""
    drive: Drive | None
    """The measured ground motion, which `segments` no longer hold."""
    by_temperature: bool = False
    """Whether the classes are of temperature too."""

    def pieces(self, n_bins: float) -> float:
        """Independent pieces of information that all segments hold on so many bins."""
        return float(self.weight * self.counts.sum() * n_bins)


_BIN_CORRELATION = (2.0 / 3.0) ** 2, (1.0 / 6.0) ** 2
"""Squared correlations of neighbouring bins, one and two apart. [1; definition: Hann taper]"""


def _information_weight() -> float:
    return 1.0 / ((1.0 + 2.0 * sum(_BIN_CORRELATION)) * (1.0 + 2.0 * overlap_correlation()))


def classify(segments: Segments) -> ObservedSpectra:
    """Average the segments' cross-spectra in classes of level and, where it was measured and varies, of temperature."""
    x = segments.values
    level = relative_level(x)
    # With the ground measured one class: its response is no mean over levels, and quiet stretches must not outweigh it.
    most = _LEVEL_CLASSES if segments.drive is None else 1
    label = _quantiles(level, min(most, max(1, level.size // _MIN_SEGMENTS_A_CLASS)))
    degc = _temperature_at(segments.temperature, segments.t_s, 1.0 / segments.band.bin_hz)
    by_temperature = degc is not None and bool(np.ptp(degc) > _MIN_RANGE_DEGC)
    if degc is not None and by_temperature:
        n_degc = max(1, min(_TEMPERATURE_CLASSES, level.size // (2 * _MIN_SEGMENTS_A_CLASS)))
        n_level = max(1, min(3, level.size // (n_degc * _MIN_SEGMENTS_A_CLASS)))
        label = n_level * _quantiles(degc, n_degc) + _quantiles(level, n_level)
    members = tuple(np.flatnonzero(label == k) for k in np.unique(label))
    spectra = np.stack([np.einsum("ska,skb->kab", x[m], x[m].conj()) / m.size for m in members])
    relative = np.ones(level.size)
    for m in members:
        relative[m] = level[m] / level[m].mean()
    power = None if segments.drive is None else ground_response.smooth_power(x, segments.band.bin_hz)
    return ObservedSpectra(
        spectra=spectra,
        counts=np.array([float(m.size) for m in members]),
        weight=_information_weight(),
        rms=np.stack([np.sqrt((segments.rms[m] ** 2).mean(axis=0)) for m in members]),
        peak=segments.peak,
        piled=segments.piled,
        members=members,
        t_s=segments.t_s,
        temperature=segments.temperature,
        band=segments.band,
        rate_hz=segments.rate_hz,
        samples=segments.samples,
        segments=replace(segments, drive=None),
        level=relative,
        power=power,
        drive=segments.drive,
        by_temperature=by_temperature,
    )


def relative_level(x: ComplexArray) -> Array:
    """Level of every segment's power over the mean of all, shape (n_segments,), of transforms, shape (n_segments, n_bins, c).

    Whitened by the mean spectrum every bin counts alike, so that it follows the excitation, not one mode's chance.
    """
    mean = np.einsum("ska,skb->kab", x, x.conj()) / x.shape[0]
    floor = 1e-6 * np.einsum("kaa->k", mean).real / mean.shape[1]
    inverse = np.linalg.inv(mean + floor[:, None, None] * np.eye(mean.shape[1]))
    level = np.einsum("ska,kab,skb->s", x.conj(), inverse, x).real
    return np.asarray(level / level.mean())


def _quantiles(value: Array, n: int) -> NDArray[np.intp]:
    """Class of every value, equally many in each."""
    rank = np.argsort(np.argsort(value, kind="stable"), kind="stable")
    return np.asarray(rank * n // value.size)


def _temperature_at(readings: Array, t_s: Array, length_s: float, lag_s: float = 0.0) -> Array | None:
    """Mean temperature of segments about times, after a first-order lag; None without readings.

    Means, since the slope that a short lag works on drowns in the noise of single readings.
    """
    if readings.shape[0] < 2:
        return None
    t, first = np.unique(readings[:, 0], return_index=True)
    value = readings[first, 1]
    if lag_s > 0.0:
        lagged = value.copy()
        for i in range(1, t.size):  # straight between readings
            keep = np.exp(-(t[i] - t[i - 1]) / lag_s)
            behind = lag_s * (value[i] - value[i - 1]) / (t[i] - t[i - 1])
            lagged[i] = value[i] - behind + keep * (lagged[i - 1] - value[i - 1] + behind)
        value = lagged
    within = t_s[:, None] + length_s * np.linspace(-0.5, 0.5, _READINGS_A_SEGMENT)
    return np.asarray(np.interp(within, t, value).mean(axis=1))


def class_temperature(evidence: ObservedSpectra, k: int, lag_s: float) -> float | None:
    """Mean temperature of class k after a first-order lag of `lag_s`, degC; None where none was measured."""
    length_s = 1.0 / evidence.band.bin_hz
    degc = _temperature_at(evidence.temperature, evidence.t_s[evidence.members[k]], length_s, lag_s)
    return None if degc is None else float(degc.mean())
