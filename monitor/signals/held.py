"""Readings that stand several times in a row: a logger that is read faster than its sensor delivers."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from monitor.core import Array

_SHARE = 0.95
"""Share of the readings that must stand equally often. [ratio; judgement: two readings may be equal by chance, or one be lost]"""
_LEAST = 32
"""Readings from which it can be told. [readings; judgement]"""


def times_held(values: Annotated[Array, "n c"]) -> int:
    """Return how often each reading of all channels stands in a row; 1 where they change with each sample, or at no pace.

    Examples
    --------
    >>> readings = np.random.default_rng(0).normal(size=(100, 2))
    >>> times_held(readings), times_held(np.repeat(readings, 2, axis=0))
    (1, 2)
    """
    new = np.flatnonzero((values[1:] != values[:-1]).any(axis=1)) + 1
    if len(new) < _LEAST:
        return 1
    lengths = np.diff(new)
    often = int(np.median(lengths))
    return often if np.mean(lengths == often) >= _SHARE else 1


def each_once(values: Annotated[Array, "n c"], often: int) -> Annotated[Array, "m c"]:
    """Keep one of readings that stand `often` times in a row."""
    new = np.flatnonzero((values[1:] != values[:-1]).any(axis=1)) + 1
    first = int(new[0]) % often if len(new) else 0
    return values[first::often]
