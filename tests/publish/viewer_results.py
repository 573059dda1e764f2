"""Results as the viewer draws them."""

from __future__ import annotations

import numpy as np

from monitor.core import Level, Skipped, WindowResult
from monitor.model import Drawing
from monitor.publish.viewer.scene import Scene
from tests.support.results import alarm, damage_reading, modal_estimate, stiffness_estimate, window_result

T0 = 1_772_359_200_000_000_000

SCENE = Scene(
    name="test frame",
    channels=("a1", "a 2", "a3"),
    sensors=np.eye(3),
    drawing=Drawing.of_frame(np.array([0.093, 0.093, 0.1])),
    story_names=("story 1", "story 2 (left columns)", "story 3"),
    baseline_frequencies_hz=np.array([5.1, 14.4, 20.6]),
    has_baseline=True,
    alarm_loss=0.1,
)


def window(k: int, level: Level = Level.NORMAL, skipped: str | None = None) -> WindowResult:
    said, t_end_ns = alarm(level, f"because {level.value}"), T0 + (400 + 10 * k) * 10**9
    if skipped is not None:
        return window_result(k, t_end_ns=t_end_ns, alarm=said, skipped=Skipped(skipped))
    modes = modal_estimate(
        [5.0, 20.0],
        [[1, 0.8, 0.4], [0.3, -1, 0.9]],
        damping_ratio=np.array([0.01, 0.02]),
        model_mode=np.array([0, 2]),
        deviations=np.full((4, 2, 8), 0.001),
        order=20,
        poles=np.array([[10, 5.0, 0.01, 1], [20, 5.0, 0.01, 1], [20, 31.0, 0.2, 0]]),
    )
    damage = damage_reading(np.array([0.0, 0.08, 0.01]), np.eye(3) * 0.01**2)
    fit = stiffness_estimate(np.full(3, 2000.0), misfit=1.5)
    return window_result(k, t_end_ns=t_end_ns, modes=modes, stiffness=fit, damage=damage, alarm=said)
