"""What a recording says: averaged cross-spectra of its segments in classes of level and of temperature."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import chain, islice

import numpy as np
from numpy.typing import NDArray
from scipy.signal import sosfreqz

from drivers.base import ACCELERATION, GROUND, TEMPERATURE, SampleBlock
from monitor import align, driven
from monitor.condition import Conditioner, ConditionState
from monitor.config import Configuration
from monitor.driven import Drive
from monitor.errors import BadInputError
from monitor.prediction import Band
from monitor.results import Array, ComplexArray
from monitor.spectrum import SegmentDesign, overlap_correlation, taper, transform
from monitor.window import WindowGrid, common_step_s

_LOW = 0.05
_HIGH = 0.9
"""Band as shares of the cutoff."""
_LEVEL_CLASSES = 5
_MIN_SEGMENTS_A_CLASS = 12
_TEMPERATURE_CLASSES = 4
_MIN_RANGE_DEGC = 2.0
_DRIVEN_SEGMENT_S = 5.0
"""Segments of a recording whose ground is measured: a response needs no resolution, and short ones follow its level."""
_HEAD = 64
"""Blocks among which a measured ground shows."""
_WITHIN = 21
"""Times at which a segment's temperature is read."""
_SAME = 1e-6
"""Relative difference of magnitudes that rounding explains."""


@dataclass(frozen=True, eq=False, slots=True)
class Segments:
    """Tapered transforms of a recording's half-overlapping segments."""

    values: ComplexArray
    """Shape (n_segments, n_bins, c), m/s^2/sqrt(Hz)."""
    t_s: Array
    """Middle of each, s since the recording's first sample, shape (n_segments,)."""
    rms: Array
    """RMS of every channel's source samples, shape (n_segments, c), m/s^2."""
    above: Array
    """Variance of the tapered source samples above the band, shape (n_segments, c), (m/s^2)^2."""
    peak: Array
    """Largest magnitude of every channel's source samples, shape (c,)."""
    piled: NDArray[np.int64]
    """How many of a channel's samples share it, shape (c,)."""
    drive: Drive | None
    """The measured ground motion."""
    temperature: Array
    """Shape (n_readings, 2): s since the recording's first sample, degC; no rows where none was measured."""
    band: Band
    rate_hz: float
    """Of the source's samples."""
    samples: int
    """Source samples an the channels that the segments cover, counted once."""

    def part(self, chosen: NDArray[np.bool_]) -> Segments:
        """The chosen segments alone."""
        share = float(chosen.mean()) if chosen.size else 0.0
        return replace(
            self,
            values=self.values[chosen],
            t_s=self.t_s[chosen],
            rms=self.rms[chosen],
            above=self.above[chosen],
            drive=None if self.drive is None else self.drive.part(chosen),
            samples=round(self.samples * share),
        )


@dataclass(frozen=True, eq=False, slots=True)
class Evidence:
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


_BIN_CORRELATION = (2.0 / 3.0) ** 2, (1.0 / 6.0) ** 2
"""Squared correlations of the Hann taper's neighbouring bins, one and two apart."""


def _information_weight() -> float:
    return 1.0 / ((1.0 + 2.0 * sum(_BIN_CORRELATION)) * (1.0 + 2.0 * overlap_correlation()))


def gather(blocks: Iterable[SampleBlock], config: Configuration) -> Segments:
    """Condition a recording as the pipeline does and cut it into segments.

    Raises
    ------
    BadInputError
        If there is less than a minute of usable data.
    """
    blocks = iter(blocks)
    head = list(islice(blocks, _HEAD))
    segment_s = _DRIVEN_SEGMENT_S if any(b.topic == GROUND for b in head) else config.refinement.segment_s
    floors, ground = _Stream(config, config.channels, segment_s), _Stream(config, None, segment_s)
    temperature: list[tuple[int, float]] = []
    for block in chain(head, blocks):
        if block.topic == ACCELERATION:
            floors.push(block)
        elif block.topic == GROUND:
            ground.push(block)
        elif block.topic == TEMPERATURE:
            step_ns = 1e9 / block.sample_rate_hz
            temperature += [(block.t_ns + round(i * step_ns), float(v)) for i, v in enumerate(block.samples[:, 0])]
    if len(floors.segments) < 6:
        raise BadInputError(
            f"{floors.seconds:.0f} s of usable data without a gap; a diagnosis takes at least {floors.least_s:.0f} s"
        )
    assert floors.design is not None
    design, conditioner = floors.design, floors.conditioner
    first, last = (round(x * conditioner.cutoff_hz / design.step_hz) for x in (_LOW, _HIGH))
    first = max(first, 4)
    t0 = floors.t0_ns
    gain = _filter_gain(conditioner, last + 1, design.step_hz)
    band = Band(first, last - first + 1, design.step_hz, gain[first:])
    runs = [(t, np.concatenate(values)[:, 0]) for t, values in ground.runs]
    located = None
    if runs:
        located = driven.locate(
            runs, list(floors.segments), design, conditioner.rate_in_hz, lambda hz: _filter(conditioner, hz)
        )
    drive, covered = located or (None, np.ones(len(floors.segments), dtype=bool))
    readings = np.array([((t - t0) * 1e-9, v) for t, v in temperature if np.isfinite(v)]).reshape(-1, 2)
    transforms, rms, tapered = (np.stack(x) for x in zip(*floors.segments.values(), strict=True))
    below = 2.0 * design.step_hz * (np.abs(transforms[:, 1 : last + 1]) ** 2 / gain[1:, None]).sum(axis=1)
    segments = Segments(
        values=transforms[:, first : last + 1],
        t_s=np.array([(t - t0) * 1e-9 for t in floors.segments]) + 0.5 / design.step_hz,
        rms=rms,
        above=np.maximum(tapered - below, 0.0),
        peak=floors.peak,
        piled=floors.piled,
        drive=None,
        temperature=readings,
        band=band,
        rate_hz=conditioner.rate_in_hz,
        samples=round(floors.seconds * conditioner.rate_hz),
    )
    return replace(segments.part(covered), drive=drive)


class _Stream:
    """One topic on its way from blocks to segments."""

    def __init__(self, config: Configuration, channels: tuple[str, ...] | None, segment_s: float) -> None:
        self._config, self._channels, self._segment_s = config, channels, segment_s
        self._align = align.start()
        self._rest: Array | None = None
        self._state: ConditionState
        self._run_ns = 0
        self._done = 0
        self.design: SegmentDesign | None = None
        self.least_s = 3.5 * segment_s
        self.segments: dict[int, tuple[ComplexArray, Array, Array]] = {}
        """Transform, RMS and tapered variance of the source samples by the time of their first sample, UTC ns."""
        self.t0_ns = 0
        self.seconds = 0.0
        self.peak = np.zeros(len(channels or ("ground",)))
        self.piled = np.zeros(self.peak.size, dtype=np.int64)
        self.runs: list[tuple[int, list[Array]]] = []
        """Conditioned samples without a gap, each with the time of its first one, UTC ns; of the ground only."""
        self._keep = channels is None
        self._raw: list[Array] = []
        """Source samples of the segment to come."""

    def push(self, block: SampleBlock) -> None:
        """Add a block's samples."""
        self._channels = self._channels or block.channels[:1]
        self._align, pieces = align.step(self._align, block, self._channels)
        for piece in pieces:
            if self._rest is None or piece.gap is not None:
                self._begin(piece)
            self._state, values = self.conditioner.step_block(self._state, piece.values)
            if self._keep:
                self.runs[-1][1].append(values)
            self.seconds += values.shape[0] / self.conditioner.rate_hz
            self._heap(np.abs(piece.values))
            self._raw.append(piece.values)
            self._cut(values)

    def _heap(self, magnitude: Array) -> None:
        """Follow the largest magnitude and how many samples share it."""
        if not magnitude.size:
            return
        top = magnitude.max(axis=0)
        self.piled[top > self.peak * (1.0 + _SAME)] = 0
        self.peak = np.maximum(self.peak, top)
        self.piled += (magnitude >= self.peak * (1.0 - _SAME)).sum(axis=0)

    def _begin(self, piece: align.Piece) -> None:
        p = self._config.processing
        self.conditioner = Conditioner.design(piece.rate_hz, p.rate_hz, p.cutoff_hz, common_step_s(p.window_s, p.hop_s))
        self._state = self.conditioner.start(len(self._channels or ()))
        self._rest = np.zeros((0, len(self._channels or ())))
        if self.design is None:
            self.design = self._designed()
            self.t0_ns = piece.t_ns
        self._run_ns, self._done, self._raw = piece.t_ns, 0, []
        if self._keep:
            self.runs.append((piece.t_ns, []))

    def _designed(self) -> SegmentDesign:
        """Segments on the pipeline's grid; those of driven motion are shorter than its blocks."""
        p, conditioner = self._config.processing, self.conditioner
        if self._segment_s < self._config.refinement.segment_s:
            n = 2 * round(0.5 * self._segment_s * conditioner.rate_hz)
            kept = round(conditioner.cutoff_hz * n / conditioner.rate_hz) + 1
            return SegmentDesign(conditioner.rate_hz, n, min(n // 2 + 1, kept))
        lags = 2 * self._config.identification.block_rows
        return WindowGrid.design(
            conditioner.rate_hz, p.window_s, p.hop_s, lags, self._segment_s, conditioner.cutoff_hz
        ).segments

    def _cut(self, values: Array) -> None:
        assert self._rest is not None
        assert self.design is not None
        n = self.design.n
        rest = np.concatenate([self._rest, values])
        while rest.shape[0] >= n:
            t_ns = self._run_ns + round(self._done / self.design.rate_hz * 1e9)
            raw = np.concatenate(self._raw)
            n_raw = round(n * self.conditioner.rate_in_hz / self.design.rate_hz)
            if self._done:  # the first half segment holds the filter's start from rest
                own = raw[:n_raw] - raw[:n_raw].mean(axis=0)
                tapered = ((taper(len(own))[:, None] * own) ** 2).sum(axis=0)
                self.segments[t_ns] = transform(self.design, rest[:n]), own.std(axis=0), tapered
            rest, self._done = rest[n // 2 :], self._done + n // 2
            self._raw = [raw[n_raw // 2 :]]
        self._rest = rest


def _filter_gain(conditioner: Conditioner, n: int, step_hz: float) -> Array:
    """Power gain of the anti-alias filter at the first n bins."""
    return np.asarray(np.abs(_filter(conditioner, np.asarray(np.arange(n) * step_hz, dtype=float))) ** 2)


def _filter(conditioner: Conditioner, hz: Array) -> ComplexArray:
    """Response of the anti-alias filter."""
    return np.asarray(sosfreqz(conditioner.sos, worN=hz, fs=conditioner.rate_in_hz)[1])


def classify(segments: Segments) -> Evidence:
    """Average the segments' cross-spectra in classes of level and, where it was measured and varies, of temperature."""
    x = segments.values
    mean = np.einsum("ska,skb->kab", x, x.conj()) / x.shape[0]
    floor = 1e-6 * np.einsum("kaa->k", mean).real / mean.shape[1]
    inverse = np.linalg.inv(mean + floor[:, None, None] * np.eye(mean.shape[1]))
    # Whitened by the mean spectrum every bin counts alike, so that the class follows the excitation, not one mode's chance.
    level = np.einsum("ska,kab,skb->s", x.conj(), inverse, x).real
    # With the ground measured one class: its response is no mean over levels, and quiet stretches must not outweigh it.
    most = _LEVEL_CLASSES if segments.drive is None else 1
    label = _quantiles(level, min(most, max(1, level.size // _MIN_SEGMENTS_A_CLASS)))
    degc = _temperature_at(segments.temperature, segments.t_s, 1.0 / segments.band.bin_hz)
    if degc is not None and np.ptp(degc) > _MIN_RANGE_DEGC:
        n_degc = max(1, min(_TEMPERATURE_CLASSES, level.size // (2 * _MIN_SEGMENTS_A_CLASS)))
        n_level = max(1, min(3, level.size // (n_degc * _MIN_SEGMENTS_A_CLASS)))
        label = n_level * _quantiles(degc, n_degc) + _quantiles(level, n_level)
    members = tuple(np.flatnonzero(label == k) for k in np.unique(label))
    spectra = np.stack([np.einsum("ska,skb->kab", x[m], x[m].conj()) / m.size for m in members])
    relative = np.ones(level.size)
    for m in members:
        relative[m] = level[m] / level[m].mean()
    power = None if segments.drive is None else driven.smooth_power(x, segments.band.bin_hz)
    return Evidence(
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
    )


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
    within = t_s[:, None] + length_s * np.linspace(-0.5, 0.5, _WITHIN)
    return np.asarray(np.interp(within, t, value).mean(axis=1))


def class_temperature(evidence: Evidence, k: int, lag_s: float) -> float | None:
    """Mean temperature of class k after a first-order lag of `lag_s`, degC; None where none was measured."""
    length_s = 1.0 / evidence.band.bin_hz
    degc = _temperature_at(evidence.temperature, evidence.t_s[evidence.members[k]], length_s, lag_s)
    return None if degc is None else float(degc.mean())
