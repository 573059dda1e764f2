"""Numbered blocks, and what of them arrived."""

from __future__ import annotations

import time

import numpy as np

from drivers.base import ACCELERATION, SampleBlock, Source

KEY = "shm/test-frame/acceleration"
T0_NS = 1_767_225_600_000_000_000
N = 16
RATE = 1024.0
CHANNELS = ("a1", "a2", "a3")
PATIENCE_S = 60.0


def block(i: int, n: int = N, t0_ns: int = T0_NS) -> SampleBlock:
    values = np.full((n, 3), i, dtype=np.float32)
    return SampleBlock(ACCELERATION, t0_ns + round(i * n / RATE * 1e9), i * n, RATE, CHANNELS, "m/s^2", values)


def take(source: Source, count: int) -> list[int]:
    """Numbers of the next blocks."""
    numbers: list[int] = []
    deadline = time.monotonic() + PATIENCE_S
    while len(numbers) < count and time.monotonic() < deadline:
        got = source.read(0.2)
        if got is not None:
            numbers.append(got.sequence // N)
    return numbers
