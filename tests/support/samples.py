"""A small frame with short windows, samples cut into blocks, and the types of shared fixtures."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

from drivers.base import ACCELERATION, SampleBlock
from drivers.mcap_file import McapWriter
from tests.support.frame_text import THREE_STORIES

FRAME = (
    THREE_STORIES
    + """
[processing]
window_s = 20.0
hop_s = 5.0

[identification]
block_rows = 10
"""
)

T0_NS = 1_767_225_600_000_000_000
CHANNELS = ("a1", "a2", "a3")
Cut = Callable[..., list[SampleBlock]]
Cli = Callable[..., subprocess.CompletedProcess[str]]


def _cut(
    values: np.ndarray,
    rate_hz: float,
    sizes: Sequence[int] = (100,),
    *,
    t0_ns: int = T0_NS,
    first: int = 0,
    channels: tuple[str, ...] = CHANNELS,
) -> list[SampleBlock]:
    """Blocks of `sizes` samples, taken over and over; `first` is the first sample's sequence."""
    blocks, start, count = [], 0, 0
    while start < len(values):
        part = values[start : start + sizes[count % len(sizes)]].astype(np.float32)
        t_ns = t0_ns + round((first + start) / rate_hz * 1e9)
        blocks.append(SampleBlock(ACCELERATION, t_ns, first + start, rate_hz, channels, "m/s^2", part))
        start, count = start + len(part), count + 1
    return blocks


def write_blocks(path: Path, blocks: Iterable[SampleBlock]) -> Path:
    """Write a recording of these blocks."""
    with McapWriter(path) as writer:
        for block in blocks:
            writer.write(block)
    return path
