"""Runs of flags along time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Indices = NDArray[np.intp]


def runs_of(flags: NDArray[np.bool_]) -> tuple[Indices, Indices]:
    """Find the first index of each run of true flags, and the one past its last.

    Examples
    --------
    >>> first, past = runs_of(np.array([True, False, True, True]))
    >>> first.tolist(), past.tolist()
    ([0, 2], [1, 4])
    """
    edges = np.flatnonzero(np.diff(flags, prepend=False, append=False))
    return edges[::2], edges[1::2]
