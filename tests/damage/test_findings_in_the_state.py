"""What reassures falsely is no green state: findings, a story stiffer than healthy, no watched story, a silent end."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from monitor.core import Level
from monitor.damage.assessment import Course, Known, Loss, State, WindowFacts, assess, follow

KNOWN = Known(("story 1", "story 2"), has_baseline=True, alarm_loss=0.1, misfit=5.0)
JUDGED = WindowFacts(1_000_000_000_000, 400.0, None, detectable=(0.02, 0.03), misfit=1.0, rms_m_s2=1.0)
LOSS = {"effect": "stiffness_change", "location": "story 2"}
GAIN = {"effect": "sensor_gain", "location": "channel a1"}


def finding(
    *causes: dict[str, str], verdict: str = "named", says: str = "Channel a1 reads too much."
) -> dict[str, Any]:
    return {"id": "001", "verdict": verdict, "says": says, "causes": causes, "from_ns": 0, "t_ns": JUDGED.t_end_ns}


def course(*windows: WindowFacts) -> Course:
    out = Course()
    for window in windows:
        out = follow(out, window, KNOWN)
    return out


def test_a_loss_smaller_than_the_alarms_that_would_have_been_seen_is_green_with_its_number() -> None:
    assert assess(course(JUDGED), KNOWN).state is State.NORMAL
    assert "3 %" in assess(course(JUDGED), KNOWN).headline


def test_an_open_finding_is_a_doubt_and_a_headline_until_it_is_accepted() -> None:
    said = assess(course(JUDGED), KNOWN, [finding(GAIN)])
    assert said.state is State.DOUBTFUL
    assert "Channel a1 reads too much (a proposal until it is accepted)" in said.headline
    accepted = replace(KNOWN, accepted=(("sensor_gain", "channel a1"),))
    assert assess(course(JUDGED), accepted, [finding(GAIN)]).state is State.NORMAL


def test_a_finding_never_lowers_a_confirmed_alarm() -> None:
    alarm = replace(JUDGED, active={2: Level.ALARM}, losses={2: (0.12, 0.005, 300.0)})
    said = assess(course(alarm), KNOWN, [finding(GAIN)])
    assert said.state is State.ALARM
    assert "story 2 lost 12.0" in said.headline.lower() and "channel a1 reads too much" in said.headline


def test_a_loss_that_only_a_diagnosis_found_is_a_doubt() -> None:
    found = finding(LOSS, says="Story 2 is softer.")
    assert assess(course(JUDGED), KNOWN, [found]).state is State.DOUBTFUL
    stated = replace(course(JUDGED), losses=(Loss(Level.ALARM, 2, 0.12, 0.005, 300.0, 0, JUDGED.t_end_ns),))
    assert assess(stated, KNOWN, [found]).state is State.NORMAL  # the alarm said it, and ended
    partly = replace(KNOWN, accepted=(("sensor_gain", "channel a1"),))
    assert assess(stated, partly, [finding(GAIN, LOSS)]).state is State.NORMAL
    assert assess(stated, KNOWN, [finding(GAIN, LOSS)]).state is State.DOUBTFUL


@pytest.mark.parametrize(("change", "state"), [(-0.14, State.DOUBTFUL), (-0.05, State.NORMAL), (0.02, State.NORMAL)])
def test_a_story_far_stiffer_than_healthy_asks_whether_the_baseline_was(change: float, state: State) -> None:
    said = assess(course(replace(JUDGED, changes=((0.0, 0.01), (change, 0.01)))), KNOWN)
    assert said.state is state
    assert ("stiffer than at calibration" in said.headline) == (state is State.DOUBTFUL)


def test_no_watched_story_is_not_judged() -> None:
    assert assess(course(JUDGED), replace(KNOWN, unwatched=(2,))).state is State.NORMAL
    assert assess(course(JUDGED), replace(KNOWN, unwatched=(1, 2))).state is State.NOT_JUDGED


def test_a_recording_whose_end_was_not_judged_says_so() -> None:
    def silent(after_s: float) -> WindowFacts:
        return WindowFacts(JUDGED.t_end_ns + round(after_s * 1e9), 400.0, "channel a1 does not move")

    said = assess(course(JUDGED, silent(400.0)), KNOWN, whole=True)
    assert said.state is State.NOT_JUDGED
    assert said.headline == "The last 400 s could not be judged: channel a1 does not move."
    assert assess(course(JUDGED, silent(390.0)), KNOWN, whole=True).state is State.NORMAL


def test_no_threshold_makes_the_loss_of_a_third_green() -> None:
    deaf = replace(KNOWN, alarm_loss=0.95)
    assert assess(course(replace(JUDGED, detectable=(0.02, 0.25))), deaf).state is State.NORMAL
    assert assess(course(replace(JUDGED, detectable=(0.02, 0.9))), deaf).state is State.NOT_JUDGED
