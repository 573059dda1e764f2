"""Blocks that come a second time: a broker's queue or a publisher's cache sends again what was evaluated, as after a restart."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from drivers.base import SampleBlock

_MOST_BLOCKS = 4096
"""Latest blocks of a topic among which one that comes again is known; a publisher's cache holds 512 by default.
[count; cost: 64 kB in a checkpoint]"""


@dataclass(frozen=True, eq=False, slots=True)
class KnownBlocks:
    """Latest blocks of a topic, in the order in which they came."""

    t_ns: Annotated[NDArray[np.int64], "n"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """UTC of the first sample of each."""
    checksum: Annotated[NDArray[np.int64], "n"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Of the samples of each."""
    first: Annotated[NDArray[np.int64], "n"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Checksum of the first sample of each, by which a block that is cut otherwise is known."""


def step(state: KnownBlocks, block: SampleBlock) -> KnownBlocks | None:
    """Add a block to those that are known; None if it is one of them.

    The same samples at the same time are the same block, whatever its number: a source may count anew after a restart.  A node
    that starts again without the time may repeat times and numbers, but not the samples.

    Examples
    --------
    >>> block = SampleBlock("/acceleration", 0, 0, 1.0, ("a1",), "m/s^2", np.ones((2, 1), np.float32))
    >>> state = step(KnownBlocks(), block)
    >>> step(state, block) is None
    True
    """
    samples = np.ascontiguousarray(block.samples)
    checksum = crc32(samples.data)
    if np.any(state.checksum[state.t_ns == block.t_ns] == checksum):
        return None
    kept = slice(1 - _MOST_BLOCKS, None)
    new = block.t_ns, checksum, crc32(samples[:1].data)
    return KnownBlocks(
        *(np.append(a[kept], b) for a, b in zip((state.t_ns, state.checksum, state.first), new, strict=True))
    )


def overlaps(state: KnownBlocks, block: SampleBlock) -> bool:
    """Say whether a block holds the first sample of a known one, at its time: what it has before and beside it is known too."""
    if block.t_ns > state.t_ns.max(initial=0):  # as mostly
        return False
    samples, rate = np.ascontiguousarray(block.samples), block.sample_rate_hz
    rows = np.round((state.t_ns - block.t_ns) * 1e-9 * rate)
    inside = np.flatnonzero((rows >= 0) & (rows < block.n_samples))
    return any(crc32(samples[int(rows[i])].data) == state.first[i] for i in inside)
