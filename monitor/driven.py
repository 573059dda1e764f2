"""The response to a measured ground motion: a known input's known output, with nothing of chance in it.

What a segment shows beyond it is left to forces, noise and the model's own error (output error identification).

References
----------
L. Ljung, System Identification: Theory for the User (1999), section 4.2.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from monitor.effects import Condition, Context, Effect, System
from monitor.prediction import Band, channel_response, seen
from monitor.results import Array, ComplexArray
from monitor.spectrum import SegmentDesign, transform

_PAD_S = 60.0
"""Zeros after a run, in which its last motion dies out before it wraps."""
_ALIGNED = 0.02
"""Samples by which the ground's instants may differ from the floors'."""
_SMOOTH_BINS = 5
_MEAN_ROWS = 2.0
"""Information of a complex normal's mean, over that of its squared modulus."""


@dataclass(frozen=True, eq=False, slots=True)
class Run:
    """A stretch of ground motion without a gap, in the frequency domain."""

    spectrum: ComplexArray
    """Unscaled transform of the conditioned samples with zeros after them, m/s^2, shape (n // 2 + 1,)."""
    n: int
    """Samples, zeros included."""


@dataclass(frozen=True, eq=False, slots=True)
class Drive:
    """The measured ground motion, whole, and where the recording's segments lie in it."""

    runs: tuple[Run, ...]
    run: NDArray[np.intp]
    """Of every segment, shape (n_segments,)."""
    first: NDArray[np.intp]
    """First sample of every segment in its run."""
    design: SegmentDesign

    def part(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> Drive:
        """The chosen segments alone."""
        return replace(self, run=self.run[chosen], first=self.first[chosen])

    def hz(self, run: Run, band: Band) -> Array:
        """Frequencies of a run's transform as far as they matter in the band."""
        hz = np.arange(run.n // 2 + 1) * (self.design.rate_hz / run.n)
        return np.asarray(hz[: np.searchsorted(hz, 1.1 * band.hz[-1])])

    def moved(self, answers: Iterable[ComplexArray]) -> Iterator[tuple[NDArray[np.intp], Array]]:
        """Segments of every run and their samples, shape (n, columns), given each run's answer per frequency."""
        for i, (run, answer) in enumerate(zip(self.runs, answers, strict=True)):
            samples = np.fft.irfft(answer * run.spectrum[: len(answer), None], n=run.n, axis=0)
            members = np.flatnonzero(self.run == i)
            yield members, np.array([samples[j : j + self.design.n] for j in self.first[members]])


def locate(
    runs: Sequence[tuple[int, Array]], segments_t_ns: Sequence[int], design: SegmentDesign, band: Band
) -> Drive | None:
    """The drive of segments that begin at given times, or None where a run does not cover one of them.

    Parameters
    ----------
    runs : sequence of (int, ndarray)
        UTC of the first sample in ns and conditioned samples, m/s^2, of every run.
    """
    which, first = [], []
    for t_ns in segments_t_ns:
        for i, (begin, samples) in enumerate(runs):
            at = (t_ns - begin) * 1e-9 * design.rate_hz
            if abs(at - round(at)) < _ALIGNED and 0 <= round(at) <= samples.size - design.n:
                which.append(i)
                first.append(round(at))
                break
        else:
            return None
    made = []
    for _, samples in runs:
        n = 2 * round(0.5 * (samples.size + _PAD_S * design.rate_hz))
        made.append(Run(np.fft.rfft(samples, n=n), n))
    return Drive(tuple(made), np.array(which, dtype=np.intp), np.array(first, dtype=np.intp), design)


def response(
    drive: Drive, system: System, effects: Sequence[Effect], band: Band, context: Context, condition: Condition
) -> ComplexArray:
    """Transforms of the channels' response in every segment, shape (n_segments, n_bins, c)."""
    clock = float(np.prod([e.clock_factor for e in effects]))
    out = np.empty((drive.run.size, band.n_bins, len(context.channels)), dtype=complex)
    answers = (seen(system, effects, drive.hz(run, band), clock, context, condition)[:, :, -1] for run in drive.runs)
    for members, samples in drive.moved(answers):
        for i, x in zip(members, samples, strict=True):
            out[i] = transform(drive.design, x)[band.first : band.first + band.n_bins]
    return out


def motion_rms(
    drive: Drive, system: System, band: Band, context: Context, rows: Array, order: int, lowest_hz: float
) -> Array:
    """RMS over the segments of the floors' motion relative to the ground, in given rows of it.

    Parameters
    ----------
    rows : ndarray, shape (m, n)
    order : {0, 1}
        0 for displacement, 1 for velocity.
    lowest_hz : float
        What is slower is the sensors' tilt and drift.
    """

    def answer(run: Run) -> ComplexArray:
        hz = drive.hz(run, band)
        w = 2.0 * np.pi * np.maximum(hz, lowest_hz)
        relative = channel_response(system, w / (2.0 * np.pi), replace(context, sensors=rows))[:, :, -1]
        # The ground's own motion is not relative to it.
        relative = (relative - rows.sum(axis=1)) / (-(w**2))[:, None] * (1j * w[:, None]) ** order
        return np.asarray(relative * (hz >= lowest_hz)[:, None])

    power, n = np.zeros(len(rows)), 0
    for _, samples in drive.moved(answer(run) for run in drive.runs):
        power += (samples**2).sum(axis=(0, 1)) if samples.size else 0.0
        n += samples.shape[0] * drive.design.n
    return np.asarray(np.sqrt(power / max(n, 1)))


def smooth_power(transforms: ComplexArray) -> Array:
    """Mean power of segments, smoothed over a few bins, shape (n_bins, c): what a model's own error is measured by."""
    power = (np.abs(transforms) ** 2).mean(axis=0)
    half = _SMOOTH_BINS // 2
    padded = np.pad(power, ((half, half), (0, 0)), mode="edge")
    return np.asarray(np.lib.stride_tricks.sliding_window_view(padded, _SMOOTH_BINS, axis=0).mean(axis=-1))


def products(transforms: ComplexArray, members: Sequence[NDArray[np.intp]]) -> ComplexArray:
    """Mean cross-products of every class's segments, shape (classes, n_bins, c, c)."""
    return np.stack([np.einsum("sfa,sfb->fab", transforms[m], transforms[m].conj()) / m.size for m in members])


def mean_rows(
    spectra: ComplexArray, stacked: ComplexArray, members: Sequence[NDArray[np.intp]], weight: Array
) -> Array:
    """Changes of the segments' means as real rows of unit information, shape (n_segments * n_bins * c * 2, p).

    Parameters
    ----------
    spectra : ndarray, shape (classes, n_bins, c, c)
        Of what is left of the segments.
    stacked : ndarray, shape (p, n_segments, n_bins, c)
    weight : ndarray, shape (classes,)
        Independent pieces of information a segment and bin.
    """
    white = np.zeros_like(stacked)
    for lower, m, w in zip(np.linalg.cholesky(spectra), members, weight, strict=True):
        white[:, m] = np.sqrt(_MEAN_ROWS * w) * np.einsum("fab,psfb->psfa", np.linalg.inv(lower), stacked[:, m])
    flat = white.reshape(len(stacked), -1).T
    return np.concatenate([flat.real, flat.imag])
