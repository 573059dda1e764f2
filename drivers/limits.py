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
    """Return a block; raises `ValueError`, saying why, if it is empty, beyond a limit, of a wrong unit or repeats a channel."""
    n, unit = len(block.channels), UNIT_OF.get(block.topic, block.unit)
    reason = absurdity(block, limits.max_rate_hz)
    if not 0 < n <= limits.max_channels:
        reason = f"{n} channels, where max_channels = {limits.max_channels}"
    elif len(set(block.channels)) < n:
        twice = next(name for name in block.channels if block.channels.count(name) > 1)
        reason = f"channel {twice!r} stands twice"
    elif block.n_samples == 0:
        reason = "no samples"
    elif block.unit != unit:
        reason = f"its unit is {block.unit!r}, not {unit!r}"
    if reason is not None:
        raise ValueError(reason)
    return block
