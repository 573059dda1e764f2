"""Record of a recording's witnesses beside its floors: conditioned alike, and transformed over the same segments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from typing import Annotated

import numpy as np
from typing_extensions import override

from drivers.base import ACCELERATION, GROUND, ROTATION_RATE, SampleBlock
from monitor.core import Array, BadInputError, ComplexArray
from monitor.signals import FrontEnd, SegmentDesign, Stream, alignment, conditioned, transform


@dataclass(frozen=True, slots=True)
class WitnessSensor:
    """Sensor of another quantity or axis than the motion that the model describes."""

    channel: str
    quantity: str
    """``acceleration`` or ``rotation_rate``."""
    axis: str
    """``x`` (the direction of the model's motion), ``y`` or ``z`` (up)."""
    floor: int
    """Floor, from 1 (top), or degree of freedom; 0 for the ground."""
    mounted: str = "joint"
    """``joint``, or ``midspan`` of a girder."""

    @property
    def turns(self) -> bool:
        """Whether it measures a rotation."""
        return self.quantity == "rotation_rate"

    @property
    def topic(self) -> str:
        """Topic of its samples."""
        return ROTATION_RATE if self.turns else ACCELERATION


@dataclass(frozen=True, eq=False, slots=True)
class WitnessTransforms:
    """Tapered transforms of half-overlapping segments that the floors and the witnesses cover together."""

    hz: Annotated[Array, "bins"]
    floors: Annotated[ComplexArray, "segments bins c"]
    """Accelerations of the floors, m/s^2/sqrt(Hz)."""
    ground: Annotated[ComplexArray, "segments bins"] | None
    """The ground's; None where it was not measured."""
    witnesses: dict[str, Annotated[ComplexArray, "segments bins"]]
    """Of each witness in the recording, in m/s^2 or rad/s, over the same segments."""
    still: frozenset[str]
    """Witnesses that read one value throughout."""


class WitnessRecord:
    """Record of the floors, the ground and the witnesses of a recording, block by block.

    The witnesses are conditioned as the floors; those that the recording does not hold are left out.
    """

    def __init__(self, front_end: FrontEnd, sensors: Sequence[WitnessSensor]) -> None:
        self._front_end, self._sensors = front_end, tuple(sensors)
        self._streams: dict[tuple[str, bool], _Channels | None] = {}
        self._unusable: set[str] = set()
        """Topics with blocks of a rate that cannot be conditioned."""

    def add(self, block: SampleBlock) -> None:
        """Take a block of any topic.

        Raises
        ------
        BadInputError
            If the block's unit is not that of its topic, or a channel of the floors is missing.
        """
        if not self._sensors:
            return
        if block.topic == ACCELERATION:
            self._push(block, self._front_end.channels, is_witness=False)
        elif block.topic == GROUND:
            self._push(block, block.channels[:1], is_witness=False)
        self._push(block, tuple(s.channel for s in self._sensors if s.topic == block.topic), is_witness=True)

    def _push(self, block: SampleBlock, channels: tuple[str, ...], *, is_witness: bool) -> None:
        """Condition those of the channels that the stream's first block holds."""
        try:
            self._front_end.check_rate(block.sample_rate_hz)
        except BadInputError:  # no reason to end a diagnosis, in which a witness has no part
            self._unusable.add(block.topic)
            return
        key = (block.topic, is_witness)
        if key not in self._streams:
            held = tuple(name for name in channels if not is_witness or name in block.channels)
            self._streams[key] = _Channels(self._front_end, held) if held else None
        stream = self._streams[key]
        # A channel that a later block no longer holds has ended; of the floors' channels all are needed.
        if stream is not None and (not is_witness or set(stream.front_end.channels) <= set(block.channels)):
            stream.push(block)

    def transforms(self, segment_s: float) -> WitnessTransforms | None:
        """Transform the segments that all streams cover; None where there is no such segment.

        Streams of another sample rate than the floors' are left out, since the lowpass would delay them differently.
        """
        floors, ground = (self._streams.get((topic, False)) for topic in (ACCELERATION, GROUND))
        if floors is None or floors.rate_hz is None or GROUND in self._unusable:
            return None
        witnesses = [s for (_, is_witness), s in self._streams.items() if is_witness and s is not None]
        beside = [s for s in (ground, *witnesses) if s is not None and s.rate_hz == floors.rate_hz]
        if ground is not None and ground not in beside:
            return None
        rate_hz, cutoff_hz = floors.conditioner.rate_hz, floors.conditioner.cutoff_hz
        n = max(2, round(segment_s * rate_hz))
        design = SegmentDesign(rate_hz, n, min(n // 2 + 1, int(cutoff_hz * n / rate_hz) + 1))
        hz = np.asarray(np.arange(design.n_bins) * design.step_hz)
        rows = _common_segments(floors, beside, design, hz)
        if not rows:
            return None
        moved, *rest = (np.stack(parts) for parts in zip(*rows, strict=True))
        by_stream = [(s, series) for s, series in zip(beside, rest, strict=True) if s is not ground]
        found = {name: series[:, :, k] for s, series in by_stream for k, name in enumerate(s.front_end.channels)}
        still = frozenset(
            name for s in witnesses for name, moves in zip(s.front_end.channels, s.moves, strict=True) if not moves
        )
        return WitnessTransforms(hz, moved, None if ground is None else rest[0][:, :, 0], found, still)


class _Channels(Stream):
    """Conditioned samples of some channels of one topic, and which of them move."""

    def __init__(self, front_end: FrontEnd, channels: tuple[str, ...]) -> None:
        super().__init__(replace(front_end, channels=channels), np.float32)
        self._first: Array | None = None
        self.moves = np.zeros(len(channels), dtype=bool)
        """Whether a channel ever read another value than its first."""

    @override
    def push(self, block: SampleBlock) -> list[tuple[alignment.Piece, conditioned.Conditioned]]:
        parts = super().push(block)
        for piece, _ in parts:
            if self._first is None and len(piece.values):
                self._first = piece.values[0]
            self.moves |= (piece.values != self._first).any(axis=0)
        return parts

    @property
    def rate_hz(self) -> float | None:
        """Rate of the source's samples; None before the first."""
        return self.conditioner.rate_in_hz if self._runs else None

    @override
    def runs(self) -> list[conditioned.Run]:
        # Samples of another rate do not go together with those that follow.
        latest = takewhile(lambda run: run.conditioner.rate_in_hz == self.rate_hz, reversed(super().runs()))
        return list(latest)[::-1]


def _cut(
    runs: Sequence[conditioned.Run], begin_ns: int, design: SegmentDesign, hz: Array
) -> Annotated[ComplexArray, "bins k"] | None:
    """Transform the segment that begins at a time, UTC ns; None where the samples do not cover it.

    The segment begins at the nearest sample, and the rest of the time is put into the phase.
    """
    for run in runs:
        first = round((begin_ns - run.t_ns) * 1e-9 * design.rate_hz)
        if first >= design.n // 2 and first + design.n <= len(run.values):
            late_s = first / design.rate_hz - (begin_ns - run.t_ns) * 1e-9
            turned = np.exp(-2j * np.pi * hz * late_s)
            return np.asarray(turned[:, None] * _transform(design, run.values[first : first + design.n]))
    return None


def _transform(design: SegmentDesign, samples: Annotated[Array, "n k"]) -> Annotated[ComplexArray, "bins k"]:
    return transform(design, samples - samples.mean(axis=0, dtype=np.float64))


def _common_segments(
    floors: _Channels, beside: Sequence[_Channels], design: SegmentDesign, hz: Array
) -> list[list[ComplexArray]]:
    """Transform the half-overlapping segments of the floors that all streams beside them cover, each with theirs."""
    n, others, out = design.n, [stream.runs() for stream in beside], []
    for run in floors.runs():
        # The first half segment holds the filter's transient.
        for first in range(n // 2, len(run.values) - n + 1, n // 2):
            begin_ns = run.t_ns + round(first / design.rate_hz * 1e9)
            parts = [part for runs in others if (part := _cut(runs, begin_ns, design, hz)) is not None]
            if len(parts) == len(beside):
                out.append([_transform(design, run.values[first : first + n]), *parts])
    return out
