"""Ambient motion before and after an event: what the windows tell of frequencies and stiffness."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

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
    frequencies_hz: Annotated[Array, "k"]
    model_mode: Annotated[Array, "k"]
    """Index of each frequency's mode of the model, from 0."""
    loss: Annotated[Array, "n"]
    """Damage index of each story, without a baseline the change from the structure file."""
    variance: Annotated[Array, "n"]
    """The part of its variance that windows do not share."""
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


def mean_frequencies(readings: Sequence[AmbientReading], n_modes: int) -> Annotated[Array, "n_modes"]:
    """Average the frequencies of the model's modes over windows; NaN for a mode in none of them."""
    pairs = [(mode, float(hz)) for r in readings for mode, hz in zip(r.model_mode, r.frequencies_hz, strict=True)]
    by_mode = ([hz for mode, hz in pairs if mode == k] for k in range(n_modes))
    return np.array([float(np.mean(found)) if found else np.nan for found in by_mode])


def lasting_loss(
    before: Sequence[AmbientReading], after: Sequence[AmbientReading], n_stories: int
) -> tuple[Annotated[Array, "n"], Annotated[Array, "n"], str]:
    """Compare the stiffness after with that before, by windows of ambient motion that do not overlap.

    The baseline's own error is in both and cancels.  The standard deviation is that which the windows state, or that of their
    scatter if this is larger.  Return loss and standard deviation relative to the stiffness before, NaN where there are too few
    windows, and what limits the comparison, in words.
    """
    nothing = np.full(n_stories, np.nan)
    if not n_stories:
        return nothing, nothing, ""
    if min(len(before), len(after)) < _FEWEST:
        where = "before" if len(before) < _FEWEST else "after"
        return nothing, nothing, f"too few windows {where} it to tell a lasting loss"
    (lost_before, variance_before), (lost_after, variance_after) = _mean(before), _mean(after)
    kept = 1.0 - lost_before
    loss, std = 1.0 - (1.0 - lost_after) / kept, np.sqrt(variance_before + variance_after) / kept
    levels = [float(np.mean([r.rms_m_s2 for r in side])) for side in (before, after)]
    ratio = levels[1] / levels[0] if levels[0] > 0.0 else 1.0
    apart = ratio > _LEVELS_APART or ratio < 1.0 / _LEVELS_APART
    note = f"the ambient motion after it was {ratio:.2g} times that before" if apart else ""
    return loss, std, note


def _mean(readings: Sequence[AmbientReading]) -> tuple[Annotated[Array, "n"], Annotated[Array, "n"]]:
    """Average the windows' losses; return the mean and its variance."""
    losses = np.array([r.loss for r in readings])
    n = len(readings)
    stated = np.array([r.variance for r in readings]).mean(axis=0) / n
    return losses.mean(axis=0), np.maximum(stated, losses.var(axis=0, ddof=1) / n)
