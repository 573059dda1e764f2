"""Alarm levels: significance, persistence, size; one story does not speak for another."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from monitor import alarm
from monitor.alarm import AlarmSettings, StoryState
from monitor.results import Alarm, DamageReading, Level

HOP_NS = 10_000_000_000
SETTINGS = AlarmSettings(significance=4.0, min_loss=0.005, alarm_loss=0.10, confirm_s=100, clear_s=50, deadband=1.0)
STD = 0.01


def reading(*ddi: float, std: float = STD) -> DamageReading:
    d = np.array(ddi)
    return DamageReading(d, np.diag(np.full(d.size, std**2)), d, 1000.0 * d)


class Site:
    """One reading every 10 s."""

    def __init__(self, n: int = 1, settings: AlarmSettings = SETTINGS) -> None:
        self.states = alarm.start(n)
        self.settings = settings
        self.t_ns = 0

    def see(self, *ddi: float, times: int = 1, std: float = STD) -> list[str]:
        return [self.one(*ddi, std=std).level.value for _ in range(times)]

    def one(self, *ddi: float, std: float = STD) -> Alarm:
        self.states, verdict = alarm.step(self.states, reading(*ddi, std=std), self.t_ns, self.settings)
        self.t_ns += HOP_NS
        return verdict

    def skip(self, times: int = 1) -> list[str]:
        self.t_ns += times * HOP_NS
        return [alarm.hold(self.states).level.value] * times


def test_no_loss_is_normal_and_names_no_story() -> None:
    verdict = Site(3).one(0.0, 0.01, -0.5)
    assert (verdict.level, verdict.stories, verdict.active) == (Level.NORMAL, (), {})
    assert verdict.reason


def test_a_significant_loss_is_advisory_until_it_has_lasted_confirm_s() -> None:
    assert Site().see(0.05, times=13) == ["advisory"] * 10 + ["warning"] * 3


def test_a_confirmed_loss_is_an_alarm_only_from_alarm_loss_on() -> None:
    site = Site()
    assert site.see(0.099, times=12)[-1] == "warning"
    assert site.see(0.101) == ["alarm"]
    assert Site().see(0.30, times=12) == ["advisory"] * 10 + ["alarm"] * 2


def test_significance_is_one_sided_and_by_the_standard_deviation() -> None:
    assert Site().see(0.0401) == ["advisory"]
    assert Site().see(0.0399) == ["normal"]
    assert Site().see(-0.5) == ["normal"]
    assert Site().see(0.2, std=0.06) == ["normal"]


def test_losses_below_min_loss_are_never_announced() -> None:
    assert Site().see(0.0049, times=20, std=1e-6) == ["normal"] * 20
    assert Site().see(0.0051, std=1e-6) == ["advisory"]


def test_without_delay_the_first_significant_window_confirms() -> None:
    assert Site(settings=SETTINGS.model_copy(update={"confirm_s": 0.0})).see(0.05) == ["warning"]


def test_the_deadband_keeps_an_announced_loss_but_announces_none() -> None:
    assert Site().see(0.035, times=20) == ["normal"] * 20
    site = Site()
    site.see(0.05)
    assert site.see(0.035, times=12) == ["advisory"] * 9 + ["warning"] * 3


def test_an_announced_loss_clears_when_it_has_stayed_away_clear_s() -> None:
    site = Site()
    site.see(0.05, times=12)
    assert site.see(0.0, times=7) == ["warning"] * 5 + ["normal"] * 2


def test_a_loss_that_returns_within_clear_s_was_one_episode() -> None:
    site = Site()
    site.see(0.2, times=12)
    assert site.see(0.0, times=3) == ["alarm"] * 3
    assert site.see(0.2) == ["alarm"]
    assert site.see(0.0, times=6) == ["alarm"] * 5 + ["normal"], "the off-delay starts anew"


def test_after_clearing_persistence_starts_anew() -> None:
    site = Site()
    site.see(0.05, times=12)
    site.see(0.0, times=6)
    assert site.see(0.05, times=11) == ["advisory"] * 10 + ["warning"]


def test_persistence_wants_an_unbroken_run_of_significant_windows() -> None:
    """Two chance crossings 100 s apart with quiet between are no loss that "has stayed significant this long"."""
    site = Site(settings=SETTINGS.model_copy(update={"clear_s": 100.0}))
    assert site.see(0.05) == ["advisory"]
    site.see(0.0, times=9)
    assert site.see(0.05) == ["advisory"]


def test_skipped_windows_hold_the_state() -> None:
    site = Site()
    assert site.skip() == ["normal"]
    site.see(0.05, times=3)
    before = site.states
    assert site.skip(4) == ["advisory"] * 4
    assert site.states == before
    assert site.see(0.05, times=4) == ["advisory"] * 3 + ["warning"], "time goes on while windows are skipped"
    verdict = alarm.hold(site.states)
    assert (verdict.level, verdict.stories) == (Level.WARNING, (1,))
    assert "skipped" in verdict.reason


def test_stories_are_judged_each_on_its_own() -> None:
    site = Site(3)
    site.see(0.0, 0.2, 0.0, times=5)
    assert site.see(0.08, 0.2, 0.0, times=6)[-1] == "alarm"
    verdict = site.one(0.08, 0.2, 0.0)
    assert (verdict.level, verdict.stories) == (Level.ALARM, (2,))
    assert verdict.active == {1: Level.ADVISORY, 2: Level.ALARM}
    site.see(0.08, 0.2, 0.0, times=5)
    verdict = site.one(0.2, 0.2, 0.0)
    assert (verdict.level, verdict.stories) == (Level.ALARM, (1, 2))
    assert "story 1 lost 20.0" in verdict.reason and "story 2 lost 20.0" in verdict.reason
    assert "story 3" not in verdict.reason


def test_what_a_wrong_model_form_leaks_from_a_great_loss_is_no_loss_of_the_neighbour() -> None:
    """A shear model of a frame with flexible joints shows some percent of a story's loss in the next one."""
    site = Site(3)
    site.see(0.0, 0.0, 0.0, times=5)
    verdict = site.one(0.007, 0.12, 0.004)
    assert set(verdict.active) == {2}


def test_the_reason_says_when_it_is_not_confirmed() -> None:
    assert "not confirmed" in Site().one(0.05).reason


def test_a_loss_without_any_uncertainty_is_judged_by_its_size() -> None:
    assert Site().see(0.05, std=0.0) == ["advisory"]
    assert Site().see(0.0, std=0.0) == ["normal"]


@given(st.lists(st.sampled_from([0.0, 0.035, 0.05, 0.2]), max_size=60))
@settings(deadline=None, max_examples=100)
def test_levels_rise_step_by_step_and_need_their_time(ddi: list[float]) -> None:
    site, levels = Site(), []
    for value in ddi:
        levels += site.see(value)
    for k, level in enumerate(levels):
        if level in ("warning", "alarm"):
            assert k >= 10, "before confirm_s could have passed"
            assert levels[k - 1] != "normal"
        if level == "alarm":
            assert max(ddi[: k + 1]) >= 0.10
        if level == "normal" and k:
            assert ddi[k] < 0.04


def test_start_is_normal_everywhere() -> None:
    assert alarm.start(4) == (StoryState(),) * 5  # four stories and the structure as a whole


@pytest.mark.parametrize("key", ["significance", "alarm_loss", "confirm_s", "clear_s", "deadband", "min_loss"])
def test_senseless_settings_are_refused(key: str) -> None:
    for value in (-1.0, float("nan"), float("inf")):
        with pytest.raises(ValidationError):
            AlarmSettings(**{key: value})


def test_a_change_alike_in_all_stories_is_no_damage_of_one() -> None:
    """Weather: all stories lose 3 % alike, and nothing is announced; the reason says what was seen."""
    site = Site(3)
    for _ in range(40):
        verdict = site.one(0.031, 0.030, 0.0305, std=0.001)
    assert verdict.level is Level.NORMAL
    assert "all stories changed alike" in verdict.reason


def test_damage_shows_through_a_uniform_change() -> None:
    site = Site(3)
    for _ in range(40):
        verdict = site.one(-0.03, 0.03, -0.03, std=0.001)
    assert set(verdict.active) == {2}
    assert "story 2 lost 6.0" in verdict.reason


def test_a_great_uniform_loss_is_an_advisory_of_the_whole_structure_and_no_more() -> None:
    site = Site(3)
    for _ in range(40):
        verdict = site.one(0.2, 0.2, 0.2)
    assert (verdict.level, verdict.stories, verdict.active) == (Level.ADVISORY, (), {0: Level.ADVISORY})


@pytest.mark.parametrize("losses", [(0.0, 0.2, 0.1), (0.1, 0.1, 0.0), (-0.05, 0.0, 0.0), (0.1, 0.2, 0.3)])
def test_what_needs_more_words_than_single_stories_is_no_uniform_change(losses: tuple[float, ...]) -> None:
    assert alarm.uniform_change(np.array(losses), np.full(3, 0.001)) == 0.0
