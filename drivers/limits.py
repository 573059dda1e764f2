"""Bounds on the size of what a network sends as sample blocks, the same for every transport."""

from __future__ import annotations

from pydantic import Field

from drivers.base import UNIT_OF, SampleBlock
from drivers.settings import Settings

LIMIT = 1 << 62
"""Bound of valid times, ns, and sequence numbers; the sum of two still fits 64 bits."""


class BlockLimits(Settings):
    """Part of a ``[source]`` table that bounds what is waited for, decoded and believed."""

    queue_bytes: int = Field(default=32 << 20, ge=1 << 12)
    """Greatest size of the data that wait to be read; beyond it the network waits."""
    max_payload_bytes: int = Field(default=1 << 20, ge=1, le=16 << 20)
    """Greatest size of a message; larger messages are counted, never decoded."""
    max_channels: int = Field(default=256, ge=1)
    """Greatest number of channels; blocks with more are refused."""
    max_rate_hz: float = Field(default=100e3, gt=0)
    """Greatest sample rate; blocks that state a higher rate are refused."""


def absurdity(block: SampleBlock, max_rate_hz: float = 1e7) -> str | None:
    """Say what only damage or a foreign writer explains; None if nothing is so.  Later arithmetic is in 64-bit integers."""
    if 0 <= block.t_ns < LIMIT and block.sequence < LIMIT and 1e-3 <= block.sample_rate_hz <= max_rate_hz:
        return None
    return f"time {block.t_ns} ns, sequence {block.sequence} or {block.sample_rate_hz:g} Hz is absurd"


def within_limits(block: SampleBlock, limits: BlockLimits) -> SampleBlock:
    """Return a block; raises `ValueError` if it exceeds the limits, repeats a channel, is empty or has not its topic's unit."""
    if not (
        0 < len(block.channels) <= limits.max_channels
        and len(set(block.channels)) == len(block.channels)
        and block.n_samples > 0
        and absurdity(block, limits.max_rate_hz) is None
        and block.unit == UNIT_OF.get(block.topic, block.unit)
    ):
        raise ValueError(f"{block.topic}: a block beyond the limits of the settings")
    return block
