"""Which of a window's modes is which of a structure's, by likelihood against what healthy windows taught.

A mode lies where the healthy windows' scatter lets expect it or, as the structure may have changed, anywhere in reach: a small
change is as probable as one of twice its size (a uniform density of the logarithm of the change).  Against that stands that the
mode was not found, and that what lies there is none of the modes known (clutter).  Frequency counts and, where there are two
channels or more, the shape: one channel sees all shapes alike.

References
----------
S. Blackman, R. Popoli, Design and Analysis of Modern Tracking Systems (1999), sections 6.2, 6.5 (likelihood ratios with missed
detections and clutter of a given density).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import log
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, ComplexArray, ModalEstimate
from monitor.identification.tracking import Track, TrackSettings
from monitor.model import Modes
from monitor.signals import NORMAL_MAD

_SURE = 19.0
"""Odds from which a mode counts as known. [ratio; convention: 95 percent]"""


@dataclass(frozen=True, eq=False, slots=True)
class KnownModes:
    """Modes of a structure, and how healthy windows showed them."""

    modes: Modes
    """As the channels show them."""
    ln_f_std: Annotated[Array, "m"]
    """Scatter of ln f over windows."""
    unlikeness: Annotated[Array, "m"]
    """Mean of 1 less the modal assurance criterion of a window's shape; not used with one channel."""
    absent: Annotated[Array, "m"]
    """Probability that a window does not show the mode."""
    clutter: float
    """Modes in a window that are none of these, for each unit of ln f."""
    changed: float
    """Probability that a window is the first of a changed structure, which none of the healthy ones was."""

    @classmethod
    def of(
        cls, tracks: Sequence[Track], windows: Sequence[ModalEstimate], settings: TrackSettings, spread: float
    ) -> Self:
        """Learn of modes that were tracked over windows of all channels; `spread` is the range of ln f looked at."""
        shapes = np.nan_to_num(np.array([t.shape for t in tracks]))
        shapes = shapes / shapes[np.arange(len(tracks)), np.abs(shapes).argmax(axis=1)][:, None]
        seen = [_seen(t.ln_f, shape, windows, settings) for t, shape in zip(tracks, shapes, strict=True)]
        middle = np.array([np.median(one[:, 0]) if len(one) else t.ln_f for one, t in zip(seen, tracks, strict=True)])
        found, n = np.array([len(one) for one in seen]), len(windows) + 1.0
        others = sum(w.frequencies_hz.size for w in windows) - int(found.sum())
        return cls(
            Modes((2.0 * np.pi * np.exp(middle)) ** 2, shapes.real.T),
            np.array(
                [
                    NORMAL_MAD * np.median(np.abs(one[:, 0] - m)) if len(one) else 0.0
                    for one, m in zip(seen, middle, strict=True)
                ]
            ),
            np.array([1.0 - one[:, 1].mean() if len(one) else 0.0 for one in seen]),
            (n - found - 0.5) / n,
            (max(others, 0) + 0.5) / n / spread,
            0.5 / n,
        )


def _seen(
    ln_f: float, shape: ComplexArray, windows: Sequence[ModalEstimate], settings: TrackSettings
) -> Annotated[Array, "found 2"]:
    """List ln f and the modal assurance criterion of the mode in each window that is nearest to a tracked one and may be it."""
    out = []
    for modes in windows:
        away = np.abs(np.log(modes.frequencies_hz) - ln_f)
        power = np.linalg.norm(modes.shapes, axis=1) * np.linalg.norm(shape)
        mac = (np.abs(modes.shapes @ shape.conj()) / np.maximum(power, 1e-300)) ** 2
        away[(mac < settings.min_mac) | (away > settings.max_change)] = np.inf
        if np.isfinite(away).any():
            k = int(away.argmin())
            out.append((np.log(modes.frequencies_hz[k]), mac[k]))
    return np.array(out).reshape(-1, 2)


def associated(
    distance: Annotated[Array, "m k"],
    mac: Annotated[Array, "m k"],
    known: KnownModes,
    n_channels: int,
    most_distance: float,
    least: tuple[float, float, float],
) -> dict[int, int]:
    """Assign the k modes of a window to the m known ones, as far as it is sure which is which.

    Parameters
    ----------
    distance : ndarray
        Absolute difference of ln f.
    mac : ndarray
        Modal assurance criterion.
    most_distance : float
        How far a mode that changed may lie.
    least : tuple of float
        Resolution of ln f, that of 1 - MAC, and the least criterion of a shape that changed.
    """
    from scipy.optimize import linear_sum_assignment  # takes a third of a second to load

    odds = _ln_odds(distance, mac, known, n_channels, most_distance, least)
    gain = np.where((distance <= most_distance) & (mac >= least[2]), np.maximum(odds, 0.0), 0.0)
    pairs = zip(*linear_sum_assignment(gain, maximize=True), strict=True)
    chosen = {int(i): int(j) for i, j in pairs if gain[i, j] > log(_SURE)}
    free = [i for i in range(len(gain)) if i not in chosen]
    return {i: j for i, j in chosen.items() if odds[i, j] - _ln_sum(gain[free, j]) > log(_SURE)}


def _ln_odds(
    distance: Array, mac: Array, known: KnownModes, n_channels: int, reach: float, least: tuple[float, float, float]
) -> Array:
    """Compute ln of the odds that a mode of the window is the known one, against clutter beside a known one that is absent."""
    std = np.hypot(known.ln_f_std, least[0])[:, None]
    healthy = np.exp(-0.5 * (distance / std) ** 2) / (std * np.sqrt(2.0 * np.pi))
    changed = 0.5 / (np.maximum(distance, std) * np.log(np.maximum(reach / std, np.e)))
    clutter = np.full_like(distance, known.clutter)
    if n_channels > 1:
        unlike, mean = np.maximum(1.0 - mac, least[1]), (known.unlikeness + least[1])[:, None]
        healthy *= np.exp(-unlike / mean) / mean
        changed /= 1.0 - least[2]
        clutter *= (n_channels - 1) * unlike ** (n_channels - 2)  # of a shape in any direction
    shown = (1.0 - known.changed) * healthy + known.changed * changed
    absent = known.absent[:, None]
    return np.asarray(np.log(np.maximum((1.0 - absent) * shown, 1e-300)) - np.log(absent * clutter))


def _ln_sum(ln_odds: Annotated[NDArray[np.float64], "free"]) -> float:
    """Return ln of 1 and the sum of the odds of the known modes that nothing was assigned to."""
    return float(np.logaddexp.reduce(np.append(ln_odds, 0.0)))
