"""Observed cross-spectra of a recording, averaged over its segments in classes of level and of temperature."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array
from monitor.inference.arrays import Spectra, Transforms, mean_products
from monitor.inference.cross_spectra import Band
from monitor.inference.input_response import Drive, smooth_power
from monitor.inference.segments import Segments
from monitor.signals import bin_correlation, overlap_correlation

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
    """Observed cross-spectra of one recording by class, with which every model is compared."""

    spectra: Spectra
    """(m/s^2)^2/Hz."""
    counts: Annotated[Array, "classes"]
    """Number of segments in each class."""
    weight: float
    """Independent pieces of information in a segment and bin; less than one, since overlap and taper correlate neighbours."""
    rms: Annotated[Array, "classes c"]
    """RMS of every channel's source samples, m/s^2."""
    members: tuple[NDArray[np.intp], ...]
    """Indices of the segments of every class."""
    band: Band
    segments: Segments
    """Segments that were averaged."""
    level: Annotated[Array, "segments"]
    """Level of every segment over that of its class."""
    power: Annotated[Array, "bins c"]
    """The channels' power of which a model's own error about a response to measured inputs is a share, (m/s^2)^2/Hz."""
    drive: Drive
    """Measured inputs; those of `segments` know nothing of how they are taken to run between their samples."""
    drift: Annotated[Array, "bins c"] | None = None
    """Power density of the channels' drift, (m/s^2)^2/Hz; None where no channel drifts."""
    by_temperature: bool = False
    """Whether the classes are of level and temperature, or of level only."""

    @property
    def label(self) -> Annotated[NDArray[np.intp], "segments"]:
        """Class of every segment."""
        out = np.empty(self.level.size, dtype=np.intp)
        for k, m in enumerate(self.members):
            out[m] = k
        return out

    def pieces(self, n_bins: float) -> float:
        """Count the independent pieces of information of all segments in a number of bins."""
        return float(self.weight * self.counts.sum() * n_bins)


def information_weight() -> float:
    """Compute the independent pieces of information in a segment and bin."""
    return 1.0 / (bin_correlation() * (1.0 + 2.0 * overlap_correlation()))


def nearest_classes(n: int, wanted: int) -> NDArray[np.intp]:
    """Choose, out of n classes of rising level, those nearest to a wanted number of classes.

    Examples
    --------
    >>> from monitor.inference.observed_spectra import nearest_classes
    >>> nearest_classes(5, 3).tolist()
    [0, 2, 4]
    """
    return np.rint(np.linspace(0, n - 1, wanted)).astype(np.intp)


def classify(segments: Segments, label: NDArray[np.intp] | None = None) -> ObservedSpectra:
    """Average the segments' cross-spectra in classes of level and of temperature, where that was measured and varies.

    `label` may give the segments' classes, as of a longer recording that they are a part of; only those that have segments are
    kept, in the order of their numbers.
    """
    x = segments.values
    level = relative_level(x)
    degc = _mean_temperature(segments.temperature, segments.t_s, 1.0 / segments.band.bin_hz)
    by_temperature = degc is not None and bool(np.ptp(degc) > _MIN_RANGE_DEGC)
    if label is None:
        # One class where inputs were measured: the response is not averaged over levels, and quiet segments must not have more
        # weight than the others.
        most = 1 if segments.drive.inputs else _LEVEL_CLASSES
        label = _classes_of(level, degc if by_temperature else None, most)
    members = tuple(np.flatnonzero(label == k) for k in np.unique(label))
    spectra = np.stack([mean_products(x[m]) for m in members])
    relative = np.ones(level.size)
    for m in members:
        relative[m] = level[m] / level[m].mean()
    return ObservedSpectra(
        spectra=spectra,
        counts=np.array([float(m.size) for m in members]),
        weight=information_weight(),
        rms=np.stack([np.sqrt((segments.rms[m] ** 2).mean(axis=0)) for m in members]),
        members=members,
        band=segments.band,
        segments=segments,
        level=relative,
        power=smooth_power(x, segments.band.bin_hz),
        drive=segments.drive,
        drift=segments.drift,
        by_temperature=by_temperature,
    )


def _classes_of(level: Array, degc: Array | None, most: int) -> NDArray[np.intp]:
    """Divide segments into classes of level, at most so many, or of level and temperature; return the class of every segment."""
    logarithm, n = np.log(np.maximum(level, np.finfo(float).tiny)), level.size
    if degc is None:
        return _natural_classes(logarithm, min(most, max(1, n // _MIN_SEGMENTS_A_CLASS)))
    n_degc = max(1, min(_TEMPERATURE_CLASSES, n // (2 * _MIN_SEGMENTS_A_CLASS)))
    n_level = max(1, min(3, n // (n_degc * _MIN_SEGMENTS_A_CLASS)))
    return n_level * _natural_classes(degc, n_degc) + _natural_classes(logarithm, n_level)


def relative_level(x: Transforms) -> Annotated[Array, "segments"]:
    """Compute the level of every segment over the mean of all segments.

    The segments are whitened by the mean spectrum, so that all bins have equal weight and the level follows the excitation, not
    the random response of one mode.
    """
    mean = mean_products(x)
    floor = 1e-6 * np.einsum("kaa->k", mean).real / mean.shape[1]
    inverse = np.linalg.inv(mean + floor[:, None, None] * np.eye(mean.shape[1]))
    level = np.einsum("ska,kab,skb->s", x.conj(), inverse, x).real
    return np.asarray(level / level.mean())


def _natural_classes(value: Array, n: int) -> NDArray[np.intp]:
    """Divide values into n classes that are as alike within as they can be; return the class of every value.

    The borders minimize the sum of squares about the means of the classes, by dynamic programming over the sorted values.
    So classes lie as far apart as the recording allows; classes of equal size would put a short strong part beside weak ones.

    References
    ----------
    W. D. Fisher, On grouping for maximum homogeneity, J. Am. Stat. Assoc. 53 (1958) 789.
    """
    order = np.argsort(value, kind="stable")
    at, size = value[order] - value.mean(), value.size
    total, squares = np.r_[0.0, np.cumsum(at)], np.r_[0.0, np.cumsum(at**2)]
    least = min(_MIN_SEGMENTS_A_CLASS, size // n)
    # Least sum of squares of the first values in as many classes as were formed so far.
    best = np.where(np.arange(size + 1) == 0, 0.0, np.inf)
    begins = np.zeros((n, size + 1), dtype=np.intp)
    for k in range(n):
        before, best = best, np.full(size + 1, np.inf)
        for end in range((k + 1) * least, size + 1):
            begin = np.arange(k * least, end - least + 1)
            sums = before[begin] + (squares[end] - squares[begin]) - (total[end] - total[begin]) ** 2 / (end - begin)
            begins[k, end] = begin[np.argmin(sums)]
            best[end] = sums.min()
    label, end = np.empty(size, dtype=np.intp), size
    for k in reversed(range(n)):
        label[order[begins[k, end] : end]] = k
        end = begins[k, end]
    return label


def _mean_temperature(readings: Array, t_s: Array, length_s: float, lag_s: float = 0.0) -> Array | None:
    """Compute the mean temperature of segments about their middles after a first-order lag; None without readings (s, degC).

    The temperature is averaged over the segment, since the noise of single readings hides the slope that a short lag acts on.
    """
    if readings.shape[0] < 2:
        return None
    t, first = np.unique(readings[:, 0], return_index=True)
    value = readings[first, 1]
    if lag_s > 0.0:
        lagged = value.copy()
        for i in range(1, t.size):  # linear between readings
            keep = np.exp(-(t[i] - t[i - 1]) / lag_s)
            behind = lag_s * (value[i] - value[i - 1]) / (t[i] - t[i - 1])
            lagged[i] = value[i] - behind + keep * (lagged[i - 1] - value[i - 1] + behind)
        value = lagged
    within = t_s[:, None] + length_s * np.linspace(-0.5, 0.5, _READINGS_A_SEGMENT)
    return np.asarray(np.interp(within, t, value).mean(axis=1))


def class_temperature(evidence: ObservedSpectra, k: int, lag_s: float) -> float | None:
    """Compute the mean temperature of class k after a first-order lag of `lag_s`, degC; None where it was not measured."""
    read, length_s = evidence.segments, 1.0 / evidence.band.bin_hz
    degc = _mean_temperature(read.temperature, read.t_s[evidence.members[k]], length_s, lag_s)
    return None if degc is None else float(degc.mean())
