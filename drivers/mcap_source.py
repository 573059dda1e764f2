"""Recordings as a live source: at the data's own pace, some times faster, or as fast as they are taken."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from drivers.base import ACCELERATION, EndOfStream, RecordingMissingError, SampleBlock, SourceContext, SourceHealth
from drivers.mcap_file import read_recordings

_log = logging.getLogger(__name__)


class McapSettings(BaseModel):
    """``[source]`` with ``kind = "mcap"``."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    kind: Literal["mcap"]
    files: tuple[str, ...] = Field(min_length=1)
    """Recordings, relative to the site file; patterns as ``recordings/*.mcap`` too."""
    speed: float | None = Field(default=None, gt=0)
    """Times real time; as fast as possible without."""
    topics: dict[str, str] = Field(default_factory=dict)
    """ROS 2 Imu topic to channel, as ``"/imu/top" = "a1.x"``."""


class McapSource:
    """Gives the blocks of recordings, then ends (see `drivers.base.Source`)."""

    Settings = McapSettings

    def __init__(
        self, settings: McapSettings, context: SourceContext, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._settings, self._context, self._clock = settings, context, clock
        self._blocks: Iterator[SampleBlock] | None = None
        self._next: SampleBlock | None = None
        self._first_ns: int | None = None
        self._begun_s = 0.0
        self._counts: Counter[str] = Counter(blocks=0, samples=0)

    def open(self) -> None:
        """Check the files and begin at their first block.

        Raises
        ------
        RecordingMissingError, RecordingError
            A file is not there or not whole; waiting mends neither.
        """
        blocks = read_recordings(self._paths(), topic_map=self._settings.topics or None, on_warning=_log.warning)
        self._blocks = (block for block in blocks if not self._known(block))
        self._next, self._first_ns, self._begun_s = None, None, self._clock()

    def read(self, timeout_s: float) -> SampleBlock | None:
        """The next block once it is due.

        Raises
        ------
        EndOfStream
            That was the last.
        """
        if self._next is None:
            self._next = next(self._blocks, None) if self._blocks is not None else None
        block = self._next
        if block is None:
            raise EndOfStream("the recordings have ended")
        if self._settings.speed is not None:
            self._first_ns = block.t_ns if self._first_ns is None else self._first_ns
            end_s = (block.t_ns - self._first_ns) * 1e-9 + block.n_samples / block.sample_rate_hz
            wait_s = self._begun_s + end_s / self._settings.speed - self._clock()
            time.sleep(max(0.0, min(wait_s, timeout_s)))
            if wait_s > timeout_s:
                return None
        self._next = None
        self._counts["blocks"] += 1
        self._counts["samples"] += block.n_samples if block.topic == ACCELERATION else 0
        return block

    def health(self) -> SourceHealth:
        """Counts so far."""
        return SourceHealth(self._blocks is not None, dict(self._counts))

    def close(self) -> None:
        """Let go of the files."""
        self._blocks = None

    def _known(self, block: SampleBlock) -> bool:
        """Whether its last sample was taken before."""
        return block.t_ns + (block.n_samples - 0.5) / block.sample_rate_hz * 1e9 < self._context.known_ns

    def _paths(self) -> list[Path]:
        paths: list[Path] = []
        for name in self._settings.files:
            if not any(sign in name for sign in "*?["):
                paths.append(self._context.folder / name)
                continue
            place = Path(name)
            root = Path(place.anchor) if place.is_absolute() else self._context.folder
            found = sorted(root.glob(str(place.relative_to(place.anchor))))
            if not found:
                raise RecordingMissingError(f"{self._context.folder / name}: no recording has such a name")
            paths += found
        return paths
