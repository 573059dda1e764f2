"""The vocabulary between a driver and whoever reads it: one block of samples, and what can go wrong."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

ACCELERATION = "/acceleration"
"""Topic of the floors' accelerations; channel names as in the structure file."""
GROUND = "/acceleration/ground"
"""Topic of the measured base motion."""
TEMPERATURE = "/temperature"
"""Topic of the temperature channels."""
UNITS = ("m/s^2", "degC")
"""Units that a block may carry."""


@dataclass(frozen=True, eq=False, slots=True)
class SampleBlock:
    """A run of consecutive samples of some channels, all taken on one clock.

    Raises
    ------
    ValueError
        If shape, rate, unit or counters contradict each other.
    """

    topic: str
    t_ns: int
    """UTC of the first sample, nanoseconds since the epoch."""
    sequence: int
    """Index of the first sample since the stream began; a jump is a gap."""
    sample_rate_hz: float
    """Nominal rate."""
    channels: tuple[str, ...]
    """Channel names in column order."""
    unit: str
    samples: NDArray[np.float32]
    """Shape (n_samples, n_channels), in `unit`."""

    def __post_init__(self) -> None:
        if self.samples.ndim != 2 or self.samples.shape[1] != len(self.channels):
            raise ValueError(f"samples must have shape (n_samples, {len(self.channels)}), got {self.samples.shape}")
        if not 0 < self.sample_rate_hz < inf:
            raise ValueError(f"sample rate must be positive and finite, got {self.sample_rate_hz}")
        if self.sequence < 0:
            raise ValueError(f"sequence must not be negative, got {self.sequence}")
        if self.unit not in UNITS:
            raise ValueError(f"unknown unit {self.unit!r}; known: {', '.join(UNITS)}")

    @property
    def n_samples(self) -> int:
        """Number of samples of each channel."""
        return int(self.samples.shape[0])


@dataclass(frozen=True, slots=True)
class ClockHealth:
    """A sensor node's clock against this machine's (or the recording's) UTC."""

    node: str
    """Channel, CAN identifier or key that the clock belongs to."""
    offset_s: float
    """UTC of arrival minus the time that samples carry, smoothed."""
    drift_ppm: float
    """How much faster than nominal the node samples."""
    drift_std_ppm: float
    steps: int
    """Jumps seen."""


@dataclass(frozen=True, slots=True)
class SourceHealth:
    """What a source has seen since it was made; counts only grow."""

    connected: bool
    counts: Mapping[str, int]
    """Event -> times, as ``samples``, ``lost_samples``, ``repeated``, ``foreign``, ``undecodable``, ``error_frames``."""
    clocks: tuple[ClockHealth, ...] = ()
    detail: str = ""
    """One sentence on the present state."""


@dataclass(frozen=True, slots=True)
class SourceContext:
    """What a driver is told besides its own table of the site file."""

    channels: tuple[str, ...]
    """The structure file's channels, in order."""
    folder: Path = field(default_factory=Path)
    """Where relative paths of the site file begin."""
    known_ns: int = 0
    """UTC up to which samples were taken in by an earlier run; a recording as source goes on from there."""


class Source(Protocol):
    """What a reader thread needs of a driver.

    A driver is a class ``Driver(settings, context)`` that opens nothing before `open`, with a class attribute
    ``Settings``: a frozen pydantic model of its ``[source]`` table that forbids unknown keys.
    """

    def open(self) -> None:
        """Connect; called again after a `SourceError` to reconnect, with all counts kept.

        Raises
        ------
        SourceError
            It cannot be reached now.
        """

    def read(self, timeout_s: float) -> SampleBlock | None:
        """The next block; None if none came in time.

        Raises
        ------
        EndOfStream
            Nothing will ever come again (a file's end).
        SourceError
            The source failed; reopening may help.
        """

    def health(self) -> SourceHealth:
        """Counts and clocks so far; may be called from any thread."""

    def close(self) -> None:
        """Release everything; calling it twice does no harm.

        What had arrived may still be handed out by `read`, which then raises `EndOfStream` or `SourceError`.
        """


class SourceError(Exception):
    """A source failed; the caller may reopen it (bus off, router gone, cable out)."""


class EndOfStream(Exception):  # noqa: N818 - an event, not an error
    """The source has given all that it has."""


class RecordingError(Exception):
    """The bytes of a recording cannot be used: damaged, foreign, wrong unit.  The message names file and mend."""


class RecordingMissingError(RecordingError):
    """The named recording does not exist, cannot be opened, or is a directory."""
