"""The samples of an event, as they are described: on one grid, with the filter taken out, floors and ground together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from monitor.core import Array
from monitor.events.ground import Ground
from monitor.events.motion import without_filter
from monitor.events.recognition import DEAD
from monitor.events.site import Site
from monitor.signals import Conditioner

_SPLINE_S = 1.0
"""Time beyond an event's samples within which the ground's samples take part in their interpolation. [s; less than
`_GROUND_LATE_S`, so that they are there however late they arrive]"""
_CORNERS = (0.4, 0.2, 0.1, 0.05, 0.025)
"""Corners of the integrated drifts to choose from, over the lowest frequency. [ratio; below the lowest frequency a frame
follows the ground, and its drift is the ground's acceleration over the squared angular frequency]"""
_LOWEST_CORNER = 2.0
"""Lowest corner, over the reciprocal of the quiet time before the event. [ratio; two periods of quiet motion]"""


@dataclass(frozen=True, eq=False, slots=True)
class Record:
    """Samples of an event, with quiet motion before it and, for the final line, after it."""

    t_ns: int
    """UTC of the first sample."""
    rate_hz: float
    floors: Annotated[Array, "n c"]
    """m/s^2."""
    ground: Annotated[Array, "n"] | None
    """m/s^2."""
    strong: slice
    still: Annotated[NDArray[np.bool_], "c"]
    """Channels that stood still while others moved, as dead ones and those that lost samples do."""
    corners_hz: Annotated[Array, "corners"]
    """Corners of the integration to choose from."""


def make_record(
    values: Annotated[Array, "n c"],
    t_ns: int,
    conditioner: Conditioner,
    ground: tuple[Sequence[Ground], Conditioner | None],
    strong: slice,
    site: Site,
) -> Record:
    """Put conditioned samples of an event and the measured ground motion on one grid; the filter's delay is taken off `t_ns`."""
    rate_hz, corners_hz = conditioner.rate_hz, np.array(_CORNERS) * site.lowest_hz
    return Record(
        t_ns=t_ns,
        rate_hz=rate_hz,
        floors=without_filter(values, rate_hz, conditioner),
        ground=_interpolated(*ground, t_ns, len(values), rate_hz),
        strong=strong,
        still=_still_channels(values, strong, rate_hz),
        corners_hz=np.clip(_LOWEST_CORNER * rate_hz / max(strong.start, 1), corners_hz, corners_hz[0]),
    )


def relative_motion(record: Record, site: Site) -> Annotated[Array, "n c"]:
    """Return the floors' motion, less that of the ground where it was measured, m/s^2."""
    return record.floors if record.ground is None else record.floors - record.ground[:, None] * site.rides


def _still_channels(
    values: Annotated[Array, "n c"], strong: slice, rate_hz: float
) -> Annotated[NDArray[np.bool_], "c"]:
    """Find the channels that stood still in some second of strong motion."""
    n = max(1, round(rate_hz))
    part = values[strong]
    seconds = part[: len(part) // n * n].reshape(-1, n, part.shape[1])
    ranges = np.ptp(seconds, axis=1)
    return np.asarray((ranges < np.sqrt(DEAD) * ranges.max(axis=1, keepdims=True, initial=0.0)).any(axis=0))


def _interpolated(
    ground: Sequence[Ground], conditioner: Conditioner | None, t_ns: int, n: int, rate_hz: float
) -> Annotated[Array, "n"] | None:
    """Interpolate the measured ground motion to the samples of the grid; None where it does not cover them."""
    if not ground or conditioner is None:
        return None
    at, values = [], []
    for piece in ground:
        at.append((piece.t_ns - t_ns) * 1e-9 + np.arange(piece.values.size) / piece.rate_hz)
        values.append(piece.values)
    wanted = np.arange(n) / rate_hz
    t_s, index = np.unique(np.concatenate(at), return_index=True)
    near = (t_s > -_SPLINE_S) & (t_s < wanted[-1] + _SPLINE_S)
    t_s, moved = t_s[near], np.concatenate(values)[index][near]
    if not t_s.size or t_s[0] > 0.0 or t_s[-1] < wanted[-1]:
        return None
    moved = make_interp_spline(t_s, moved)(wanted)
    return without_filter(moved[:, None], rate_hz, conditioner)[:, 0]
