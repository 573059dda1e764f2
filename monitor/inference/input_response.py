"""Response to known inputs, a measured ground motion and measured forces: the deterministic output.

The residual of a segment is due to forces, noise and the model's own error (output error identification).

References
----------
L. Ljung, System Identification: Theory for the User (1999), section 4.2.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft
from scipy.linalg import eigh

from monitor.core import Array, ComplexArray, compiled
from monitor.inference.arrays import Spectra, Transforms, TransformSlopes
from monitor.inference.cross_spectra import Band, accelerance, clock_ratio, recorded
from monitor.model import Condition, Context, Effect, System
from monitor.signals import SegmentDesign, conditioned, taper

Between = Literal["smooth", "straight", "held"]
"""Course of the inputs between their samples: smooth as after a sensor's filter, or straight or held as in a simulation."""

_PAD_S = 40.0
"""Zeros after a run, in which its last motion dies out before it wraps around. [s; judgement]"""
_MAX_MISALIGNMENT = 0.02
"""Largest difference of the instants of the inputs and of the floors. [samples; judgement]"""
_OVERSAMPLING = 4
"""Samples of the inputs for one of the recording, as steps of nonlinear laws. [ratio; accuracy of the integration]"""
_MIN_STEP_HZ = 1000.0
"""Least rate of these steps. [Hz; accuracy of the integration]"""
_TILT_FREQUENCY = 0.2 / (2.0 * np.pi)
"""Motion slower than this times the first circular frequency is tilt of the sensors. [Hz s/rad; judgement: a fifth of
the first frequency]"""
_HIGHPASS_ORDER = 12
"""Order of the highpass that removes tilt. [1; judgement]"""
_MIN_FILTER_GAIN = 0.05
"""Least gain of the anti-alias filter that is compensated. [ratio; judgement]"""
_MIN_RUN_SEGMENTS = 6
"""Fewest segments that a run without gaps must cover. [segments; judgement]"""
_SMOOTH_HZ = 12.0
"""Width over which the error of the response is smoothed. [Hz; not recorded]"""


@dataclass(frozen=True, eq=False, slots=True)
class Input:
    """Measured input of the structure: a force on a degree of freedom, or the acceleration of the ground.

    Examples
    --------
    >>> Input("f1", 2), Input("ground")
    (Input(name='f1', floor=2), Input(name='ground', floor=None))
    """

    name: str
    floor: int | None = None
    """Degree of freedom on which the force acts, counted from 1; None for the ground, whose acceleration moves all floors."""


@dataclass(frozen=True, eq=False, slots=True)
class Run:
    """Run of the inputs without a gap, in the frequency domain."""

    spectrum: Annotated[ComplexArray, "freqs k"]
    """Unscaled transform of the conditioned samples with zeros after them, m/s^2 or N."""
    n: int
    """Number of samples, zeros included."""
    length: int
    """Number of samples without the zeros."""
    passed: Annotated[ComplexArray, "freqs"]
    """Frequency response of the anti-alias filter."""


@dataclass(frozen=True, eq=False, slots=True)
class Drive:
    """All measured inputs, which may be none, with the places of the recording's segments in them."""

    inputs: tuple[Input, ...]
    """The k inputs, in the order of the columns."""
    runs: tuple[Run, ...]
    run: Annotated[NDArray[np.intp], "segments"]
    """Index of every segment's run, -1 where no input was measured."""
    first: Annotated[NDArray[np.intp], "segments"]
    """First sample of every segment in its run."""
    design: SegmentDesign
    source_hz: float
    """Rate of the source's samples, Hz."""
    between: Between = "smooth"

    @classmethod
    def nothing(cls, n_segments: int, design: SegmentDesign, source_hz: float) -> Self:
        """Stand for the inputs of a recording of which none was measured."""
        nowhere = np.full(n_segments, -1, dtype=np.intp)
        return cls((), (), nowhere, nowhere, design, source_hz)

    @property
    def located(self) -> Annotated[NDArray[np.intp], "located"]:
        """Indices of the segments during which the inputs were measured: all of them, or none."""
        return np.flatnonzero(self.run >= 0)

    def forces(self, system: System) -> Annotated[Array, "N k"]:
        """Compute the forces on the degrees of freedom by a unit of each input, kg or 1."""
        out = np.zeros((system.mass.shape[0], len(self.inputs)))
        for i, one in enumerate(self.inputs):
            if one.floor is None:
                out[:, i] = -system.inertia
            else:
                out[one.floor - 1, i] = 1.0
        return out

    @property
    def rides(self) -> Annotated[Array, "k"]:
        """Acceleration of every floor at rest relative to the ground, by a unit of each input."""
        return np.array([float(one.floor is None) for one in self.inputs])

    def images(self, hz: Array) -> Iterator[tuple[float, Array | ComplexArray]]:
        """Yield the aliases of frequencies: distance in Hz, and factor on the inputs."""
        if self.between == "smooth":
            yield 0.0, np.ones(hz.size)
            return
        for k in (0, -1, 1):
            x = hz / self.source_hz + k
            yield (
                k * self.source_hz,
                np.sinc(x) ** 2 if self.between == "straight" else np.sinc(x) * np.exp(-1j * np.pi * x),
            )

    def part(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> Drive:
        """Select segments by mask or index."""
        return replace(self, run=self.run[chosen], first=self.first[chosen])

    def hz(self, run: Run, band: Band) -> Array:
        """Return the frequencies of a run's transform up to a little beyond the band, Hz."""
        hz = np.arange(run.n // 2 + 1) * (self.design.rate_hz / run.n)
        return np.asarray(hz[: np.searchsorted(hz, 1.1 * band.hz[-1])])

    def measured(self, band: Band) -> Annotated[ComplexArray, "segments bins k"]:
        """Transform the inputs themselves in every segment."""
        k = len(self.inputs)
        moved = self.moved(np.broadcast_to(np.eye(k), (run.n // 2 + 1, k, k)) for run in self.runs)
        return self.transforms(moved, k, band)

    def power(self, band: Band) -> Annotated[Array, "segments"]:
        """Compute the power of the inputs in every segment, each over its mean, summed."""
        power = (np.abs(self.measured(band)) ** 2).sum(axis=1)
        return np.asarray((power / np.maximum(power.mean(axis=0), np.finfo(float).tiny)).sum(axis=1))

    def moved(self, answers: Iterable[ComplexArray]) -> Iterator[tuple[NDArray[np.intp], Array]]:
        """Yield every run's segments as `cut` returns them, for its frequency response to the inputs, (n_hz, columns, k)."""
        for i, (run, answer) in enumerate(zip(self.runs, answers, strict=True)):
            moved = np.einsum("fck,fk->cf", answer, run.spectrum[: len(answer)])
            yield self.cut(i, irfft(moved, n=run.n))

    def cut(self, run: int, samples: Array) -> tuple[NDArray[np.intp], Annotated[Array, "members n columns"]]:
        """Cut samples (columns, n) of a run into its segments, and return these segments' indices with them."""
        members = np.flatnonzero(self.run == run)
        windows = np.lib.stride_tricks.sliding_window_view(samples, self.design.n, axis=1)
        return members, np.moveaxis(windows[:, self.first[members]], 0, -1)

    def transforms(self, moved: Iterable[tuple[NDArray[np.intp], Array]], columns: int, band: Band) -> Transforms:
        """Transform all segments, cut as by `cut`, as `monitor.signals.welch.transform` does, and keep the band."""
        out = np.empty((self.run.size, band.n_bins, columns), dtype=complex)
        for members, samples in moved:
            tapered = np.moveaxis(samples, 1, -1) * (taper(self.design.n) / np.sqrt(self.design.rate_hz))
            spectra = rfft(tapered, axis=-1)[..., band.first : band.first + band.n_bins]
            out[members] = np.moveaxis(spectra, -1, 1)
        return out


def joined(streams: Sequence[Sequence[conditioned.Run]], rate_hz: float) -> list[tuple[int, Array]]:
    """Join the runs of several inputs in the stretches in which all of them are there.

    A joined run has the UTC of its first sample in ns, and conditioned samples in the columns of all.
    """
    out = [(run.t_ns, run.values) for run in streams[0]]
    for runs in streams[1:]:
        both = []
        for (t, samples), other in product(out, runs):
            shift = (other.t_ns - t) * 1e-9 * rate_hz
            first, second = max(0, round(shift)), max(0, -round(shift))
            n = min(len(samples) - first, len(other.values) - second)
            if abs(shift - round(shift)) < _MAX_MISALIGNMENT and n > 0:
                columns = np.column_stack([samples[first : first + n], other.values[second : second + n]])
                both.append((t + round(first / rate_hz * 1e9), columns))
        out = both
    return out


def locate(
    inputs: tuple[Input, ...],
    runs: Sequence[tuple[int, Array]],
    segments_t_ns: Sequence[int],
    design: SegmentDesign,
    source_hz: float,
    filtered: Callable[[Array], ComplexArray],
) -> tuple[Drive, NDArray[np.bool_]] | None:
    """Locate segments, by the UTC (ns) of their first samples, in the runs (the same, and conditioned samples) of the inputs.

    `filtered` is the frequency response of the conditioning at frequencies in Hz.  The result is the inputs with the mask of the
    segments that a run covers; None where too few segments are covered.
    """
    which, first, covered = [], [], np.ones(len(segments_t_ns), dtype=bool)
    for s, t_ns in enumerate(segments_t_ns):
        for i, (begin, samples) in enumerate(runs):
            at = (t_ns - begin) * 1e-9 * design.rate_hz
            if abs(at - round(at)) < _MAX_MISALIGNMENT and 0 <= round(at) <= len(samples) - design.n:
                which.append(i)
                first.append(round(at))
                break
        else:
            covered[s] = False
    if len(which) < max(_MIN_RUN_SEGMENTS, 0.5 * covered.size):
        return None
    transformed = []
    for _, samples in runs:
        n = next_fast_len(round(len(samples) + _PAD_S * design.rate_hz), real=True)
        hz = np.arange(n // 2 + 1) * (design.rate_hz / n)
        transformed.append(Run(np.asarray(rfft(samples, n=n, axis=0)), n, len(samples), filtered(hz)))
    run, begins = np.array(which, dtype=np.intp), np.array(first, dtype=np.intp)
    return Drive(inputs, tuple(transformed), run, begins, design, source_hz), covered


def response(
    drive: Drive, system: System, effects: Sequence[Effect], band: Band, context: Context, condition: Condition
) -> Transforms:
    """Compute the transforms of the channels' response in every segment."""
    clock = clock_ratio(effects)

    def answer(run: Run) -> ComplexArray:
        hz = drive.hz(run, band)
        floors = np.zeros((hz.size, context.structure.n_dofs, len(drive.inputs)), dtype=complex)
        for distance_hz, factor in drive.images(hz):
            relative = _relative_response(drive, system, clock * (hz + distance_hz), context)
            floors += factor[:, None, None] * (relative + np.outer(context.structure.rides, drive.rides))
        channels = np.asarray(context.sensors @ floors, dtype=np.complex128)
        return recorded(channels, effects, clock * hz, context, condition)

    return drive.transforms(drive.moved(answer(run) for run in drive.runs), len(context.channels), band)


def _relative_response(drive: Drive, system: System, hz: Array, context: Context) -> Annotated[ComplexArray, "hz n k"]:
    """Compute the floors' acceleration relative to the ground by a unit of each input."""
    floors = accelerance(system.mass, system.damping, system.stiffness, 2.0 * np.pi * hz, drive.forces(system))
    return np.asarray(floors[:, : context.structure.n_dofs])


def exact_response(
    drive: Drive,
    system: System,
    effects: Sequence[Effect],
    band: Band,
    context: Context,
    condition: Condition,
    *,
    coarse: bool = False,
) -> Transforms:
    """Compute the channels' response as `response`, with nonlinear laws integrated in time instead of linearized.

    `system` is without the nonlinear effects.  Coarse steps are those of the inputs, for a difference of two responses in which
    the errors of long steps cancel.
    """
    from monitor.model import march  # compiled code takes a while to load

    laws = [law for effect in effects for law in effect.laws(context.structure)]
    n = context.structure.n_dofs
    lowest = _TILT_FREQUENCY * float(np.sqrt(eigh(system.stiffness, system.mass, eigvals_only=True).min()))
    clock = clock_ratio(effects)

    def moved(run: Run) -> Array:
        hz = np.asarray(np.arange(run.n // 2 + 1) * (drive.design.rate_hz / run.n), dtype=np.float64)
        finer = drive.design.rate_hz * _OVERSAMPLING
        # The true inputs, before the filter, act on the laws; frequencies that the filter removes are lost.
        kept = np.abs(run.passed) > _MIN_FILTER_GAIN
        unfiltered = np.where(kept, 1.0 / np.where(kept, run.passed, 1.0), 0.0)
        true = (next(drive.images(hz))[1] * unfiltered)[:, None] * run.spectrum
        # Forces are linear in time between samples, which is a lowpass; slow tilt of the ground's sensor is no motion.
        tilt = (lowest / np.maximum(hz, 1e-9)) ** _HIGHPASS_ORDER
        shape = 1.0 / np.sinc(hz / finer)[:, None] ** 2 / (1.0 + tilt[:, None] * drive.rides)
        acting = irfft(shape * true, n=run.n * _OVERSAMPLING, axis=0) * _OVERSAMPLING
        forces = acting[: run.length * _OVERSAMPLING] @ drive.forces(system).T
        floors = march(system, n, laws, forces, finer * clock, None, 0.0 if coarse else _MIN_STEP_HZ)
        floors = np.pad(floors[::_OVERSAMPLING], ((0, run.n - run.length), (0, 0)))
        absolute: ComplexArray = (
            rfft(floors, axis=0) + np.outer(true @ drive.rides, context.structure.rides)
        ) * run.passed[:, None]
        channels = np.asarray((absolute @ context.sensors.T)[:, :, None]).astype(np.complex128)
        answer = recorded(channels, effects, hz * clock, context, condition)
        return np.asarray(irfft(answer[:, :, 0].T, n=run.n))

    cut = (drive.cut(i, moved(run)) for i, run in enumerate(drive.runs))
    return drive.transforms(cut, len(context.channels), band)


def motion_rms(
    drive: Drive, system: System, band: Band, context: Context, rows: Array, order: int, lowest_hz: float
) -> Array:
    """Compute the RMS over the segments of the floors' motion relative to the ground, m or m/s.

    `rows` pick drifts or floors out of the floors' motion, `order` is 0 for displacement and 1 for velocity.  Motion below
    `lowest_hz` is taken as tilt and drift of the sensors, and left out.
    """

    def answer(run: Run) -> ComplexArray:
        hz = drive.hz(run, band)
        w = 2.0 * np.pi * np.maximum(hz, lowest_hz)
        of_acceleration = (1j * w) ** order / -(w**2) * (hz >= lowest_hz)
        return of_acceleration[:, None, None] * (rows @ _relative_response(drive, system, w / (2.0 * np.pi), context))

    power, n = np.zeros(len(rows)), 0
    for _, samples in drive.moved(answer(run) for run in drive.runs):
        power += (samples**2).sum(axis=(0, 1)) if samples.size else 0.0
        n += samples.shape[0] * drive.design.n
    return np.asarray(np.sqrt(power / max(n, 1)))


def smooth_power(transforms: Transforms, bin_hz: float) -> Annotated[Array, "bins c"]:
    """Average the power of segments and smooth it over a wide range of frequencies; the model's own error is a share of it.

    An error with peaks of its own would hide a wrong response where that is most informative.
    """
    power = (np.abs(transforms) ** 2).mean(axis=0)
    half = round(0.5 * _SMOOTH_HZ / bin_hz)
    padded = np.pad(power, ((half, half), (0, 0)), mode="edge")
    return np.asarray(np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1, axis=0).mean(axis=-1))


def products(transforms: ComplexArray, members: Sequence[NDArray[np.intp]]) -> Spectra:
    """Average the cross-products of every class's segments."""
    by_bin = [transforms[m].transpose(1, 2, 0) for m in members]
    return np.stack([x @ x.conj().swapaxes(1, 2) / x.shape[2] for x in by_bin])


def mean_rows(spectra: Spectra, stacked: TransformSlopes, members: Sequence[NDArray[np.intp]], weight: Array) -> Array:
    """Whiten changes of the segments' means by the residuals' spectra into real rows of unit information.

    `weight` is the number of independent pieces of information in a segment of each class and bin.
    """
    of = np.empty(stacked.shape[1], dtype=np.intp)
    for k, m in enumerate(members):
        of[m] = k
    # The mean of a complex normal distribution has twice the information of the squared modulus.
    scale = np.sqrt(2.0 * weight)[:, :, None, None]
    whiteners = np.asarray(scale * np.linalg.inv(np.linalg.cholesky(spectra)), dtype=np.complex128)
    return np.asarray(_whitened_means(whiteners, of, stacked).reshape(len(stacked), -1).T)


@compiled(error_model="numpy")
def _whitened_means(whiteners: ComplexArray, of: NDArray[np.intp], stacked: TransformSlopes) -> Array:
    """Whiten every segment, of class `of`, into its real and imaginary parts, the second axis."""
    p, segments, bins, c = stacked.shape
    out = np.empty((p, 2, segments, bins, c))
    for q in range(p):
        for s in range(segments):
            for f in range(bins):
                for i in range(c):
                    total = 0j
                    for a in range(i + 1):
                        total += whiteners[of[s], f, i, a] * stacked[q, s, f, a]
                    out[q, 0, s, f, i], out[q, 1, s, f, i] = total.real, total.imag
    return out
