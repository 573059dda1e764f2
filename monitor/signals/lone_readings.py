"""Lone readings that no structure gives: a converter's slip, or a bit that fell over, for one sample of one channel.

Such a reading would change the velocity of what carries the sensor within one sample by more than any ground or floor moves, and
lies 40 dB above everything that the channel has shown.  A quake fills its band and grows over many samples, and a hammer moves no
floor that fast.  A channel may go on beyond it: of two such readings in a row the second is taken as it is, and what follows is
judged by it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array

_MOST_SPEED = 5.0
"""Change of velocity within one sample from which no structure gives a reading. [m/s; judgement: beyond the largest peak ground
velocity that was recorded, some 4 m/s]"""
_LONE = 100.0
"""Least magnitude of such a reading over all that its channel has shown. [ratio; judgement: 40 dB, ten times
what the samples of a quake grow by from one to the next]"""


@dataclass(frozen=True, slots=True)
class Shown:
    """What the channels have shown so far."""

    reach: tuple[float, ...] = ()
    """Largest magnitude of each channel, m/s^2; empty before the first reading."""
    after_lone: tuple[bool, ...] = ()
    """Whether the channel's latest reading was a lone one."""


def step(shown: Shown, values: Annotated[Array, "n c"], rate_hz: float) -> tuple[Shown, NDArray[np.bool_] | None]:
    """Find the lone readings among the next ones, m/s^2, of which those that are not finite say nothing; None where none is.

    Examples
    --------
    >>> x = np.array([[0.01], [0.02], [2e4], [-0.01]])
    >>> step(Shown(), x, 100.0)[1].ravel().tolist()
    [False, False, True, False]
    """
    n, c = values.shape
    if not n:
        return shown, None
    size = np.nan_to_num(np.abs(values), nan=0.0, posinf=0.0, neginf=0.0)
    reach, after = np.array(shown.reach or (0.0,) * c), np.array(shown.after_lone or (False,) * c)
    lone = np.zeros((n, c), dtype=bool)
    fast = size > _MOST_SPEED * rate_hz
    for k in np.flatnonzero(fast.any(axis=0)):
        before = np.maximum.accumulate(np.append(reach[k], np.where(fast[:, k], 0.0, size[:, k])))
        taken, first = 0.0, int(after[k])
        for at in np.flatnonzero(fast[:, k]).tolist():
            shows = max(before[at], taken)
            if at >= first and 0.0 < _LONE * shows < size[at, k]:
                lone[at, k], size[at, k], first = True, 0.0, at + 2
            else:
                taken = max(taken, size[at, k])
    shown = Shown(tuple(np.maximum(reach, size.max(axis=0)).tolist()), tuple(lone[-1].tolist()))
    return shown, lone if lone.any() else None
