"""Alarms of modes alone: what changed is named, to either side, and no story is."""

from __future__ import annotations

import numpy as np
import pytest

from monitor.core import WHOLE, Alarm, Level, ModalReading
from monitor.damage import AlarmState, modal_parts
from monitor.damage.alarm import AlarmSettings, acknowledge, hold, start, step
from monitor.damage.detectable_loss import smallest_detectable_loss
from monitor.damage.limits import Scores
from monitor.damage.parts import ModesAndShapes
from monitor.publish import current_alarm_line

PARTS, WINDOW_S, SETTINGS = ModesAndShapes(3, ("a1", "a2")), 400.0, AlarmSettings()
STD, SHAPE_STD = 0.001, 0.002


def reading(frequencies: list[float], shape: float = 0.0, std: float = STD) -> ModalReading:
    """Changes of three modes' frequencies, and of the first mode's shape at a2; half of the variance is the baseline's."""
    shapes = np.full((3, 2), np.nan)
    shapes[:, 1] = [shape, 0.0, 0.0]
    variance, known = np.where(np.isnan(shapes), np.nan, SHAPE_STD**2), np.isfinite(frequencies)
    own = np.where(known[:, None] & known, std**2 * np.eye(3), np.nan)
    common = 0.5 * std**2 * np.eye(3)
    return ModalReading(
        -2.0 * np.array(frequencies),
        4.0 * (own + common),
        4.0 * common,
        shape=shapes,
        shape_variance=1.5 * variance,
        shape_common_variance=0.5 * np.nan_to_num(variance),
    )


def run(readings: list[ModalReading], state: AlarmState | None = None) -> tuple[AlarmState, list[Alarm]]:
    state, said = state or start(3, WINDOW_S, n_channels=2), []
    for k, one in enumerate(readings):
        state, alarm = step(state, one, round((k + 1) * WINDOW_S * 1e9), SETTINGS, parts=PARTS)
        said.append(alarm)
    return state, said


@pytest.mark.parametrize(("change", "verb"), [(-0.02, "fell"), (0.02, "rose")])
def test_one_mode_that_changes_is_named_to_either_side_and_no_story_is(change: float, verb: str) -> None:
    _, said = run([reading([0.0, 0.0, 0.0])] * 2 + [reading([0.0, change, 0.0])] * 3)
    assert [a.level for a in said] == [Level.NORMAL, Level.NORMAL, Level.ADVISORY, Level.WARNING, Level.WARNING]
    assert said[-1].active == {2: Level.WARNING}
    assert said[-1].stories == ()
    assert said[-1].reason.startswith(f"changed since the baseline: mode 2 {verb} by 2.0 ± ")
    assert "story" not in said[-1].reason


def test_a_frequency_that_falls_by_a_twentieth_is_an_alarm_for_a_tenth_of_the_modal_stiffness_is_gone() -> None:
    _, said = run([reading([0.0, -0.052, 0.0])] * 2)
    assert said[-1].active[2] is Level.ALARM
    _, said = run([reading([0.0, -0.048, 0.0])] * 2)
    assert said[-1].active[2] is Level.WARNING


def test_modes_that_all_change_alike_are_an_advisory_of_the_whole() -> None:
    _, said = run([reading([-0.03, -0.03, -0.03])] * 4)
    assert said[-1].active == {WHOLE: Level.ADVISORY}
    assert said[-1].reason.startswith("changed since the baseline: all modes fell by 3.0 % alike")


def test_a_shape_that_changes_is_named_with_its_channel_and_is_no_alarm_whatever_its_size() -> None:
    _, said = run([reading([0.0, 0.0, 0.0], shape=0.5)] * 3)
    assert said[-1].active == {4: Level.WARNING}
    assert modal_parts(3)[3] == "the shape of mode 1"
    assert "the shape of mode 1 changed by 50.0 ± " in said[-1].reason
    assert said[-1].reason.endswith("of its largest component at a2")


def test_a_mode_that_a_window_does_not_show_keeps_its_alarm() -> None:
    state, said = run([reading([0.0, -0.02, 0.0])] * 3)
    state, gone = step(state, reading([0.0, np.nan, 0.0]), round(4 * WINDOW_S * 1e9), SETTINGS, parts=PARTS)
    assert gone.active == said[-1].active == {2: Level.WARNING}
    # The means over longer stretches leave the window out, and go on when the mode is there again.
    _, again = step(state, reading([0.0, -0.02, 0.0]), round(5 * WINDOW_S * 1e9), SETTINGS, parts=PARTS)
    assert "mode 2 fell by 2.0 ± 0.2 %" in again.reason


def test_a_small_change_is_found_by_averaging_and_the_baselines_error_does_not_average_out() -> None:
    small = 3.8 * STD
    _, said = run([reading([0.0, -small, 0.0])])
    assert said[0].level is Level.NORMAL
    _, said = run([reading([0.0, -small, 0.0])] * 16)
    assert said[-1].level is Level.NORMAL, "the baseline's part alone is 0.7 of a window's"
    _, said = run([reading([0.0, -8.0 * STD, 0.0])] * 8)
    assert said[-1].level is Level.WARNING


def test_how_small_a_change_would_be_seen_is_told_of_each_mode_that_is_seen() -> None:
    state, _ = run([reading([0.0, 0.0, 0.0])] * 9)
    seen = smallest_detectable_loss(reading([0.0, np.nan, 0.0]), state.history, SETTINGS, Scores(3, 3, 2))
    assert np.isinf(seen[1])
    assert (seen[[0, 2]] > 4.0 * STD).all()
    assert (seen[[0, 2]] < 12.0 * STD).all()


def test_operators_requests_are_of_modes() -> None:
    state, _ = run([reading([0.0, -0.02, 0.0])] * 3)
    state = acknowledge(state, 2, "A. Smith")
    _, held = hold(state, 0, PARTS)
    assert held.active == {2: Level.WARNING}
    assert held.conditions[2].value == "active, acknowledged"
    line = current_alarm_line(state, PARTS)
    assert (line["active"], line["stories"]) == ({"2": "warning"}, []), "a mode is no story"
