"""Bounds on the size of what a network sends as sample blocks, the same for every transport."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from drivers.base import UNIT_OF, SampleBlock

_LIMIT = 1 << 62
"""Bound of valid times, ns, and sequence numbers; the sum of two still fits 64 bits."""


class BlockLimits(BaseModel):
    """Part of a ``[source]`` table that bounds what is waited for, decoded and believed."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    queue_bytes: int = Field(default=32 << 20, ge=1 << 12)
    """Greatest size of the data that wait to be read; beyond it the network waits."""
    max_payload_bytes: int = Field(default=1 << 20, ge=1, le=16 << 20)
    """Greatest size of a message; larger messages are counted, never decoded."""
    max_channels: int = Field(default=256, ge=1)
    """Greatest number of channels; blocks with more are refused."""
    max_rate_hz: float = Field(default=100e3, gt=0)
    """Greatest sample rate; blocks that state a higher rate are refused."""


def within_limits(block: SampleBlock, limits: BlockLimits) -> SampleBlock:
    """Return a block; raises `ValueError` if it exceeds the limits, repeats a channel, is empty or has not its topic's unit."""
    if not (
        0 < len(block.channels) <= limits.max_channels
        and len(set(block.channels)) == len(block.channels)
        and block.n_samples > 0
        and 1e-3 <= block.sample_rate_hz <= limits.max_rate_hz
        and 0 <= block.t_ns < _LIMIT
        and block.sequence < _LIMIT
        and block.unit == UNIT_OF.get(block.topic, block.unit)
    ):
        raise ValueError(f"{block.topic}: a block beyond the limits of the settings")
    return block
