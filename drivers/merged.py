"""Small blocks that follow one another, joined: results do not depend on how samples were cut, but their cost does."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from drivers.base import ACCELERATION, SampleBlock


def merged(blocks: Iterable[SampleBlock], longest_s: float) -> Iterator[SampleBlock]:
    """The same samples in the same order; consecutive blocks of `/acceleration` joined, up to `longest_s` of them.

    Only blocks that go on where the one before ends, by sequence and to the nanosecond, are joined, and none across a block of
    another topic.
    """
    held: list[SampleBlock] = []
    n = 0
    for block in blocks:
        if held and not (_goes_on(held[0], n, block) and (n + block.n_samples) <= longest_s * block.sample_rate_hz):
            yield _joined(held)
            held, n = [], 0
        held.append(block)
        n += block.n_samples
    if held:
        yield _joined(held)


def _goes_on(first: SampleBlock, n: int, block: SampleBlock) -> bool:
    return (
        block.sequence == first.sequence + n
        and abs(block.t_ns - first.t_ns - round(n / first.sample_rate_hz * 1e9)) <= 1
        and block.topic == first.topic == ACCELERATION
        and block.sample_rate_hz == first.sample_rate_hz
        and block.channels == first.channels
        and block.unit == first.unit
    )


def _joined(held: list[SampleBlock]) -> SampleBlock:
    return held[0] if len(held) == 1 else replace(held[0], samples=np.concatenate([b.samples for b in held]))
