"""Plays recordings as a live source: at the pace of the data, faster by a factor, or as fast as possible."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal

from pydantic import Field

from drivers.base import ACCELERATION, EndOfStream, RecordingMissingError, SampleBlock, SourceContext, SourceHealth
from drivers.mcap_file import read_recordings
from drivers.settings import Settings

_log = logging.getLogger(__name__)


class McapSettings(Settings):
    """Table ``[source]`` with ``kind = "mcap"``."""

    kind: Literal["mcap"]
    files: tuple[str, ...] = Field(min_length=1)
    """Recordings, relative to the site file; patterns such as ``recordings/*.mcap`` are allowed."""
    speed: float | None = Field(default=None, gt=0)
    """Speed as a multiple of real time; as fast as possible by default.  Gaps, as between recordings, are not waited for."""
    topics: dict[str, str] = Field(default_factory=dict)
    """Channel of each ROS 2 Imu topic, as ``"/imu/top" = "a1.x"``."""


class McapSource:
    """Source of the blocks of recordings, which ends after the last block (see `drivers.base.Source`)."""

    Settings = McapSettings

    def __init__(
        self,
        settings: McapSettings,
        context: SourceContext,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._settings, self._context, self._clock, self._sleep = settings, context, clock, sleep
        self._blocks: Iterator[SampleBlock] | None = None
        self._next: SampleBlock | None = None
        self._begun_s = 0.0
        self._played_s = 0.0
        """Length of the acceleration data given so far, s, from which the next block is due."""
        self._counts: Counter[str] = Counter(blocks=0, samples=0)

    def open(self) -> None:
        """Check the files, and start with the first block that is not yet evaluated (errors as `read_recordings`)."""
        blocks = read_recordings(self._paths(), topic_map=self._settings.topics or None, on_warning=_log.warning)
        self._blocks = (block for block in blocks if not self._known(block))
        self._next, self._begun_s, self._played_s = None, self._clock(), 0.0

    def read(self, timeout_s: float) -> SampleBlock | None:
        """Return the next block when it is due; None if it is not due within `timeout_s`."""
        if self._next is None:
            self._next = next(self._blocks, None) if self._blocks is not None else None
        block = self._next
        if block is None:
            raise EndOfStream("the recordings have ended")
        end_s = self._played_s + (block.length_s if block.topic == ACCELERATION else 0.0)
        if self._settings.speed is not None:
            wait_s = self._begun_s + end_s / self._settings.speed - self._clock()
            self._sleep(max(0.0, min(wait_s, timeout_s)))
            if wait_s > timeout_s:
                return None
        self._next, self._played_s = None, end_s
        self._counts["blocks"] += 1
        self._counts["samples"] += block.n_samples if block.topic == ACCELERATION else 0
        return block

    def health(self) -> SourceHealth:
        """Return the counts of blocks and of acceleration samples so far."""
        return SourceHealth(self._blocks is not None, dict(self._counts))

    def close(self) -> None:
        """Release the files."""
        self._blocks = None

    def _known(self, block: SampleBlock) -> bool:
        """Test whether an earlier run has evaluated the block to its last sample."""
        return block.t_ns + (block.n_samples - 0.5) / block.sample_rate_hz * 1e9 < self._context.known_ns

    def _paths(self) -> list[Path]:
        """List the recordings that the names and patterns of the settings denote."""
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
