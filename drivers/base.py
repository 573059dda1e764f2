"""Interface between a driver and its reader: the block of samples, the source, its health and its errors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Annotated, Protocol

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

ACCELERATION = "/acceleration"
"""Topic of the floors' accelerations; channel names as in the structure file."""
GROUND = "/acceleration/ground"
"""Topic of the measured base motion."""
FORCE = "/force"
"""Topic of measured forces on the structure; channel names as in ``[[inputs]]`` of the structure file."""
TEMPERATURE = "/temperature"
"""Topic of the temperature channels."""
ROTATION_RATE = "/rotation_rate"
"""Topic of measured rates of rotation, as of gyroscopes; channel names as in ``[[sensors]]`` of the structure file."""
UNIT_OF = {ACCELERATION: "m/s^2", GROUND: "m/s^2", FORCE: "N", TEMPERATURE: "degC", ROTATION_RATE: "rad/s"}
"""Unit of each topic."""
UNITS = tuple(dict.fromkeys(UNIT_OF.values()))
"""Units that a block may carry."""


@dataclass(frozen=True, eq=False, slots=True)
class SampleBlock:
    """Block of consecutive samples of some channels, all taken on one clock; raises `ValueError` where its fields contradict.

    Examples
    --------
    >>> block = SampleBlock(ACCELERATION, 0, 0, 100.0, ("a1", "a2"), "m/s^2", np.zeros((50, 2), np.float32))
    >>> block.n_samples
    50
    """

    topic: str
    t_ns: int
    """UTC of the first sample, nanoseconds since the epoch."""
    sequence: int
    """Index of the first sample, counted from the start of the stream; a jump means a gap."""
    sample_rate_hz: float
    """Nominal rate."""
    channels: tuple[str, ...]
    unit: str
    samples: Annotated[NDArray[np.float32], "samples channels"]
    """In `unit`."""

    def __post_init__(self) -> None:
        if self.samples.ndim != 2 or self.samples.shape[1] != len(self.channels):
            raise ValueError(f"samples must have shape (n_samples, {len(self.channels)}), got {self.samples.shape}")
        if not 0 < self.sample_rate_hz < inf:
            raise ValueError(f"sample rate must be positive and finite, got {self.sample_rate_hz}")
        if self.sequence < 0:
            raise ValueError(f"sequence must not be negative, got {self.sequence}")
        if self.unit not in UNITS and (self.topic in UNIT_OF or not self.unit.strip()):  # a covariate may have any unit
            raise ValueError(f"unknown unit {self.unit!r}; known: {', '.join(UNITS)}")

    @property
    def n_samples(self) -> int:
        """Number of samples of each channel."""
        return int(self.samples.shape[0])

    @property
    def length_s(self) -> float:
        """Time from the first sample to one sampling period after the last."""
        return self.n_samples / self.sample_rate_hz

    @property
    def next_sequence(self) -> int:
        """Sequence number of the sample that follows the last."""
        return self.sequence + self.n_samples


@dataclass(frozen=True, slots=True)
class ClockHealth:
    """Offset and drift of a sensor node's clock against UTC of this machine or of the recording."""

    node: str
    """Channel, CAN identifier or key that the clock belongs to."""
    offset_s: float
    """UTC of arrival minus the time that the samples carry, smoothed."""
    drift_ppm: float
    """Excess of the node's sample rate over the nominal rate."""
    drift_std_ppm: float
    """Standard deviation of `drift_ppm`."""
    steps: int
    """Number of clock jumps so far."""


@dataclass(frozen=True, slots=True)
class SourceHealth:
    """Event counts and clocks of a source since its construction; the counts never decrease."""

    connected: bool
    counts: Mapping[str, int]
    """Event -> count, as ``samples``, ``lost_samples``, ``repeated``, ``foreign``, ``undecodable``, ``error_frames``."""
    clocks: tuple[ClockHealth, ...] = ()
    detail: str = ""
    """One sentence on the present state."""
    trouble: str = ""
    """What went wrong within the last minute though it is connected, as a refused block; empty if nothing did."""


@dataclass(frozen=True, slots=True)
class SourceContext:
    """Arguments of a driver besides its own table of the site file."""

    channels: tuple[str, ...]
    """Channels of the structure file, in order."""
    folder: Path = field(default_factory=Path)
    """Folder to which paths in the site file are relative."""
    known_ns: int = 0
    """UTC up to which an earlier run has evaluated the samples; a recording as source continues from there."""


class Source(Protocol):
    """Interface of a driver, as its reader thread uses it.

    A driver is a class ``Driver(settings, context)`` that opens nothing before `open`, with a class attribute
    ``Settings``: a frozen pydantic model of its ``[source]`` table that forbids unknown keys.
    """

    def open(self) -> None:
        """Connect to the source, or raise `SourceError`; another call after one reconnects and keeps all counts."""

    def read(self, timeout_s: float) -> SampleBlock | None:
        """Return the next block, or None if no block arrives within `timeout_s`.

        Raises `EndOfStream` at the end for good, as of a file, and `SourceError` if the source failed and reopening may help.
        """

    def health(self) -> SourceHealth:
        """Return counts and clocks so far; may be called from any thread."""

    def close(self) -> None:
        """Release all resources; a second call does no harm.

        `read` may still return blocks that had arrived, and then raises `EndOfStream` or `SourceError`.
        """


class SourceError(Exception):
    """Failure of a source that the caller may reopen (bus off, router gone, cable out)."""


class EndOfStream(Exception):  # noqa: N818 - an event, not an error
    """End of a source: no block will follow."""


class RecordingError(Exception):
    """Error of a recording whose bytes cannot be used: damaged, foreign, wrong unit.  The message names file and remedy."""


class RecordingMissingError(RecordingError):
    """Error of a recording that does not exist, cannot be opened, or is a directory."""
