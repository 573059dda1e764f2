"""What the recordings of a replay cover in time, and the windows that are due in it: those wholly inside."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

_LEAST_BETWEEN_NS = 10**9
"""Time from which on two recordings are apart. [ns; judgement: less is missing where one stream was cut into files]"""
_ROUNDING_NS = 10**6
"""Time by which a window may reach over the end of a recording and count as inside. [ns; rounding: below one sample at 100 Hz]"""


def recorded_stretches(spans: Iterable[Mapping[str, Any]]) -> list[tuple[int, int]]:
    """Join the spans of recordings, as under `recorded` in summary.json, to stretches, UTC in ns, in order.

    Recordings that follow one another as one stream, with less than `_LEAST_BETWEEN_NS` missing, are one stretch: what is
    missing there was lost.

    Examples
    --------
    >>> recorded_stretches([{"t_begin_ns": k * 10**12, "t_end_ns": k * 10**12 + 10**9} for k in range(2)])
    [(0, 1000000000), (1000000000000, 1001000000000)]
    """
    out: list[tuple[int, int]] = []
    for begin_ns, end_ns in sorted((int(span["t_begin_ns"]), int(span["t_end_ns"])) for span in spans):
        if out and begin_ns - out[-1][1] < _LEAST_BETWEEN_NS:
            out[-1] = out[-1][0], max(out[-1][1], end_ns)
        else:
            out.append((begin_ns, end_ns))
    return out


def between_recordings(spans: Iterable[Mapping[str, Any]]) -> list[tuple[int, int]]:
    """List the times between recordings, UTC in ns, in order; `spans` as in `recorded_stretches`.

    Examples
    --------
    >>> between_recordings({"t_begin_ns": k * 10**12, "t_end_ns": k * 10**12 + 10**9} for k in range(3))
    [(1000000000, 1000000000000), (1001000000000, 2000000000000)]
    """
    return [(a[1], b[0]) for a, b in pairwise(recorded_stretches(spans))]


def reaches_between(t_end_ns: int, window_s: float, between: Sequence[tuple[int, int]]) -> bool:
    """Tell whether a window that ends at `t_end_ns` holds time between recordings; none is due then.

    Examples
    --------
    >>> [reaches_between(round(t * 1e9), 20.0, [(100 * 10**9, 200 * 10**9)]) for t in (100.0, 101.0, 219.0, 220.0)]
    [False, True, True, False]
    """
    return any(a + _ROUNDING_NS < t_end_ns < b + round(window_s * 1e9) - _ROUNDING_NS for a, b in between)


def due_windows(
    ends_ns: tuple[int, int], first_ns: int, hop_ns: int, window_s: float, between: Sequence[tuple[int, int]]
) -> int:
    """Count the windows that end in ``(ends_ns[0], ends_ns[1]]``, UTC, and hold no time `between` recordings.

    `first_ns` is any end of a window, from which the others lie whole hops apart.

    Examples
    --------
    >>> s = 10**9
    >>> due_windows((0, 300 * s), 20 * s, 10 * s, 20.0, [(100 * s, 200 * s)])
    19
    """
    start, stop = ends_ns
    count, reach_ns = round((stop - start) / hop_ns), round(window_s * 1e9)
    for a, b in between:  # windows that end after `start` and up to `last` reach into it
        start, last = max(start, a + _ROUNDING_NS), min(stop, b + reach_ns - _ROUNDING_NS - 1)
        if last > start:
            count -= (last - first_ns) // hop_ns - (start - first_ns) // hop_ns
            start = last
    return count
