"""Ambient motion before and after an event: what the windows tell of frequencies and stiffness."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from monitor.core import Array, WindowResult

_FEWEST = 2
"""Fewest windows before and after that tell a loss with its scatter. [count; definition of a scatter]"""
_LEVELS_APART = 2.0
"""Ratio of the levels of motion before and after from which the note says so. [ratio; judgement: joints give with the level]"""


@dataclass(frozen=True, eq=False, slots=True)
class AmbientReading:
    """What one window of ambient motion tells."""

    begin_ns: int
    end_ns: int
    frequencies_hz: Array
    """Shape (k,)."""
    model_mode: Array
    """Shape (k,): index of each frequency's mode of the model, from 0."""
    loss: Array
    """Shape (n,): damage index of each story, without a baseline the change from the structure file."""
    variance: Array
    """Shape (n,): the part of its variance that windows do not share."""
    rms_m_s2: float


def reading_of(result: WindowResult) -> AmbientReading | None:
    """Return what a window tells; None where it was not judged."""
    if result.modes is None or result.skipped is not None:
        return None
    loss = own = np.zeros(0)  # without a model there are no stories
    if (damage := result.damage) is not None:
        loss, common = damage.ddi, damage.common_covariance
        own = np.diag(damage.covariance) - (np.diag(common) if common.ndim else 0.0)
    return AmbientReading(
        result.t_end_ns - round(result.window_s * 1e9),
        result.t_end_ns,
        result.modes.frequencies_hz,
        np.asarray(result.modes.model_mode, dtype=float),
        loss,
        np.maximum(own, 0.0),
        result.rms_m_s2 or 0.0,
    )


def mean_frequencies(readings: Sequence[AmbientReading], n_modes: int) -> Array:
    """Average the frequencies of the model's modes over windows, shape (n_modes,); NaN for a mode in none of them."""
    out = np.full(n_modes, np.nan)
    for k in range(n_modes):
        found = [
            float(hz) for r in readings for hz, mode in zip(r.frequencies_hz, r.model_mode, strict=True) if mode == k
        ]
        if found:
            out[k] = float(np.mean(found))
    return out


def lasting_loss(
    before: Sequence[AmbientReading], after: Sequence[AmbientReading], n_stories: int
) -> tuple[Array, Array, str]:
    """Compare the stiffness after with that before, by windows of ambient motion that do not overlap.

    The baseline's own error is in both and cancels.  The standard deviation is that which the windows state, or that of their
    scatter if this is larger.

    Returns
    -------
    loss, std : ndarray, shape (n_stories,)
        Relative to the stiffness before; NaN where there are too few windows.
    note : str
        What limits the comparison, in words.
    """
    nothing = np.full(n_stories, np.nan)
    if not n_stories:
        return nothing, nothing, ""
    if min(len(before), len(after)) < _FEWEST:
        where = "before" if len(before) < _FEWEST else "after"
        return nothing, nothing, f"too few windows {where} it to tell a lasting loss"
    means, variances = zip(*(_mean(side) for side in (before, after)), strict=True)
    kept = 1.0 - means[0]
    loss, std = 1.0 - (1.0 - means[1]) / kept, np.sqrt(variances[0] + variances[1]) / kept
    levels = [float(np.mean([r.rms_m_s2 for r in side])) for side in (before, after)]
    ratio = levels[1] / levels[0] if levels[0] > 0.0 else 1.0
    apart = ratio > _LEVELS_APART or ratio < 1.0 / _LEVELS_APART
    note = f"the ambient motion after it was {ratio:.2g} times that before" if apart else ""
    return loss, std, note


def _mean(readings: Sequence[AmbientReading]) -> tuple[Array, Array]:
    """Average the windows' losses; return the mean and its variance, shape (n,) each."""
    losses = np.array([r.loss for r in readings])
    n = len(readings)
    stated = np.array([r.variance for r in readings]).mean(axis=0) / n
    return losses.mean(axis=0), np.maximum(stated, losses.var(axis=0, ddof=1) / n)
