"""Results of windows, built by keywords; what is not said is as of a sound window without damage."""

from __future__ import annotations

from typing import Any

import numpy as np

from monitor.core import (
    Alarm,
    AlarmCondition,
    Array,
    DamageReading,
    Level,
    ModalEstimate,
    Skipped,
    StiffnessEstimate,
    WindowResult,
)
from monitor.publish import to_json, window_line

T0_NS = 1_767_225_600_000_000_000


def alarm(level: Level = Level.NORMAL, reason: str = "", **fields: Any) -> Alarm:
    """An alarm of story 2, if it is one."""
    return Alarm(**{"level": level, "stories": (2,) if level.rank else (), "reason": reason} | fields)


def modal_estimate(frequencies_hz: Any, shapes: Any, **fields: Any) -> ModalEstimate:
    """Modes with shapes, (m, c), of 1 % damping; without deviations they are exact."""
    hz, shapes = np.array(frequencies_hz, dtype=float), np.array(shapes, dtype=complex)
    m, c = shapes.shape
    plain: dict[str, Any] = {
        "damping_ratio": np.full(m, 0.01),
        "model_mode": np.arange(m),
        "deviations": np.zeros((0, m, 2 + 2 * c)),
        "first": 0,
        "order": 2 * m,
        "poles": np.zeros((0, 4)),
    }
    return ModalEstimate(**plain | {"frequencies_hz": hz, "shapes": shapes} | fields)


def stiffness_estimate(stiffness_n_per_m: Array, misfit: float = 1.0) -> StiffnessEstimate:
    return StiffnessEstimate(
        stiffness_n_per_m=stiffness_n_per_m,
        covariance=np.eye(stiffness_n_per_m.size),
        converged=True,
        iterations=4,
        misfit=misfit,
    )


def damage_reading(ddi: Array, covariance: Array, stiffness_n_per_m: float = 2000.0, **fields: Any) -> DamageReading:
    """An index with its covariance; each story had this stiffness."""
    plain: dict[str, Any] = {"ddi_sequential": ddi, "loss_n_per_m": ddi * stiffness_n_per_m}
    return DamageReading(ddi, covariance=covariance, **plain | fields)


def window_result(index: int = 0, **fields: Any) -> WindowResult:
    """A window of 400 s every 10 s."""
    plain: dict[str, Any] = {
        "t_end_ns": T0_NS + index * 10**10,
        "window_s": 400.0,
        "modes": None,
        "stiffness": None,
        "damage": None,
        "alarm": alarm(),
        "skipped": None,
    }
    return WindowResult(index=index, **plain | fields)


def window(k: int, level: Level = Level.NORMAL) -> tuple[WindowResult, str]:
    """A skipped window under an alarm, with its line."""
    active = {} if level is Level.NORMAL else {2: level}
    conditions = {story: AlarmCondition.UNACKNOWLEDGED for story in active}
    state = alarm(level, f"because {k}", active=active, conditions=conditions)
    result = window_result(k, alarm=state, skipped=Skipped("a test"))
    return result, to_json(window_line(result))
