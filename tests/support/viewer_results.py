"""Results as the viewer draws them."""

from __future__ import annotations

import numpy as np

from monitor.core import Alarm, DamageReading, Level, ModalEstimate, Skipped, StiffnessEstimate, WindowResult
from monitor.model import Drawing
from monitor.publish.viewer.scene import Scene

T0 = 1_772_359_200_000_000_000


SCENE = Scene(
    name="test frame",
    channels=("a1", "a 2", "a3"),
    sensor_floor=(1, 2, 3),
    drawing=Drawing.of_frame(np.array([0.093, 0.093, 0.1])),
    story_names=("story 1", "story 2 (left columns)", "story 3"),
    baseline_frequencies_hz=np.array([5.1, 14.4, 20.6]),
    has_baseline=True,
    alarm_loss=0.1,
)


def window(k: int, level: Level = Level.NORMAL, skipped: str | None = None) -> WindowResult:
    alarm = Alarm(level, (2,) if level is not Level.NORMAL else (), f"because {level.value}")
    t_end = T0 + (400 + 10 * k) * 10**9
    if skipped is not None:
        return WindowResult(k, t_end, 400.0, None, None, None, alarm, Skipped(skipped))
    modes = ModalEstimate(
        frequencies_hz=np.array([5.0, 20.0]),
        damping_ratio=np.array([0.01, 0.02]),
        shapes=np.array([[1, 0.8, 0.4], [0.3, -1, 0.9]], dtype=complex),
        model_mode=np.array([0, 2]),
        deviations=np.full((4, 2, 8), 0.001),
        first=0,
        order=20,
        poles=np.array([[10, 5.0, 0.01, 1], [20, 5.0, 0.01, 1], [20, 31.0, 0.2, 0]]),
    )
    stiffness = StiffnessEstimate(np.full(3, 2000.0), np.eye(3), True, 4, 1.5)
    ddi = np.array([0.0, 0.08, 0.01])
    damage = DamageReading(ddi, np.eye(3) * 0.01**2, ddi, ddi * 2000)
    return WindowResult(k, t_end, 400.0, modes, stiffness, damage, alarm, None)
