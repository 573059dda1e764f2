"""Faults of a sensor within one span of the source's samples: resolution, steps of the offset, drift, dropouts, hum."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, ComplexArray
from monitor.signals import mains_hum
from monitor.signals.flags import runs_of
from monitor.signals.neighbours import FALSE_RATE_A_SPAN

BATCHES = 20
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


def find_span_faults(x: Annotated[Array, "c n"], rate_hz: float) -> list[SpanFaults]:
    """Describe the faults of each channel, a row of `x`, m/s^2."""
    out, single = [], x.astype(np.float32)
    read: NDArray[np.floating[Any]] = (
        single if np.array_equal(single, x) else x
    )  # as the source gives them they are sorted ten times as fast
    for row, as_read, wander, hum in zip(x, read, _wander(read), _hums(x, rate_hz), strict=True):
        resolution = _resolution(as_read)
        out.append(SpanFaults(resolution, *wander, _held(row, resolution) / rate_hz, *hum))
    return out


def _resolution(row: NDArray[np.floating[Any]]) -> float:
    """Return the step between the values of a channel; 0 where it is too fine to be seen.

    It is the least difference of two values, if all values lie on its multiples.
    """
    endings = np.bincount(row.view(np.uint16)[:: row.itemsize // 2])
    if np.count_nonzero(endings) > row.size // 2:  # so many different last bits: most samples are distinct
        return 0.0
    ordered = np.sort(row)
    values = ordered[np.flatnonzero(np.diff(ordered, prepend=np.nan) != 0.0)].astype(float)
    if not 1 < values.size <= row.size // 2:  # most samples are distinct
        return 0.0
    steps = np.diff(values)
    least = float(steps.min())
    rounding = 2.0 * _FLOAT32 * float(np.abs(values).max()) / least
    multiple = steps / least
    off_grid = np.abs(multiple - np.rint(multiple)) / (1.0 + multiple)  # the least step is rounded too
    return least if off_grid.max() <= min(rounding, 0.1) else 0.0


def _wander(x: Annotated[NDArray[np.floating[Any]], "c n"]) -> list[tuple[float, float]]:
    """Compute the step of each channel's offset in a span and, where there is none, its drift over the span.

    A step is an outlier among the changes of the batches' medians; those of a drift are alike.

    References
    ----------
    F. E. Grubbs, Sample criteria for testing outlying observations, Annals of Mathematical Statistics 21 (1950) 27-58.
    """
    from scipy.special import stdtr  # takes a while to load

    c, size = len(x), x.shape[1] // BATCHES
    if size < 2:
        return [(0.0, 0.0)] * c
    ordered = np.sort(x[:, : size * BATCHES].reshape(c, BATCHES, size), axis=2)
    middle = ordered[:, :, [(size - 1) // 2, size // 2]].astype(float)
    levels = 0.5 * (middle[:, :, 0] + middle[:, :, 1])  # the medians; numpy.median takes seven times as long
    changes = np.diff(levels, axis=1)
    largest = np.abs(changes - changes.mean(axis=1, keepdims=True)).argmax(axis=1)
    at_largest = largest[:, None] == np.arange(BATCHES - 1)
    change, rest = changes[at_largest], changes[~at_largest].reshape(c, -1)
    scatter = rest.std(axis=1, ddof=1) * np.sqrt(1.0 + 1.0 / rest.shape[1])
    away = np.abs(change - rest.mean(axis=1)) / np.maximum(scatter, 1e-300)
    chance = 2.0 * changes.shape[1] * stdtr(rest.shape[1] - 1, -away)
    time = (np.arange(BATCHES) - 0.5 * (BATCHES - 1)) / BATCHES
    drifts = np.vecdot(time, levels - levels[:, :1]) / (time @ time)
    out = [(0.0, drift) for drift in drifts.tolist()]
    for i in np.flatnonzero(chance < FALSE_RATE_A_SPAN).tolist():
        after = int(largest[i]) + 1
        step = float(levels[i, after:].mean() - levels[i, :after].mean())
        if step * change[i] > 0.0:
            out[i] = step, 0.0
    return out


def _held(row: Array, resolution: float) -> int:
    """Count the samples of a channel that repeat the one before for longer than chance explains.

    Where each sample repeats the one before with the probability p, runs of k repetitions are as rare as p^k (geometric
    distribution).  Runs at the largest or least value are clipping, and those that a step of the resolution ends are rest.
    """
    same = np.diff(row) == 0.0
    n, repeated = same.size, int(np.count_nonzero(same))
    if repeated in (0, n):  # wholly stuck: told by `repeated`
        return 0
    begins, ends = runs_of(same)
    lengths = ends - begins
    jumps = np.abs(np.concatenate([[0.0], np.diff(row), [0.0]]))
    jump = np.maximum(jumps[begins], jumps[ends + 1])
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
        if n * p ** int(lengths[at]) >= FALSE_RATE_A_SPAN:
            break
        rare[at] = True
    return rare


def _hums(x: Annotated[Array, "c n"], rate_hz: float) -> list[tuple[float, float] | tuple[None, None]]:
    """Find for each channel the hum of the mains that it has alone, or that all have: (as seen, mains), Hz.

    References
    ----------
    D. J. Thomson, Spectrum estimation and harmonic analysis, Proceedings of the IEEE 70 (1982) 1055-1096, section XIII.
    """
    c, n = x.shape
    out: list[tuple[float, float] | tuple[None, None]] = [(None, None)] * c
    if n < 2:
        return out
    look = _harmonics(rate_hz, n)  # of 2 n points: a line between two bins would not be one
    if not look.mains.size:
        return out
    chance = _chance_of_line(_sine_spectra(x, look)) * c * look.width
    has = np.minimum.reduceat(chance, look.begins, axis=1) < FALSE_RATE_A_SPAN
    ends = np.append(look.begins[1:], look.bins.size)
    for k in np.flatnonzero((has.sum(axis=0) == 1) | has.all(axis=0)).tolist() if c > 1 else ():
        for i in np.flatnonzero(has[:, k]).tolist():
            best = look.begins[k] + int(chance[i, look.begins[k] : ends[k]].argmin())
            out[i] = int(look.bins[best]) * rate_hz / (2 * n), float(look.mains[k])
    return out


@dataclass(frozen=True, eq=False, slots=True)
class _Harmonics:
    """Bins in which harmonics of the mains may lie, all in one row, in a spectrum of twice as many points as samples."""

    mains: Annotated[Array, "harmonics"]
    """Mains frequency of each harmonic, Hz."""
    bins: Annotated[NDArray[np.intp], "bins"]
    begins: Annotated[NDArray[np.intp], "harmonics"]
    """Place of each harmonic's first bin in `bins`."""
    width: Annotated[NDArray[np.intp], "bins"]
    """Number of bins of the harmonic that a bin belongs to."""
    below: _Beside
    above: _Beside


_Beside = tuple[NDArray[np.intp], NDArray[np.bool_]]
"""Bins beside others at the distance of every taper, shape (n_tapers, n_bins), folded into the spectrum of real samples, and
where the spectrum there is the conjugate one: below 0 Hz and beyond the Nyquist frequency."""


@lru_cache(maxsize=8)
def _harmonics(rate_hz: float, n: int) -> _Harmonics:
    """List the bins in which harmonics of the mains may lie in a spectrum of `n` samples padded to 2 n."""
    found = mains_hum.harmonic_bins(rate_hz, rate_hz / (2 * n), n)
    counts = np.array([last + 1 - first for _, first, last in found], dtype=np.intp)
    bins = np.array([k for _, first, last in found for k in range(first, last + 1)], dtype=np.intp)

    def beside(k: NDArray[np.intp]) -> _Beside:
        """Fold the bins."""
        return np.abs((k + n) % (2 * n) - n), k % (2 * n) > n

    mains, orders = np.array([mains for mains, _, _ in found]), np.arange(1, _TAPERS + 1)[:, None]
    width = np.repeat(counts, counts)
    return _Harmonics(mains, bins, np.cumsum(counts) - counts, width, beside(bins - orders), beside(bins + orders))


def _chance_of_line(spectra: Annotated[ComplexArray, "tapers c bins"]) -> Annotated[Array, "c bins"]:
    """Compute the probability that noise makes such lines (Thomson's F-test)."""
    order = np.arange(1, _TAPERS + 1)
    sums = np.where(order % 2 == 1, 1.0 / order, 0.0)  # of the sine tapers' samples, up to a common factor
    line = (sums[:, None, None] * spectra).sum(axis=0) / (sums @ sums)
    rest = (np.abs(spectra - sums[:, None, None] * line) ** 2).sum(axis=0)
    ratio = np.abs(line) ** 2 * (sums @ sums) / np.maximum(rest, np.finfo(float).tiny)
    return np.asarray((1.0 + ratio) ** (1.0 - _TAPERS))


def _sine_spectra(x: Annotated[Array, "c n"], look: _Harmonics) -> Annotated[ComplexArray, "tapers c bins"]:
    """Compute the spectra of each channel under the sine tapers.

    A sine is the difference of two exponentials, so the tapered spectrum is that of two bins of the plain one: one transform
    serves all tapers.  They are those of n - 1 samples, whose period is 2 n.

    References
    ----------
    K. S. Riedel, A. Sidorenko, Minimum bias multiple taper spectral estimation, IEEE Trans. Signal Processing 43 (1995) 188-195.
    """
    n = x.shape[1]
    plain = np.fft.rfft(x[:, :-1] - x[:, :-1].mean(axis=1, keepdims=True), 2 * n, axis=1)
    turn = np.exp(1j * np.pi / n * np.arange(1, _TAPERS + 1)[:, None])

    def at(beside: _Beside) -> ComplexArray:
        """Return the spectrum beside the bins."""
        folded, mirrored = beside
        values = plain.take(folded, axis=1).transpose(1, 0, 2)
        return np.where(mirrored[:, None], values.conj(), values) if mirrored.any() else values

    difference = turn[:, None] * at(look.below) - turn.conj()[:, None] * at(look.above)
    return np.asarray(difference * (np.sqrt(2.0 / n) / 2j))
