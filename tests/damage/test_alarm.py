"""Alarms: evidence, persistence, size; one story does not speak for another; what operators may do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from pydantic import ValidationError

from monitor.core import WHOLE, Alarm, AlarmCondition, DamageReading, Level
from monitor.damage import alarm
from monitor.damage.alarm import AlarmSettings, AlarmState, StoryState
from monitor.damage.limits import Scores
from monitor.damage.sequential_test import shared_change
from tests.support.results import damage_reading

HOP_NS = 10_000_000_000


class FourSigma(AlarmSettings):
    """Announces from four standard deviations on, however many parts and looks there are."""

    def limit(self, tests: Scores, reading_s: float, spacing_s: float) -> float:
        return 4.0


SETTINGS = FourSigma(min_loss=0.005, alarm_loss=0.10)
OFF = 40
"""Hops from one window to the next that shares no data, which confirms a loss, and those of the off-delay."""
STD = 0.01


def reading(*ddi: float, std: float = STD, common: float = 0.0, freedom: float = np.inf) -> DamageReading:
    d, one = np.array(ddi), np.eye(len(ddi))
    return damage_reading(
        d, (std**2 + common**2) * one, 1000.0, common_covariance=common**2 * one, own_freedom=np.inf, freedom=freedom
    )


class Site:
    """One reading every 10 s of windows of 400 s."""

    def __init__(self, n: int = 1, settings: AlarmSettings = SETTINGS) -> None:
        self.states = alarm.start(n, 400.0)
        self.settings = settings
        self.t_ns = 0

    def see(self, *ddi: float, times: int = 1, std: float = STD, common: float = 0.0) -> list[str]:
        return [self.one(*ddi, std=std, common=common).level.value for _ in range(times)]

    def one(self, *ddi: float, std: float = STD, common: float = 0.0) -> Alarm:
        damage = reading(*ddi, std=std, common=common)
        self.states, verdict = alarm.step(self.states, damage, self.t_ns, self.settings)
        self.t_ns += HOP_NS
        return verdict

    def skip(self, times: int = 1) -> list[str]:
        return [self.skip_one().level.value for _ in range(times)]

    def skip_one(self) -> Alarm:
        self.states, verdict = alarm.hold(self.states, self.t_ns)
        self.t_ns += HOP_NS
        return verdict

    def settle(self, n: int = 1) -> None:
        """An hour and more without loss."""
        self.see(*[0.0] * n, times=400)


def test_no_loss_is_normal_and_names_no_story() -> None:
    verdict = Site(3).one(0.0, 0.01, -0.5)
    assert (verdict.level, verdict.stories, verdict.active) == (Level.NORMAL, (), {})
    assert verdict.reason


def test_a_significant_loss_is_advisory_until_readings_that_share_no_data_confirm_it() -> None:
    assert Site().see(0.05, times=43) == ["advisory"] * OFF + ["warning"] * 3


def test_records_of_seconds_that_come_days_apart_confirm_each_other() -> None:
    states, levels = alarm.start(1, 8.0), []
    for day in range(3):
        states, verdict = alarm.step(states, reading(0.05), day * 86_400 * 10**9, SETTINGS)
        levels.append(verdict.level.value)
    assert levels == ["advisory", "warning", "warning"]


def test_one_outlying_reading_confirms_nothing_however_long_its_data_stay_in_the_windows() -> None:
    """Windows that overlap repeat it over a window's length, and the means over more windows after it."""
    for size in (0.045, 0.06, 0.5):
        site = Site()
        site.settle()
        seen = site.see(size, times=OFF) + site.see(0.0, times=10 * OFF)
        assert seen[0] == "advisory" and set(seen) == {"advisory", "normal"}


def test_a_small_loss_that_only_the_mean_of_several_readings_shows_is_confirmed_by_them() -> None:
    site = Site()
    site.settle()
    seen = site.see(0.03, times=3 * OFF)
    assert seen[OFF - 1] == "normal" and seen[-1] == "warning" and "advisory" not in seen


def test_a_confirmed_loss_is_an_alarm_only_from_alarm_loss_on() -> None:
    site = Site()
    assert site.see(0.099, times=OFF + 2)[-1] == "warning"
    assert site.see(0.102) == ["alarm"]
    assert Site().see(0.30, times=OFF + 2) == ["advisory"] * OFF + ["alarm"] * 2


def test_significance_is_one_sided_and_by_the_standard_deviation() -> None:
    assert Site().see(0.0401) == ["advisory"]
    assert Site().see(0.0399) == ["normal"]
    assert Site().see(-0.5) == ["normal"]
    assert Site().see(0.2, std=0.06) == ["normal"]


def test_a_deviation_that_few_records_gave_must_be_exceeded_by_more() -> None:
    """Four standard deviations of the normal distribution are as rare as 12 of Student's t with five degrees of freedom."""
    site = Site()
    for loss, freedom, level in ((0.05, np.inf, "advisory"), (0.11, 5.0, "normal"), (0.14, 5.0, "advisory")):
        few = reading(loss, std=1e-4, common=STD, freedom=freedom)
        assert alarm.step(site.states, few, 0, SETTINGS)[1].level.value == level
        once = replace(reading(loss), own_freedom=freedom)
        assert alarm.step(site.states, once, 0, SETTINGS)[1].level.value == level


def test_losses_below_min_loss_are_never_announced() -> None:
    assert Site().see(0.0049, times=20, std=1e-6) == ["normal"] * 20
    assert Site().see(0.0051, std=1e-6) == ["advisory"]


def test_the_deadband_keeps_an_announced_loss_but_announces_none() -> None:
    assert Site().see(0.035, times=20) == ["normal"] * 20
    site = Site()
    site.see(0.05)
    assert site.see(0.035, times=OFF + 2) == ["advisory"] * (OFF - 1) + ["warning"] * 3


def test_the_deadband_keeps_a_loss_about_its_least_size() -> None:
    """Alternating about `uniform_loss` = 5 %, and about `min_loss`, every 300 s: one episode, not dozens."""
    site = Site(3, AlarmSettings())
    assert set(site.see(*[0.0485] * 3, times=30, std=0.002)) == {"normal"}, "not announced before the threshold"
    assert site.see(*[0.0515] * 3, times=60, std=0.002)[-1] == "advisory"
    for _ in range(10):
        for loss in (0.0485, 0.0515):
            assert set(site.see(*[loss] * 3, times=30, std=0.002)) == {"advisory"}
    assert site.see(*[0.04] * 3, times=800, std=0.002)[-1] == "normal"
    site = Site()
    site.see(0.0051, times=OFF + 2, std=1e-3)
    assert site.see(0.0049, times=12, std=1e-3)[-1] == "warning"
    assert site.see(0.003, times=1000, std=1e-3)[-1] == "normal"


def test_an_announced_loss_clears_when_two_windows_that_share_no_data_lack_it() -> None:
    site = Site()
    site.see(0.2, times=OFF + 2)
    assert site.see(0.0, times=OFF + 2) == ["alarm"] * OFF + ["normal"] * 2


def test_a_loss_that_returns_within_the_off_delay_was_one_episode() -> None:
    site = Site()
    site.see(0.2, times=OFF + 2)
    assert site.see(0.0, times=3) == ["alarm"] * 3
    assert site.see(0.2) == ["alarm"]
    assert site.see(0.0, times=OFF + 1) == ["alarm"] * OFF + ["normal"], "the off-delay starts anew"


def test_an_alarm_holds_until_its_loss_is_surely_less() -> None:
    """Of 10 % with a deviation of 1 %, 9 % is not surely less; 8 % is, and is still a warning."""
    site = Site()
    site.settle()
    assert site.see(0.12, times=60)[-1] == "alarm"
    assert set(site.see(0.099, times=400)) == {"alarm"}
    assert site.see(0.05, times=1000)[-1] == "warning"


def test_after_clearing_persistence_starts_anew() -> None:
    site = Site()
    site.see(0.2, times=OFF + 2)
    site.settle()
    assert site.see(0.05, times=OFF + 1) == ["advisory"] * OFF + ["warning"]


def test_persistence_wants_an_unbroken_run_of_significant_windows() -> None:
    """Two chance crossings a window apart with quiet between them are no loss that two readings showed without a break."""
    site = Site()
    site.settle()
    assert site.see(0.05) == ["advisory"]
    site.see(0.0, times=2 * OFF + 3)
    assert site.see(0.05) == ["advisory"]


def test_skipped_windows_hold_the_state() -> None:
    site = Site()
    assert site.skip() == ["normal"]
    site.see(0.05, times=3)
    assert site.skip(4) == ["advisory"] * 4
    assert site.see(0.05, times=OFF - 6) == ["advisory"] * (OFF - 7) + ["warning"], (
        "time goes on while windows are skipped"
    )
    verdict = site.skip_one()
    assert (verdict.level, verdict.stories) == (Level.WARNING, (1,))
    assert "skipped" in verdict.reason


def test_a_storm_beyond_calibration_ends_no_announcement_and_may_begin_one() -> None:
    """There the errors of the covariates' law hide the loss, which is still there."""
    storm = replace(reading(0.05, common=0.05), beyond="stronger than anything at calibration")
    site = Site()
    assert site.see(0.05, times=OFF + 1)[-1] == "warning"
    for _ in range(100):
        site.states, verdict = alarm.step(site.states, storm, site.t_ns, SETTINGS)
        site.t_ns += HOP_NS
        assert verdict.level is Level.WARNING
    assert "stronger than anything at calibration" in verdict.reason
    assert site.see(0.0, times=100)[-1] == "normal"
    severe = replace(reading(0.5, common=0.05), beyond="stronger than anything at calibration")
    _, verdict = alarm.step(site.states, severe, site.t_ns, SETTINGS)
    assert verdict.level is Level.ADVISORY


def test_stories_are_judged_each_on_its_own() -> None:
    site = Site(3)
    site.see(0.0, 0.2, 0.0, times=OFF - 5)
    assert site.see(0.08, 0.2, 0.0, times=6)[-1] == "alarm"
    verdict = site.one(0.08, 0.2, 0.0)
    assert (verdict.level, verdict.stories) == (Level.ALARM, (2,))
    assert verdict.active == {1: Level.ADVISORY, 2: Level.ALARM}
    site.see(0.08, 0.2, 0.0, times=OFF)
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
def test_levels_need_readings_that_share_no_data(ddi: list[float]) -> None:
    site, levels = Site(), []
    for value in ddi:
        levels += site.see(value)
    for k, level in enumerate(levels):
        if level in ("warning", "alarm"):
            assert k >= OFF, "before readings that share no data"
        if level == "alarm":
            assert max(ddi[: k + 1]) >= 0.10
        if level == "normal" and k:
            assert ddi[k] < 0.04


@pytest.mark.parametrize("key", ["false_announcements_per_year", "alarm_loss", "min_loss"])
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


@pytest.mark.parametrize(
    ("losses", "shared"),
    [
        ((0.0, 0.2, 0.1), 0.0),
        ((-0.05, 0.0, 0.0), 0.0),
        ((-0.03, 0.03, -0.03), 0.0),
        ((0.2, 0.1, 0.1), 0.1),
        ((-0.04, -0.03, -0.05), -0.03),
    ],
)
def test_only_what_all_stories_show_the_same_way_is_shared(losses: tuple[float, ...], shared: float) -> None:
    assert shared_change(np.array(losses), np.full(3, 0.001)) == shared


def test_two_damaged_stories_are_told_and_the_sound_one_is_not() -> None:
    site = Site(3)
    site.see(0.2, 0.0, 0.1, times=OFF, std=0.001)
    assert set(site.one(0.2, 0.0, 0.1, std=0.001).active) == {1, 3}


def test_damage_beside_a_uniform_change_is_told_with_it() -> None:
    site = Site(3)
    site.see(0.2, 0.1, 0.1, times=OFF, std=0.001)
    verdict = site.one(0.2, 0.1, 0.1, std=0.001)
    assert verdict.active == {1: Level.ALARM, WHOLE: Level.ADVISORY}
    assert "story 1 lost 10.0" in verdict.reason and "all stories changed alike" in verdict.reason


def test_a_stiffening_of_one_story_is_no_loss_of_the_others() -> None:
    site = Site(3)
    assert set(site.see(-0.05, 0.0, 0.0, times=40, std=0.001)) == {"normal"}


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_slow_uniform_change_is_never_a_story(sign: float) -> None:
    """Up and down again by 1.5 % alike, in noise."""
    site, rng = Site(3, AlarmSettings()), np.random.default_rng(7)
    for k in range(1000):
        weather = sign * 0.015 * np.sin(np.pi * k / 1000.0)
        assert site.one(*(weather + 0.0015 * rng.standard_normal(3)), std=0.0015).level is Level.NORMAL


# --- stretches of several windows ---


def test_a_loss_too_small_for_one_window_shows_over_eight() -> None:
    site = Site()
    site.settle()
    seen = site.see(0.02, times=400)
    assert set(seen[:100]) == {"normal"}, "two standard deviations of one window"
    assert seen[-1] == "warning"


def test_patience_does_not_lessen_what_the_baseline_does_not_know() -> None:
    site = Site()
    assert set(site.see(0.035, times=800, std=0.002, common=0.01)) == {"normal"}
    assert "warning" in site.see(0.05, times=100, std=0.002, common=0.01)


def test_readings_that_share_data_count_once() -> None:
    """Forty overlapping windows say hardly more than one."""
    assert set(Site().see(0.035, times=40)) == {"normal"}


def test_a_loss_is_followed_across_a_gap_off_the_grid() -> None:
    site = Site()
    site.see(0.0, times=40)
    site.see(0.03, times=60)
    site.t_ns += 123 * HOP_NS + 5
    assert "warning" in site.see(0.03, times=60), "windows before and after the gap together are enough"


def test_one_lucky_windows_certainty_is_not_believed() -> None:
    site = Site()
    site.see(0.0, times=40)
    assert site.see(0.02, std=0.1 * STD) == ["normal"]


def test_worse_conditions_are_believed_at_once() -> None:
    site = Site()
    site.see(0.0, times=40)
    assert site.see(0.08, std=10 * STD) == ["normal"]
    assert site.see(0.08) == ["advisory"]


def test_a_window_across_the_onset_does_not_delay_those_after_it() -> None:
    """It reads half the loss with a standard deviation that its misfit inflated."""
    site = Site()
    site.settle()
    site.see(0.1, times=40, std=0.1)
    assert site.see(0.2, times=OFF + 1)[-1] == "alarm"


def test_a_second_damage_is_found_beside_the_first() -> None:
    site = Site(3)
    site.settle(3)
    site.see(0.2, 0.0, 0.0, times=400, std=0.002)
    site.see(0.2, 0.0, 0.1, times=100, std=0.002)
    assert set(site.one(0.2, 0.0, 0.1, std=0.002).active) == {1, 3}


def test_after_a_repair_the_alarm_does_not_wait_for_the_longest_stretch() -> None:
    site = Site()
    site.see(0.2, times=400)
    assert site.see(0.0, times=OFF + 1)[-1] == "normal"


# --- what operators do ---


def damaged(settings: AlarmSettings = SETTINGS) -> Site:
    site = Site(2, settings)
    site.see(0.0, 0.08, times=OFF + 2)
    return site


def test_an_alarm_waits_to_be_acknowledged_also_after_it_has_gone() -> None:
    site = damaged()
    assert site.one(0.0, 0.08).conditions == {2: AlarmCondition.UNACKNOWLEDGED}
    site.settle(2)
    verdict = site.one(0.0, 0.0)
    assert (verdict.level, verdict.conditions) == (Level.NORMAL, {2: AlarmCondition.RETURNED_UNACKNOWLEDGED})
    site.states = alarm.acknowledge(site.states, 2, "A. Smith")
    assert site.one(0.0, 0.0).conditions == {}


def test_an_acknowledged_alarm_is_new_again_when_it_rises() -> None:
    site = damaged()
    site.states = alarm.acknowledge(site.states, 2, "A. Smith")
    verdict = site.one(0.0, 0.05)
    assert (verdict.level, verdict.conditions) == (Level.WARNING, {2: AlarmCondition.ACKNOWLEDGED})
    assert site.states.stories[1].acknowledged_by == "A. Smith"
    assert site.one(0.0, 0.15).conditions == {2: AlarmCondition.UNACKNOWLEDGED}


def test_a_latched_alarm_stays_until_it_is_acknowledged_and_reset() -> None:
    site = damaged(SETTINGS.model_copy(update={"latching": True}))
    site.settle(2)
    verdict = site.one(0.0, 0.0)
    assert (verdict.level, verdict.conditions) == (Level.WARNING, {2: AlarmCondition.LATCHED_UNACKNOWLEDGED})
    site.states = alarm.reset(site.states, 2)
    assert site.one(0.0, 0.0).level is Level.WARNING, "nobody has seen it"
    site.states = alarm.acknowledge(site.states, 2, "A. Smith")
    assert site.one(0.0, 0.0).conditions == {2: AlarmCondition.LATCHED_ACKNOWLEDGED}
    site.states = alarm.reset(site.states, 2)
    assert (site.one(0.0, 0.0).level, site.one(0.0, 0.0).conditions) == (Level.NORMAL, {})


def test_a_latched_alarm_that_is_still_active_is_not_reset() -> None:
    site = damaged(SETTINGS.model_copy(update={"latching": True}))
    site.states = alarm.reset(alarm.acknowledge(site.states, 2, "A. Smith"), 2)
    site.see(0.0, 0.0, times=OFF + 1)
    assert site.one(0.0, 0.0).level is Level.WARNING


def test_a_latched_level_is_released_to_that_of_the_data_once_it_is_acknowledged() -> None:
    site = damaged(SETTINGS.model_copy(update={"latching": True}))
    site.see(0.0, 0.2, times=OFF + 2)
    site.see(0.0, 0.05, times=1000)
    assert site.one(0.0, 0.05).level is Level.ALARM, "latched"
    site.states = alarm.reset(site.states, 2)
    assert site.one(0.0, 0.05).level is Level.ALARM, "nobody has seen it"
    site.states = alarm.reset(alarm.acknowledge(site.states, 2, "A. Smith"), 2)
    verdict = site.one(0.0, 0.05)
    assert (verdict.level, verdict.conditions) == (Level.WARNING, {2: AlarmCondition.ACKNOWLEDGED})


def test_the_alarm_of_a_story_that_is_gone_stands_until_it_is_acknowledged() -> None:
    """No window tells of that story: its silence is no return to normal."""
    before, site = damaged(), Site(1)
    site.states = alarm.carry_over(site.states, before.states.stories)
    assert set(site.see(0.0, times=4 * OFF)) == {"warning"}
    assert site.one(0.0).conditions == {WHOLE: AlarmCondition.UNACKNOWLEDGED}
    site.states = alarm.acknowledge(site.states, WHOLE, "A. Smith")
    assert site.see(0.0, times=OFF + 1)[-1] == "normal"


def test_a_shelved_alarm_is_tracked_unannounced_and_comes_back() -> None:
    site = damaged()
    site.states = alarm.shelve(site.states, 2, site.t_ns + 3 * HOP_NS, "works on story 2")
    verdict = site.one(0.0, 0.15)
    assert (verdict.level, verdict.active, verdict.conditions) == (Level.NORMAL, {}, {2: AlarmCondition.SHELVED})
    assert "works on story 2" in verdict.reason
    assert site.see(0.0, 0.15, times=3) == ["normal", "normal", "alarm"]


def test_shelving_one_story_leaves_the_other() -> None:
    site = damaged()
    site.states = alarm.shelve(site.states, 1, site.t_ns + 99 * HOP_NS, "works on story 1")
    assert site.one(0.0, 0.05).active == {2: Level.WARNING}


def test_shelving_ends_by_hand_or_while_windows_are_skipped() -> None:
    site = damaged()
    site.states = alarm.shelve(site.states, 2, site.t_ns + 2 * HOP_NS, "works")
    assert site.skip(3) == ["normal", "normal", "warning"]
    site.states = alarm.unshelve(alarm.shelve(site.states, 2, site.t_ns + 99 * HOP_NS, "works"), 2)
    assert site.see(0.0, 0.05) == ["warning"]


def test_senseless_commands_are_refused() -> None:
    state: AlarmState = alarm.start(2)
    with pytest.raises(ValueError, match="no story 3"):
        alarm.acknowledge(state, 3, "A. Smith")
    with pytest.raises(ValueError, match="no story -1"):
        alarm.unshelve(state, -1)
    with pytest.raises(ValueError, match="reason"):
        alarm.shelve(state, 1, 0, " ")
    assert alarm.acknowledge(state, WHOLE, "A. Smith").stories == (StoryState(),) * 3
