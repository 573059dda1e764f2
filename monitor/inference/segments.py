"""Segments of a recording: conditioned as in the pipeline, cut, tapered and transformed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, islice
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from drivers.base import ACCELERATION, FORCE, GROUND, TEMPERATURE, SampleBlock
from monitor.core import Array, BadInputError, ComplexArray
from monitor.inference import input_response
from monitor.inference.arrays import Transforms
from monitor.inference.cross_spectra import Band
from monitor.inference.input_response import Drive, Input
from monitor.inference.judged_band import find_judged_band
from monitor.signals import (
    Conditioner,
    Drift,
    FrontEnd,
    SegmentDesign,
    Stream,
    alignment,
    channel_faults,
    conditioned,
    mains_hum,
    runs_of,
    sensor_drift,
    taper,
    transform,
    window_quality,
)

_BAND_START = 0.05
"""Lowest frequency of the band, over the cutoff. [ratio; judgement]"""
_BAND_END = 0.9
"""Highest frequency of the band, over the cutoff. [ratio; ripple of the lowpass]"""
_DRIVEN_SEGMENT_S = 5.0
"""Length of a segment where the inputs are measured. [s; judgement: a measured input needs no resolution, and short
segments follow its level]"""
_DRIVEN_SEGMENTS = 72
"""Most segments of such a recording: a known input tells so much that more would only take time. [segments; cost]"""
_LEAD_S = 60.0
"""Stretch of the inputs that is kept before them, whose response they still hold. [s; judgement]"""
_INPUT_TEST_BLOCKS = 64
"""Blocks among which measured inputs are looked for. [count; cost]"""
_FEWEST_SEGMENTS = 6
"""Fewest segments of a diagnosis. [segments; judgement]"""
MIN_PILED = 20
"""Samples at the largest magnitude that show a clipped signal. [samples; judgement]"""
_CLIPPED_TOLERANCE = 1e-6
"""Relative difference of magnitudes that rounding explains. [ratio; rounding]"""


@dataclass(frozen=True, slots=True)
class LeftOut:
    """Data that are not compared with any model, because a sensor's fault rules them."""

    kind: str
    """Kind of the fault in words."""
    channel: str
    """Name of the channel, or of several."""
    says: str
    """Description in words."""
    seconds: float = 0.0
    """Length of the stretches at fault."""
    hz: tuple[tuple[float, float], ...] = ()
    """Ranges of frequencies that are left out; none where stretches of time are."""


@dataclass(frozen=True, eq=False, slots=True)
class Segments:
    """Tapered transforms of a recording's half-overlapping segments."""

    values: Transforms
    """m/s^2/sqrt(Hz)."""
    t_s: Annotated[Array, "segments"]
    """Middle of each segment, s since the recording's first sample."""
    rms: Annotated[Array, "segments c"]
    """RMS of every channel's source samples, m/s^2."""
    above: Annotated[Array, "segments c"]
    """Variance of the tapered source samples above the judged band, (m/s^2)^2."""
    peaks: Annotated[Array, "segments c"]
    """Largest magnitude of every channel's source samples in each segment, m/s^2."""
    peak: Annotated[Array, "c"]
    """Largest magnitude of every channel's source samples, m/s^2."""
    piled: Annotated[NDArray[np.int64], "c"]
    """Number of each channel's samples that share its largest magnitude."""
    drive: Drive
    """Measured inputs, a ground motion or forces."""
    temperature: Annotated[Array, "readings 2"]
    """s since the recording's first sample, degC; no rows where none was measured."""
    band: Band
    """Band that the recording can judge, in which all models are compared with it."""
    whole: Band
    """Band of ``[processing]``, of which `band` is all or a part."""
    power: Annotated[Array, "whole c"]
    """Mean power of every channel in the whole band, two-sided, (m/s^2)^2/Hz."""
    rate_hz: float
    """Rate of the source's samples."""
    resampled_hz: float
    """Rate to which the samples were resampled before they were cut into segments."""
    samples: int
    """Number of sample instants after resampling that the segments cover, each counted once for all channels."""
    left_out: tuple[LeftOut, ...] = ()
    """What of the recording these segments leave out."""
    drift: Annotated[Array, "bins c"] | None = None
    """Power density of the channels' drift, (m/s^2)^2/Hz; None where no channel drifts."""

    def without_clipped(self) -> Segments:
        """Leave out the segments in which a clipped channel reaches its limit, unless too few would remain for a diagnosis."""
        cut = self.piled >= MIN_PILED
        whole = np.asarray((self.peaks[:, cut] < self.peak[cut] * (1.0 - _CLIPPED_TOLERANCE)).all(axis=1))
        return self if whole.all() or np.count_nonzero(whole) < _FEWEST_SEGMENTS else self.part(whole)

    def within(self, range_hz: tuple[float, float] | None) -> Segments:
        """Narrow the judged band to a range of frequencies, Hz; None narrows nothing.

        Raises BadInputError if hardly a frequency of the judged band lies in the range.
        """
        if range_hz is None:
            return self
        half = 0.5 * self.band.bin_hz
        first, end = np.searchsorted(self.band.hz, [range_hz[0] - half, range_hz[1] + half])
        if end - first < 2:
            low, high = self.band.hz[[0, -1]]
            raise BadInputError(
                f"the recording can be judged from {low:.2f} to {high:.2f} Hz, and the baseline's from {range_hz[0]:.2f} to "
                f"{range_hz[1]:.2f} Hz: nothing is common to both; calibrate with forces like these"
            )
        chosen = slice(int(first), int(end))
        higher = (np.abs(self.values[:, end:]) ** 2 / self.band.gain[end:, None]).sum(axis=1)
        return replace(
            self,
            values=self.values[:, chosen],
            above=self.above + 2.0 * self.band.bin_hz * higher,
            drift=None if self.drift is None else self.drift[chosen],
            band=self.band.part(chosen, self.band.forces_hz),
        )

    def with_inputs(self) -> Annotated[ComplexArray, "segments bins streams"]:
        """Return the transforms of all channels, then those of the measured inputs."""
        return np.concatenate([self.values, self.drive.measured(self.band)], axis=2)

    def part(self, chosen: NDArray[np.bool_]) -> Segments:
        """Select segments by a mask."""
        share = float(chosen.mean()) if chosen.size else 0.0
        own = {name: getattr(self, name)[chosen] for name in ("values", "t_s", "rms", "above", "peaks")}
        return replace(self, drive=self.drive.part(chosen), samples=round(self.samples * share), **own)


def gather(
    blocks: Iterable[SampleBlock], front_end: FrontEnd, *, most_driven: int = _DRIVEN_SEGMENTS, lead_s: float = _LEAD_S
) -> Segments:
    """Condition a recording as in the pipeline and cut it into segments.

    Segments that hold a brief fault of one sensor are left out.  Where inputs were measured, the segments are those of the
    three minutes with the largest inputs, with the inputs from one minute before; unless another number of segments,
    `most_driven`, or another lead is given.

    The band is the part of the whole band that the recording can judge, see `monitor.inference.judged_band`: where the floors'
    motion or, where they were measured, the inputs show that forces act.  Raises BadInputError if there are fewer than six
    segments: 70 s of usable data, 18 s where inputs were measured.
    """
    floors, inputs, temperature = _read(blocks, front_end)
    n_all, left_out = len(floors.segments), floors.leave_out_faults()
    design, conditioner, t0 = floors.design, floors.conditioner, floors.t0_ns
    first, last = (round(x * conditioner.cutoff_hz / design.step_hz) for x in (_BAND_START, _BAND_END))
    first = max(first, 4)
    hz = np.asarray(np.arange(last + 1) * design.step_hz, dtype=float)
    gain = np.asarray(np.abs(_filter_response(conditioner, hz)) ** 2)
    whole = Band(first, last - first + 1, design.step_hz, gain[first:])
    nothing = Drive.nothing(len(floors.segments), design, conditioner.rate_in_hz)
    located = _keep_strongest(inputs, floors, whole, most_driven, lead_s) if inputs else None
    drive, covered = located or (nothing, np.ones(len(floors.segments), dtype=bool))
    transforms, rms, tapered, peaks = (np.stack(x) for x in zip(*floors.segments.values(), strict=True))
    periodograms = np.abs(transforms[:, : last + 1]) ** 2 / gain[:, None]
    power = periodograms[:, first:].mean(axis=0)
    still = window_quality.still((2.0 * design.step_hz * power.sum(axis=0)).tolist())
    if still:
        raise BadInputError(
            f"{', '.join(f'channel {front_end.channels[c]}' for c in still)}: does not move in the band; a diagnosis takes "
            "channels that move: take what was not measured out of the structure file"
        )
    # What shakes the structure is known where inputs were measured, and has to be found in the response elsewhere.
    shown = drive.measured(whole) if drive.inputs else transforms[:, first : last + 1]
    band = find_judged_band(shown, whole)
    below = 2.0 * design.step_hz * periodograms[:, 1 : band.first + band.n_bins].sum(axis=1)
    drifts = sensor_drift.find_drift(transforms[:, : last + 1], first)
    drift = sensor_drift.density(drifts, whole.n_bins, len(front_end.channels))
    segments = Segments(
        values=transforms[:, band.first : band.first + band.n_bins],
        t_s=np.array([(t - t0) * 1e-9 for t in floors.segments]) + 0.5 / design.step_hz,
        rms=rms,
        above=np.maximum(tapered - below, 0.0),
        peaks=peaks,
        peak=floors.peak,
        piled=floors.piled,
        drive=nothing,
        temperature=np.array([((t - t0) * 1e-9, v) for t, v in temperature if np.isfinite(v)]).reshape(-1, 2),
        band=band,
        whole=whole,
        power=power,
        rate_hz=conditioner.rate_in_hz,
        resampled_hz=conditioner.rate_hz,
        samples=round(floors.seconds * conditioner.rate_hz * len(floors.segments) / n_all),
        left_out=(
            *left_out,
            *(_left_out_of_drift(d, front_end.channels[d.channel], whole) for d in drifts),
            *_hum(transforms, floors),
        ),
        drift=None if drift is None else drift[band.first - first :][: band.n_bins],
    )
    return replace(segments.part(covered), drive=drive)


def _read(
    blocks: Iterable[SampleBlock], front_end: FrontEnd
) -> tuple[_Floors, dict[str, Stream], list[tuple[int, float]]]:
    """Condition a recording's blocks: the floors, the inputs by topic, and readings of temperature (UTC ns, degC)."""
    blocks = iter(blocks)
    head = list(islice(blocks, _INPUT_TEST_BLOCKS))
    known = {GROUND, FORCE} if front_end.forces else {GROUND}
    floors = _Floors(front_end, _DRIVEN_SEGMENT_S if any(b.topic in known for b in head) else front_end.segment_s)
    inputs: dict[str, Stream] = {}
    temperature: list[tuple[int, float]] = []
    for block in chain(head, blocks):
        if block.topic == ACCELERATION:
            floors.push(block)
        elif block.topic in known:
            if block.topic not in inputs:
                names = tuple(name for name, _ in front_end.forces) if block.topic == FORCE else block.channels[:1]
                inputs[block.topic] = Stream(replace(front_end, channels=names))
            inputs[block.topic].push(block)
        elif block.topic == TEMPERATURE:
            step_ns = 1e9 / block.sample_rate_hz
            temperature += [(block.t_ns + round(i * step_ns), float(v)) for i, v in enumerate(block.samples[:, 0])]
    return floors, inputs, temperature


def _keep_strongest(
    inputs: Mapping[str, Stream], floors: _Floors, band: Band, most: int, lead_s: float
) -> tuple[Drive, NDArray[np.bool_]] | None:
    """Locate the floors' segments in the inputs as `input_response.locate` does, but keep at most `most` consecutive ones.

    The kept segments are those with the largest inputs.
    """
    design, t_ns = floors.design, list(floors.segments)
    runs = input_response.joined([stream.runs() for stream in inputs.values()], design.rate_hz)
    if not runs:
        return None
    forces = [Input(*force) for force in floors.front_end.forces]
    locate = partial(
        input_response.locate,
        tuple(chain.from_iterable(forces if topic == FORCE else [Input("ground")] for topic in inputs)),
        design=design,
        source_hz=floors.conditioner.rate_in_hz,
        filtered=partial(_filter_response, floors.conditioner),
    )
    located = locate(runs, t_ns)
    if located is None or located[0].first.size <= most:
        return located
    drive, covered = located
    first = int(np.convolve(drive.power(band), np.ones(most), mode="valid").argmax())
    chosen = np.flatnonzero(covered)[first : first + most]
    rate_hz, times = drive.design.rate_hz, [t_ns[i] for i in chosen]
    cut = []
    for begin, samples in runs:
        ends_s = np.array([times[0] - begin, times[-1] - begin]) * 1e-9 + [-lead_s, drive.design.n / rate_hz]
        low, high = np.clip(np.rint(ends_s * rate_hz).astype(int), 0, len(samples))
        if high > low:
            cut.append((begin + round(low / rate_hz * 1e9), samples[low:high]))
    located = locate(cut, times)
    assert located is not None, "covered before"
    kept = np.zeros(covered.size, dtype=bool)
    kept[chosen] = True
    return located[0], kept


class _Floors(Stream):
    """The floors' samples, which are cut into segments too, and described for faults of their sensors."""

    design: SegmentDesign
    t0_ns: int
    """UTC of the first run."""

    def __init__(self, front_end: FrontEnd, segment_s: float) -> None:
        # The conditioned samples only tell faults of a sensor, for which half the memory is enough.
        super().__init__(front_end, np.float32)
        self._segment_s, self._n = segment_s, 0
        self._lost = np.zeros(len(front_end.channels), dtype=np.int64)
        """Number of samples of each channel that are not finite."""
        self.segments: dict[int, tuple[ComplexArray, Array, Array, Array]] = {}
        """Transform, and RMS, tapered variance and largest magnitude of the source samples of every segment, by the time of its
        first sample, UTC ns."""
        self.seconds = 0.0
        self.peak = np.zeros(len(front_end.channels))
        self.piled = np.zeros(self.peak.size, dtype=np.int64)
        """Largest magnitude of each channel, and the number of samples that share it."""
        self.facts: list[list[channel_faults.RawFacts]] = []
        """Properties of the source's samples in every cell of every run."""

    @override
    def push(self, block: SampleBlock) -> list[tuple[alignment.Piece, conditioned.Conditioned]]:
        parts = super().push(block)
        if sum(len(piece.values) for piece, _ in parts) < len(block.samples):
            self._lost += (~np.isfinite(alignment.select(block, self.front_end.channels))).sum(axis=0)
        self._n += len(block.samples)
        for piece, part in parts:
            if part.begins:
                self._begin_run(piece.t_ns)
            self._describe_cells(piece.values)
            self.seconds += part.values.shape[0] / self.conditioner.rate_hz
            magnitude = np.abs(piece.values)
            top = magnitude.max(axis=0, initial=0.0)
            self.piled[top > self.peak * (1.0 + _CLIPPED_TOLERANCE)] = 0
            self.peak = np.maximum(self.peak, top)
            self.piled += (magnitude >= self.peak * (1.0 - _CLIPPED_TOLERANCE)).sum(axis=0)
            self._raw.append(piece.values)
            self._cut_segments(part.values)
        return parts

    def _silent_channels(self) -> str:
        """Say which channels have next to no samples, so that no instant has all channels; empty where none has so few."""
        shares = zip(self.front_end.channels, (self._lost / max(self._n, 1)).tolist(), strict=True)
        silent = [
            f"channel {name} has no finite sample in {100 * share:.0f} % of it" for name, share in shares if share > 0.5
        ]
        return f" ({'; '.join(silent)}; a diagnosis takes all channels)" if silent else ""

    def _begin_run(self, t_ns: int) -> None:
        if not self.facts:
            self.design, self.t0_ns = self._design_segments(), t_ns
        self._begin_ns, self._done = t_ns, 0
        """UTC of the run's first sample, and its conditioned samples before the next segment."""
        self._rest = self._before = np.zeros((0, self.peak.size))
        """Conditioned samples of the next segment; and the two source samples before the next cell."""
        self._cell: list[Array] = []
        """Source samples of the next cell."""
        self._raw: list[Array] = []
        """Source samples of the next segment."""
        self.facts.append([])

    def _describe_cells(self, samples: Annotated[Array, "samples c"]) -> None:
        """Describe the source's samples in the cells that new samples complete."""
        facts, rest = self.facts[-1], np.concatenate([*self._cell, samples])
        cell = channel_faults.CELL * self.conditioner.rate_in_hz / self.conditioner.rate_hz
        while rest.shape[0] >= (n := round((len(facts) + 1) * cell) - round(len(facts) * cell)):
            facts.append(channel_faults.RawFacts.of(rest[:n], self._before))
            self._before, rest = rest[max(0, n - 2) : n], rest[n:]
        self._cell = [rest]

    def leave_out_faults(self) -> tuple[LeftOut, ...]:
        """Drop the segments that hold a brief fault of one sensor, and return what is left out by kind and channel.

        A channel that is clipped somewhere stays: its clipped samples spoil the neighbours' prediction too, but a model of the
        sensor explains them.  Raises BadInputError where too few segments are there, or remain.
        """
        if len(self.segments) < _FEWEST_SEGMENTS:
            raise BadInputError(
                f"{self.seconds:.0f} s of usable data without a gap; a diagnosis takes at least {3.5 * self._segment_s:.0f} s"
                f"{self._silent_channels()}"
            )
        design, names, runs = self.design, self.front_end.channels, self.runs()
        found: dict[tuple[int, str], list[float]] = {}
        for fault in channel_faults.find_faults([run.values for run in runs], self.facts):
            if self.piled[fault.channel] >= MIN_PILED:
                continue
            begin, end = (runs[fault.run].t_ns + round(n / design.rate_hz * 1e9) for n in (fault.begin, fault.end))
            length_ns = round(1e9 / design.step_hz)
            for t_ns in [t for t in self.segments if t < end and t + length_ns > begin]:
                del self.segments[t_ns]
            found.setdefault((fault.channel, fault.kind), []).append((end - begin) * 1e-9)
        left_out = tuple(
            LeftOut(
                kind,
                names[channel],
                f"channel {names[channel]} has {_counted(len(lengths), kind)}, which no motion of the structure makes; "
                f"the segments that hold {'it' if len(lengths) == 1 else 'them'} are not used",
                seconds=sum(lengths),
            )
            for (channel, kind), lengths in sorted(found.items())
        )
        if len(self.segments) < _FEWEST_SEGMENTS:
            reasons = "; ".join(item.says for item in left_out)
            raise BadInputError(
                f"{len(self.segments)} segments of {1.0 / design.step_hz:g} s hold no fault of a sensor; a diagnosis "
                f"takes at least {_FEWEST_SEGMENTS} ({reasons})"
            )
        return left_out

    def _design_segments(self) -> SegmentDesign:
        """Design segments on the pipeline's grid, or shorter ones where inputs are measured."""
        conditioner = self.conditioner
        if self._segment_s < self.front_end.segment_s:
            n = 2 * round(0.5 * self._segment_s * conditioner.rate_hz)
            kept = round(conditioner.cutoff_hz * n / conditioner.rate_hz) + 1
            return SegmentDesign(conditioner.rate_hz, n, min(n // 2 + 1, kept))
        return self.front_end.grid(conditioner).segments

    def _cut_segments(self, values: Annotated[Array, "samples c"]) -> None:
        """Cut and transform the segments that new conditioned samples complete."""
        n = self.design.n
        rest = np.concatenate([self._rest, values])
        while rest.shape[0] >= n:
            t_ns = self._begin_ns + round(self._done / self.design.rate_hz * 1e9)
            raw = np.concatenate(self._raw)
            n_raw = round(n * self.conditioner.rate_in_hz / self.design.rate_hz)
            if self._done:  # the first half segment contains the filter's transient
                own = raw[:n_raw] - raw[:n_raw].mean(axis=0)
                tapered = ((taper(len(own))[:, None] * own) ** 2).sum(axis=0)
                peaks = np.abs(raw[:n_raw]).max(axis=0)
                self.segments[t_ns] = transform(self.design, rest[:n]), own.std(axis=0), tapered, peaks
            rest, self._done = rest[n // 2 :], self._done + n // 2
            self._raw = [raw[n_raw // 2 :]]
        self._rest = rest


def _left_out_of_drift(drift: Drift, name: str, band: Band) -> LeftOut:
    """Describe what a channel's drift means for the comparison with a model."""
    ranges = tuple(
        (float(band.hz[low]), float(band.hz[past - 1])) for low, past in zip(*runs_of(drift.ruled), strict=True)
    )
    says = f"channel {name} drifts, its power falling as f^-{drift.exponent}, which is taken for noise"
    if ranges:
        ruled_hz = band.bin_hz * int(drift.ruled.sum())
        says += f"; {ruled_hz:.2f} Hz of the band, where it is most of the power, are not compared"
    return LeftOut("drift", name, says, hz=ranges)


def _hum(transforms: ComplexArray, floors: _Floors) -> Iterator[LeftOut]:
    """Yield the frequencies that a hum of the mains rules."""
    rate_hz, names = floors.conditioner.rate_in_hz, floors.front_end.channels
    for hum in mains_hum.find_hum(transforms, floors.design.step_hz, rate_hz):
        order = "" if hum.harmonic == 1 else f"{hum.harmonic} times "
        alias = f" (an alias at {rate_hz:g} Hz)" if hum.is_aliased else ""
        where = "all channels alike" if hum.channel is None else f"channel {names[hum.channel]} alone"
        says = (
            f"{where} hum{'' if hum.channel is None else 's'} at {hum.hz:.2f} Hz, {order}the mains' {hum.mains_hz:g} Hz{alias}; "
            f"{hum.low_hz:.2f} to {hum.high_hz:.2f} Hz are not compared"
        )
        channel = ", ".join(names) if hum.channel is None else names[hum.channel]
        yield LeftOut("mains hum", channel, says, hz=((hum.low_hz, hum.high_hz),))


def _counted(n: int, kind: str) -> str:
    words = {
        "noise burst": ("a burst of noise", "bursts of noise"),
        "offset step": ("a step of the offset", "steps of the offset"),
    }
    single, plural = words.get(kind, (f"a {kind}", f"{kind}s"))
    return single if n == 1 else f"{n} {plural}"


def _filter_response(conditioner: Conditioner, hz: Array) -> ComplexArray:
    """Compute the frequency response of the anti-alias filter at frequencies in Hz."""
    from scipy.signal import sosfreqz  # takes most of a second to load

    return np.asarray(sosfreqz(conditioner.sos, worN=hz, fs=conditioner.rate_in_hz)[1])
