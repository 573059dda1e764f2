"""A result of a window, built from a few words."""

from __future__ import annotations

from monitor.core import Alarm, AlarmCondition, Level, Skipped, WindowResult
from monitor.publish import to_json, window_line

T0_NS = 1_767_225_600_000_000_000


def window(k: int, level: Level = Level.NORMAL) -> tuple[WindowResult, str]:
    active = {} if level is Level.NORMAL else {2: level}
    conditions = {story: AlarmCondition.UNACKNOWLEDGED for story in active}
    state = Alarm(level, tuple(active), f"because {k}", active, conditions)
    result = WindowResult(k, T0_NS + k * 10**10, 400.0, None, None, None, state, Skipped("a test"))
    return result, to_json(window_line(result))
