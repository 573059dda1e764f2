"""Latest blocks of samples in memory, for a diagnosis or the recording of an event that asks for them later."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from math import ceil

from drivers.base import ACCELERATION, SampleBlock

_MAX_BLOCKS = 200_000
"""Blocks kept at most, whatever their length, so that memory stays bounded with blocks of single samples."""
MARGIN_S = 30.0
"""Seconds of data kept beyond the longest span that is asked for: a request arises with the block that completes its window, an
event is recognized some seconds after it began, and a block may be long."""


class RecentBlocks:
    """Latest blocks of samples in the order of arrival, kept for one who asks for `longest_s` of acceleration at most.

    Examples
    --------
    >>> import numpy as np
    >>> recent = RecentBlocks(longest_s=60.0)
    >>> recent.push(SampleBlock(ACCELERATION, 0, 0, 10.0, ("a1",), "m/s^2", np.zeros((20, 1), np.float32)))
    >>> [block.n_samples for block in recent.between(500_000_000, 1_500_000_000)]
    [10]
    """

    def __init__(self, longest_s: float) -> None:
        self.longest_s = longest_s
        self._seconds = 0.0
        self.blocks: deque[SampleBlock] = deque()

    def push(self, block: SampleBlock, *, drop: bool = True) -> None:
        """Keep a block, and discard the blocks that are too old unless all are wanted for a while.

        The age of a block is the length of the data since then, because clocks may stand still or be set back.
        """
        self.blocks.append(block)
        self._seconds += _length_s(block)
        longest_s = self.longest_s + MARGIN_S
        while drop and (self._seconds - _length_s(self.blocks[0]) > longest_s or len(self.blocks) > _MAX_BLOCKS):
            self._seconds -= _length_s(self.blocks.popleft())

    def between(self, from_ns: int, to_ns: int) -> list[SampleBlock]:
        """Return the samples taken from `from_ns` to `to_ns` (UTC, ns), cut out of the blocks."""
        return [b for block in self.blocks if (b := _cut_to_span(block, from_ns, to_ns)).n_samples]


def _cut_to_span(block: SampleBlock, from_ns: int, to_ns: int) -> SampleBlock:
    """Cut a block to its samples from `from_ns` to `to_ns` (UTC, ns)."""
    first, end = (
        min(max(ceil(round((t - block.t_ns) * 1e-9 * block.sample_rate_hz, 6)), 0), block.n_samples)
        for t in (from_ns, to_ns)
    )
    if end - first == block.n_samples:
        return block
    t_ns = block.t_ns + round(first / block.sample_rate_hz * 1e9)
    return replace(block, t_ns=t_ns, sequence=block.sequence + first, samples=block.samples[first:end])


def _length_s(block: SampleBlock) -> float:
    """Return the length of a block of acceleration, s; 0 for other topics, which run in parallel."""
    return block.n_samples / block.sample_rate_hz if block.topic == ACCELERATION else 0.0
