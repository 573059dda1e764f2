"""Joins small consecutive blocks: results do not depend on how samples are cut into blocks, but the run time does."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from drivers.base import ACCELERATION, SampleBlock


def merged(blocks: Iterable[SampleBlock], longest_s: float) -> Iterator[SampleBlock]:
    """Join consecutive blocks of `/acceleration` to blocks of at most `longest_s` seconds, with all samples in order.

    Two blocks are joined only if the second continues the first without a gap, by sequence and to the nanosecond, and no
    block of another topic lies between them.

    Examples
    --------
    >>> parts = [SampleBlock(ACCELERATION, n * 10**9, n * 10, 10.0, ("a1",), "m/s^2", np.zeros((10, 1), np.float32))
    ...          for n in range(3)]
    >>> [block.n_samples for block in merged(parts, longest_s=2.0)]
    [20, 10]
    """
    pending: list[SampleBlock] = []
    n = 0
    for block in blocks:
        fits = n + block.n_samples <= longest_s * block.sample_rate_hz
        if pending and not (fits and _continues(pending[0], n, block)):
            yield _join(pending)
            pending, n = [], 0
        pending.append(block)
        n += block.n_samples
    if pending:
        yield _join(pending)


def _continues(first: SampleBlock, n: int, block: SampleBlock) -> bool:
    """Test whether a block follows the `n` samples that begin with the block `first`."""
    return (
        block.sequence == first.sequence + n
        and abs(block.t_ns - first.t_ns - round(n / first.sample_rate_hz * 1e9)) <= 1
        and block.topic == first.topic == ACCELERATION
        and block.sample_rate_hz == first.sample_rate_hz
        and block.channels == first.channels
        and block.unit == first.unit
    )


def _join(pending: list[SampleBlock]) -> SampleBlock:
    if len(pending) == 1:
        return pending[0]
    return replace(pending[0], samples=np.concatenate([block.samples for block in pending]))
