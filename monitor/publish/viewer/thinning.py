"""Thin out long histories: after a while a file keeps envelopes of the samples and every n-th window only."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, WindowResult

FULL_RATE_NS = 2 * 3600 * 10**9
"""Samples of the first two hours are kept as they are."""
FULL_RATE_WINDOWS = 2000
"""Windows kept in full, and after each further multiple of it every second, every fourth ... window."""
_ENVELOPE = 500
"""Number of samples in a bin of which the lowest and the highest are kept afterwards."""
_GROWTH, _LONGEST = 480, 10
"""Windows by which the stretches that are sent at once grow by their first length, and to how many times that."""


class Thinning:
    """What of a recording goes into a file; its size grows with the logarithm of the windows.

    A window at which the alarm's level, or whether anything can be said, changes is always kept.
    """

    def __init__(self) -> None:
        self._first_ns: int | None = None
        self._seen = self._kept = 0
        self._state: object = None

    def window(self, result: WindowResult) -> bool:
        """Decide whether a window is kept."""
        state = (result.alarm.level, result.alarm.stories, result.skipped is None)
        stride = 1 << (self._kept // FULL_RATE_WINDOWS)
        keep = self._seen % stride == 0 or state != self._state
        self._seen, self._state = self._seen + 1, state
        self._kept += keep
        return keep

    @property
    def stretch(self) -> int:
        """How many times as much as in the beginning is sent at once: a file's writer keeps an entry of its index in memory
        for all that is sent by itself, until the file is closed."""
        return min(max(1, self._seen // _GROWTH), _LONGEST)

    def samples(self, t_ns: NDArray[np.int64], values: Array) -> tuple[NDArray[np.int64], Array]:
        """Return times, shape (n,), and samples, shape (n, c), as they are, or the lowest and the highest sample of each bin."""
        self._first_ns = int(t_ns[0]) if self._first_ns is None else self._first_ns
        if t_ns[0] - self._first_ns < FULL_RATE_NS:
            return t_ns, values
        starts = np.arange(0, len(values), _ENVELOPE)
        low = np.minimum.reduceat(values, starts, axis=0)
        high = np.maximum.reduceat(values, starts, axis=0)
        times = np.column_stack([t_ns[starts], t_ns[starts] + 1]).ravel()
        return times, np.stack([low, high], axis=1).reshape(-1, values.shape[1])
