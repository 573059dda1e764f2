"""Thinning of long histories: after a while a file keeps envelopes of the samples and every n-th window only."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, WindowResult

FULL_RATE_NS = 2 * 3600 * 10**9
"""Span at the beginning of a recording in which all samples are kept, ns: two hours."""
FULL_RATE_WINDOWS = 2000
"""Number of windows that are all kept; after each further multiple of it every second, every fourth ... window is kept."""
_ENVELOPE = 500
"""Number of samples in a bin, of which the lowest and the highest are kept afterwards."""
_GROWTH, _LONGEST = 480, 10
"""Number of windows by which the amount sent at once grows by its first value, and the largest factor on that value."""


class Thinning:
    """Selection of the part of a recording that goes into a file; its size grows with the logarithm of the windows.

    A window is always kept where the alarm's level or stories change, or where windows begin or cease to be judged.
    """

    def __init__(self) -> None:
        self._first_ns: int | None = None
        self._seen = self._kept = 0
        self._state: object = None

    def window(self, result: WindowResult, *, changed: bool = False) -> bool:
        """Decide if a window is kept; one that changes the state of the structure always is."""
        state = (result.alarm.level, result.alarm.stories, result.skipped is None)
        stride = 1 << (self._kept // FULL_RATE_WINDOWS)
        keep = self._seen % stride == 0 or changed or state != self._state
        self._seen, self._state = self._seen + 1, state
        self._kept += keep
        return keep

    @property
    def stretch(self) -> int:
        """Factor on the amount that is sent at once: a file's writer keeps an index entry in memory for each message."""
        return min(max(1, self._seen // _GROWTH), _LONGEST)

    def samples(
        self, t_ns: Annotated[NDArray[np.int64], "n"], values: Annotated[Array, "n c"]
    ) -> tuple[Annotated[NDArray[np.int64], "k"], Annotated[Array, "k c"]]:
        """Thin out samples (UTC in ns): keep all at first, later the lowest and the highest sample of each bin."""
        self._first_ns = int(t_ns[0]) if self._first_ns is None else self._first_ns
        if t_ns[0] - self._first_ns < FULL_RATE_NS:
            return t_ns, values
        starts = np.arange(0, len(values), _ENVELOPE)
        low = np.minimum.reduceat(values, starts, axis=0)
        high = np.maximum.reduceat(values, starts, axis=0)
        times = np.column_stack([t_ns[starts], t_ns[starts] + 1]).ravel()
        return times, np.stack([low, high], axis=1).reshape(-1, values.shape[1])
