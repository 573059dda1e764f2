"""Latest blocks of samples on the disk, where the recorder has them anyway, in place of twenty minutes of data in memory."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from queue import Empty, SimpleQueue

from drivers.base import SampleBlock
from drivers.mcap_writer import arrival
from drivers.recorder import recorded
from monitor.runs import RecentBlocks
from monitor.service.threads import Recording

_WAIT_S = 60.0
"""Longest wait until the recorder has written the blocks that a diagnosis needs. [s; judgement]"""
_BLOCK_NS = 600_000_000_000
"""Length of the longest block whose end a span may need. [ns; judgement]"""


class RecordedBlocks:
    """Store of the latest blocks that reads them from the recordings when a diagnosis asks (`monitor.runs.BlockStore`).

    A diagnosis, which may ask for data of `longest_s`, gets the blocks that one in memory would get, as far as they were
    recorded.
    """

    longest_s = 0.0  # nothing need be kept again after a restart

    def __init__(self, folder: Path, recording: Recording, longest_s: float) -> None:
        self._folder, self._recording, self._longest_s = folder, recording, longest_s

    def push(self, block: SampleBlock) -> None:
        """Keep nothing: the recorder has the block."""

    def between(self, from_ns: int, to_ns: int) -> Iterator[SampleBlock]:
        """Return the samples taken from `from_ns` to `to_ns` (UTC, ns), read when they are asked for.

        Reading raises OSError where the recorder does not answer.
        """
        written: SimpleQueue[int] = SimpleQueue()
        return self._read(written, from_ns, to_ns, self._recording.then(written.put))

    def _read(self, written: SimpleQueue[int], from_ns: int, to_ns: int, asked: bool) -> Iterator[SampleBlock]:
        """Wait for the recorder, then yield the samples of the span."""
        try:
            last_ns = written.get(timeout=_WAIT_S if asked else 0.0)
        except Empty as error:
            raise OSError(None, "the recorder does not answer", str(self._folder)) from error
        begin_ns = last_ns - last_ns % arrival(0, 1) + from_ns - _BLOCK_NS  # by the clock as it is set now
        recent = RecentBlocks(self._longest_s)
        for stamp_ns, block in recorded(self._folder, begin_ns, unfinished=True):
            if stamp_ns > last_ns:
                break
            recent.push(block)
        yield from recent.between(from_ns, to_ns)
