"""Faults of a sensor within one span of the source's samples: resolution, steps of the offset, drift, dropouts, hum."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, ComplexArray
from monitor.signals import mains_hum

_FALSE_RATE_A_SPAN = 1e-6
"""Probability that chance makes a step, a dropout or a hum in one channel of one span: less than one a month for three channels
and spans of 10 s. [1; judgement]"""
_BATCHES = 20
"""Parts of a span whose medians show steps and drift. [count; judgement]"""
_TAPERS = 8
"""Tapers of the test for a hum. [count; judgement]"""
_FLOAT32 = float(np.finfo(np.float32).eps)
"""Relative rounding of the source's samples. [1; definition]"""


@dataclass(frozen=True, slots=True)
class SpanFaults:
    """Faults of one channel in a span."""

    resolution_m_s2: float
    step_m_s2: float
    drift_m_s2: float
    held_s: float
    hum_hz: float | None
    mains_hz: float | None


def find_span_faults(x: Array, rate_hz: float) -> list[SpanFaults]:
    """Describe the faults of each channel, a row of `x`, shape (c, n), m/s^2."""
    out = []
    for row, hum in zip(x, _hums(x, rate_hz), strict=True):
        resolution = _resolution(row)
        out.append(SpanFaults(resolution, *_wander(row), _held(row, resolution) / rate_hz, *hum))
    return out


def _resolution(row: Array) -> float:
    """Return the step between the values of a channel, shape (n,); 0 where it is too fine to be seen.

    It is the least difference of two values, if all values lie on its multiples.
    """
    values = np.unique(row)
    if not 1 < values.size <= row.size // 2:  # most samples are distinct
        return 0.0
    steps = np.diff(values)
    least = float(steps.min())
    rounding = 2.0 * _FLOAT32 * float(np.abs(values).max()) / least
    multiple = steps / least
    off_grid = np.abs(multiple - np.rint(multiple)) / (1.0 + multiple)  # the least step is rounded too
    return least if off_grid.max() <= min(rounding, 0.1) else 0.0


def _wander(row: Array) -> tuple[float, float]:
    """Compute the step of a channel's offset in a span and, where there is none, its drift over the span.

    A step is an outlier among the changes of the batches' medians; those of a drift are alike.

    References
    ----------
    F. E. Grubbs, Sample criteria for testing outlying observations, Annals of Mathematical Statistics 21 (1950) 27-58.
    """
    from scipy.special import stdtr  # takes a while to load

    size = row.size // _BATCHES
    if size < 2:
        return 0.0, 0.0
    level = np.median(row[: size * _BATCHES].reshape(_BATCHES, size), axis=1)
    changes = np.diff(level)
    at = int(np.abs(changes - changes.mean()).argmax())
    rest = np.delete(changes, at)
    scatter = float(rest.std(ddof=1)) * np.sqrt(1.0 + 1.0 / rest.size)
    chance = 2.0 * changes.size * stdtr(rest.size - 1, -abs(changes[at] - rest.mean()) / max(scatter, 1e-300))
    step = float(level[at + 1 :].mean() - level[: at + 1].mean())
    if chance < _FALSE_RATE_A_SPAN and step * changes[at] > 0.0:
        return step, 0.0
    time = (np.arange(_BATCHES) - 0.5 * (_BATCHES - 1)) / _BATCHES
    return 0.0, float(time @ (level - level[0]) / (time @ time))


def _held(row: Array, resolution: float) -> int:
    """Count the samples of a channel that repeat the one before for longer than chance explains.

    Where each sample repeats the one before with the probability p, runs of k repetitions are as rare as p^k (geometric
    distribution).  Runs at the largest or least value are clipping, and those that a step of the resolution ends are rest.
    """
    same = np.diff(row) == 0.0
    n, repeated = same.size, int(np.count_nonzero(same))
    if repeated in (0, n):  # wholly stuck: told by `repeated`
        return 0
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]])))
    begins, lengths = edges[::2], np.diff(edges)[::2]
    jumps = np.abs(np.concatenate([[0.0], np.diff(row), [0.0]]))
    jump = np.maximum(jumps[begins], jumps[begins + lengths + 1])
    inside = (row[begins] < row.max()) & (row[begins] > row.min()) & (jump > 1.5 * resolution)
    return int(lengths[inside & _is_rare(lengths, n)].sum())


def _is_rare(lengths: NDArray[np.intp], n: int) -> NDArray[np.bool_]:
    """Decide which runs of repetitions, of `n` steps in all, are too long for the others' probability to repeat."""
    order = np.argsort(lengths)
    total, runs = int(lengths.sum()), lengths.size
    rare = np.zeros(runs, dtype=bool)
    for at in order[::-1].tolist():  # the longest is judged by those left
        total, runs = total - int(lengths[at]), runs - 1
        p = (total + 1.0) / (n - int(lengths[rare].sum()) - int(lengths[at]) + 2.0)
        if n * p ** int(lengths[at]) >= _FALSE_RATE_A_SPAN:
            break
        rare[at] = True
    return rare


def _hums(x: Array, rate_hz: float) -> list[tuple[float, float] | tuple[None, None]]:
    """Find for each channel, shape (c, n), the hum of the mains that it has alone, or that all have: (as seen, mains), Hz.

    References
    ----------
    D. J. Thomson, Spectrum estimation and harmonic analysis, Proceedings of the IEEE 70 (1982) 1055-1096, section XIII.
    """
    c, n = x.shape
    out: list[tuple[float, float] | tuple[None, None]] = [(None, None)] * c
    n_fft = 2 * n  # a line between two bins would not be one
    spectra = np.fft.rfft(_sine_tapers(n)[:, None] * (x - x.mean(axis=1, keepdims=True)), n_fft, axis=2)
    for mains_hz, first, last in mains_hum.harmonic_bins(rate_hz, rate_hz / n_fft, n):
        chance = _chance_of_line(spectra[:, :, first : last + 1]) * c * (last + 1 - first)
        has = chance.min(axis=1) < _FALSE_RATE_A_SPAN
        if c > 1 and has.sum() in (1, c):
            for i in np.flatnonzero(has).tolist():
                out[i] = (first + int(chance[i].argmin())) * rate_hz / n_fft, mains_hz
    return out


def _chance_of_line(spectra: ComplexArray) -> Array:
    """Compute the probability that noise makes such lines (Thomson's F-test), shape (n_tapers, c, n_bins) to (c, n_bins)."""
    order = np.arange(1, _TAPERS + 1)
    sums = np.where(order % 2 == 1, 1.0 / order, 0.0)  # of the sine tapers' samples, up to a common factor
    line = np.tensordot(sums, spectra, axes=1) / (sums @ sums)
    rest = (np.abs(spectra - sums[:, None, None] * line) ** 2).sum(axis=0)
    ratio = np.abs(line) ** 2 * (sums @ sums) / np.maximum(rest, np.finfo(float).tiny)
    return np.asarray((1.0 + ratio) ** (1.0 - _TAPERS))


@lru_cache(maxsize=8)
def _sine_tapers(n: int) -> Array:
    """Return the sine tapers of unit energy, shape (n_tapers, n).

    References
    ----------
    K. S. Riedel, A. Sidorenko, Minimum bias multiple taper spectral estimation, IEEE Trans. Signal Processing 43 (1995) 188-195.
    """
    order = np.arange(1, _TAPERS + 1)[:, None]
    return np.asarray(np.sqrt(2.0 / (n + 1)) * np.sin(np.pi * order * np.arange(1, n + 1) / (n + 1)))
