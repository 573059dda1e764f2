"""The state: the gravest fact is the headline, green is said only where a loss would have been seen, the rest are doubts."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from monitor.core import STRONG_MOTION, WHOLE, Level
from monitor.damage.assessment import Assessment, Course, Known, State, WindowFacts, assess, follow

HOP_NS, WINDOW_S, T0 = 10 * 10**9, 400.0, 1_800_000_000 * 10**9
KNOWN = Known(("story 1", "story 2 (left bearing)", "story 3"), True, 0.1, 5.0, (0.5, 2.0))
WELL = WindowFacts(T0, WINDOW_S, None, detectable=(0.01, 0.012, 0.008), misfit=1.1, rms_m_s2=1.0)
LOST = replace(WELL, active={2: Level.ALARM}, losses={2: (0.124, 0.007, 180.0)})
SWAP = {
    "id": 1, "verdict": "named", "from_ns": T0, "t_ns": T0 + 10**12,
    "causes": [{"effect": "channel_swap", "location": "channel a1,a3"}],
    "says": "Channels a1 and a3 are swapped; with it taken out no story changed by more than 0.2 %.",
}  # fmt: skip


def course(*windows: WindowFacts) -> Course:
    out = Course()
    for k, window in enumerate(windows):
        out = follow(out, replace(window, t_end_ns=T0 + k * HOP_NS), KNOWN)
    return out


def said(
    *windows: WindowFacts, known: Known = KNOWN, findings: tuple[Any, ...] = (), whole: bool = False
) -> Assessment:
    return assess(course(*windows), known, findings, whole=whole)


def test_green_says_the_loss_that_would_have_been_seen() -> None:
    assert said(*[WELL] * 5) == Assessment(State.NORMAL, "No loss above 1.2 % in any story.")


def test_the_headline_names_the_directions_of_which_no_estimate_is_made() -> None:
    aside, channels = ("y1", "z1", "y2", "z2", "y3", "z3"), ("x1", "x2", "x3")
    known = replace(KNOWN, channels=channels, aside=aside)
    note = "udged along x only: 6 of 9 channels enter no estimate."
    assert said(*[WELL] * 5, known=known).headline == f"No loss above 1.2 % in any story; j{note}"
    assert f"J{note}" in said(known=known).doubts
    known = replace(known, aside_faults=(("z2", "is stuck"),))
    assert "Channel z2, which enters no estimate, is stuck." in said(*[WELL] * 5, known=known).doubts
    assert "along" not in said(*[WELL] * 5, known=replace(known, n_modes=3)).headline


@pytest.mark.parametrize(
    ("detectable", "tells"), [(None, "is not seen"), (0.25, "only a loss above 25 %"), (0.1, "10 %")]
)
def test_a_story_in_which_no_alarm_would_be_raised_is_not_green(detectable: float | None, tells: str) -> None:
    blind = said(replace(WELL, detectable=(0.01, detectable, 0.008)))
    assert blind.state is State.NOT_JUDGED
    assert (
        tells in blind.headline
        and "left bearing" in blind.headline
        and "no loss above 1 % in any other" in blind.headline
    )
    assert said(replace(WELL, detectable=(None,) * 3)).headline.startswith("No loss could have been confirmed")


def test_what_the_owner_knows_to_be_unseen_is_named_and_green() -> None:
    known = replace(KNOWN, unwatched=(2,))
    told = said(replace(WELL, detectable=(0.01, None, 0.008)), known=known)
    assert told == Assessment(
        State.NORMAL, "No loss above 1 % in any other story; story 2 (left bearing) is not watched."
    )


def test_a_building_is_told_by_direction_and_what_is_seen_too_badly_in_one_sentence() -> None:
    ends = ("ground to 1st", "1st to 2nd", "2nd to 3rd")
    names = tuple(
        f"storey {j} ({e} floor), {way}" for way in ("along x", "along y", "in torsion") for j, e in enumerate(ends, 1)
    )
    known = replace(KNOWN, names=names, unwatched=(7, 8, 9))
    told = said(replace(WELL, detectable=(*(0.01,) * 6, None, None, None)), known=known)
    all_clear = "No loss above 1 % in any other storey; all storeys in torsion are not watched."
    assert told == Assessment(State.NORMAL, all_clear)
    blurred = said(replace(WELL, detectable=(0.01, 0.6, 0.7, 0.8, 0.9, 0.01, None, None, None)), known=known)
    assert blurred.state is State.NOT_JUDGED
    assert (
        blurred.headline
        == "In 4 of 9 only a loss above 60 % would be seen, if any; all storeys in torsion are not watched; "
        "no loss above 1 % in any other storey."
    )
    alone = replace(known, names=names[3:6], unwatched=())
    seen = said(replace(WELL, detectable=(0.01,) * 3), known=alone)
    assert seen == Assessment(State.NORMAL, "No loss above 1 % in any storey; judged along y only.")


def test_without_a_baseline_nothing_is_judged() -> None:
    told = said(replace(WELL, detectable=None), known=replace(KNOWN, has_baseline=False))
    assert told.state is State.NOT_JUDGED and "baseline" in told.headline


def test_a_windows_length_without_a_judged_window_is_not_judged() -> None:
    gap = replace(WELL, skipped="gap in the data", detectable=None, misfit=None)
    assert said(WELL, *[gap] * 39).state is State.NORMAL
    late = said(WELL, *[gap] * 40)
    assert late.state is State.NOT_JUDGED and late.headline.startswith("The last 400 s could not be judged: gap")
    assert said(WELL, *[gap] * 40, whole=True) == late, "live and replayed alike"
    later = said(WELL, *[gap] * 361)
    assert later.state is State.NOT_JUDGED and later.headline.startswith("No window could be judged for an hour: gap")
    assert said(gap).headline.startswith("No window could be judged: gap")
    assert assess(Course(), KNOWN) == Assessment(State.NOT_JUDGED, "No window of data yet.")


def test_before_the_first_window_the_headline_says_when_it_comes() -> None:
    before = assess(Course(), KNOWN, first=(400.0, None)).headline
    assert before == "No window of data yet; the first takes 400 s of data."
    begun = assess(Course(), KNOWN, first=(400.0, T0 + 400 * 10**9)).headline
    assert (
        begun
        == "No window of data yet; the first takes 400 s of data and is full at 2027-01-15 08:06:40 UTC, if data keep coming."
    )
    assert assess(course(*[WELL] * 5), KNOWN, first=(400.0, T0)) == said(*[WELL] * 5)


def test_a_dead_logger_is_not_judged_at_once_and_an_alarm_stands_above_it() -> None:
    dead = replace(WELL, skipped="no reading changes: the logger is dead (since 2026-01-01 08:00 UTC)", detectable=None)
    told = said(*[WELL] * 5, dead)
    assert told.state is State.NOT_JUDGED and told.headline.startswith("No reading changes: the logger is dead (since")
    alarmed = said(*[LOST] * 5, replace(dead, active=LOST.active))
    assert alarmed.state is State.ALARM and any("logger is dead" in doubt for doubt in alarmed.doubts)
    assert said(*[WELL] * 5, dead, WELL).state is State.NORMAL


def test_a_loss_of_all_stories_alike_below_the_alarms_is_not_green() -> None:
    alike = replace(WELL, changes=((0.045, 0.002), (0.047, 0.002), (0.046, 0.002)))
    told = said(alike)
    assert told.state is State.NOT_JUDGED and "Every story lost 4.5 % alike" in told.headline
    assert said(replace(WELL, changes=((0.045, 0.002), (0.001, 0.002), (0.046, 0.002)))).state is State.NORMAL


@pytest.mark.parametrize("story", [2, WHOLE])
def test_a_shelved_alarm_is_neither_green_nor_ended(story: int) -> None:
    raised = replace(WELL, active={story: Level.ADVISORY}, losses={story: (0.15, 0.01, 1.0)})
    told = said(raised, replace(WELL, shelved=(story,)))
    assert told.state is State.NOT_JUDGED and "shelved" in told.headline
    assert not any("ended" in doubt for doubt in told.doubts)
    assert course(raised, replace(WELL, shelved=(story,))).losses[0].t_last_ns is None


def test_a_diagnosis_of_another_story_is_not_an_alarms() -> None:
    other = {
        **SWAP,
        "says": "Story 1 is 20 % softer.",
        "causes": [{"effect": "stiffness_change", "location": "story 1"}],
    }
    assert "diagnosis" not in said(WELL, LOST, findings=(other,)).headline
    told = said(replace(LOST, active={2: Level.ADVISORY}), WELL, findings=(other,))
    assert told.state is State.DOUBTFUL and "Story 1 is 20 % softer" in told.headline


def test_a_loss_about_the_threshold_has_one_state_and_says_since_when_how_large_then_and_now() -> None:
    told = said(LOST, replace(LOST, losses={2: (0.097, 0.003, 80.0)}))
    since = "of its stiffness since the baseline, alarm since 2027-01-15 08:00 UTC"
    assert told == Assessment(State.ALARM, f"Story 2 (left bearing) lost 12.4 ± 1.4 % {since}; now 9.7 ± 0.6 %.")
    larger = said(LOST, replace(LOST, losses={2: (0.13, 0.003, 80.0)}))
    assert "lost 13.0 ± 0.6 % of" in larger.headline and "now" not in larger.headline


def test_an_alarm_that_fell_has_its_present_state_and_the_whole_recording_its_highest() -> None:
    fell = LOST, replace(LOST, active={2: Level.WARNING}, losses={2: (0.05, 0.01, 80.0)})
    told = said(*fell)
    says = "lost 5.0 ± 2.0 % of its stiffness since the baseline; alarm of 12.4 ± 1.4 % since 2027-01-15 08:00 UTC is over."
    assert told.state is State.WARNING and told.headline.endswith(says)
    recorded = said(*fell, whole=True)
    assert (
        recorded.state is State.ALARM and "12.4 ± 1.4 %" in recorded.headline and "now 5.0 ± 2.0 %" in recorded.headline
    )
    again = said(LOST, *[fell[1]] * 11, LOST)
    assert again.state is State.ALARM and again.headline.endswith("alarm since 2027-01-15 08:02 UTC.")


def test_the_alarm_of_a_story_that_is_gone_states_no_size() -> None:
    told = said(replace(WELL, active={WHOLE: Level.ALARM}, losses={WHOLE: (0.001, 0.003, 2.0)}))
    assert told.state is State.ALARM
    assert told.headline == "The alarm of every story stands from before; no window since says its size."


def test_an_episode_states_the_latest_size_of_its_highest_level() -> None:
    rises = replace(LOST, active={2: Level.WARNING}, losses={2: (0.08, 0.003, 80.0)})
    (loss,) = course(rises, LOST, replace(LOST, losses={2: (0.097, 0.003, 80.0)})).losses
    assert (loss.level, loss.ddi, loss.t_first_ns, loss.t_level_ns) == (Level.ALARM, 0.124, T0, T0 + HOP_NS)


def test_a_named_finding_without_causes_is_a_doubt() -> None:
    assert said(WELL, findings=({**SWAP, "causes": []},)).state is State.DOUBTFUL


@pytest.mark.parametrize("level", [Level.ADVISORY, Level.WARNING, Level.ALARM])
def test_an_alarm_names_story_and_size(level: Level) -> None:
    told = said(WELL, replace(LOST, active={2: level}))
    assert told.state.value == level.value
    assert "left bearing" in told.headline and "12.4 ± 1.4 %" in told.headline
    assert ("not confirmed" in told.headline) == (level is Level.ADVISORY)


def test_a_loss_of_all_stories_alike_is_an_advisory() -> None:
    told = said(replace(WELL, active={WHOLE: Level.ADVISORY}, losses={WHOLE: (0.06, 0.001, 100.0)}))
    assert told.state is State.ADVISORY and "every story lost 6.0 % alike" in told.headline.lower()


def test_an_alarm_that_ended_is_the_state_of_the_recording_and_a_doubt_of_the_present() -> None:
    past = said(WELL, LOST, WELL)
    assert past.state is State.NORMAL and "An earlier alarm of story 2" in past.doubts[0]
    whole = said(WELL, LOST, WELL, whole=True)
    assert whole.state is State.ALARM and "until 2027-01-15 08:00 UTC" in whole.headline


def test_a_sensors_finding_stands_above_green() -> None:
    told = said(*[WELL] * 3, findings=(SWAP,))
    assert told.state is State.DOUBTFUL
    assert "a1 and a3 are swapped" in told.headline and "a proposal until it is accepted" in told.headline
    assert "no story changed by more than 0.2 %" in told.headline


def test_a_finding_never_lowers_an_alarm() -> None:
    told = said(WELL, LOST, findings=(SWAP,))
    assert told.state is State.ALARM and any("swapped" in doubt for doubt in told.doubts)


@pytest.mark.parametrize("accepted", [False, True])
def test_an_accepted_finding_is_a_doubt_no_longer(accepted: bool) -> None:
    known = replace(KNOWN, accepted=(("channel_swap", "channel a1,a3"),) if accepted else ())
    assert said(WELL, known=known, findings=(SWAP,)).state is (State.NORMAL if accepted else State.DOUBTFUL)


@pytest.mark.parametrize("verdict", ["ambiguous", "unexplained"])
def test_an_unknown_cause_is_a_doubt(verdict: str) -> None:
    finding = {**SWAP, "verdict": verdict, "causes": [], "says": "Something is wrong."}
    assert said(WELL, findings=(finding,)).state is State.DOUBTFUL


def test_a_finding_of_lost_stiffness_belongs_to_its_alarm() -> None:
    loss = {
        **SWAP,
        "says": "Story 2 is 12 % softer.",
        "causes": [{"effect": "stiffness_change", "location": "story 2"}],
    }
    told = said(WELL, LOST, findings=(loss,))
    assert told.headline.endswith("; diagnosis: story 2 is 12 % softer.")
    assert told.doubts == ()


def test_a_misfit_is_a_doubt_now_and_of_a_recording_only_where_it_lasts() -> None:
    bad = replace(WELL, misfit=31_869.0)
    told = said(WELL, bad)
    assert told.state is State.DOUBTFUL and "goodness of fit 3.19e+04" in told.headline
    assert said(*[bad] * 3, WELL, whole=True).state is State.NORMAL
    assert said(*[bad] * 41, WELL, whole=True).state is State.DOUBTFUL


@pytest.mark.parametrize(("factor", "tells"), [(1e3, "times stronger"), (1e-3, "times weaker")])
def test_motion_far_from_the_baselines_asks_for_the_unit(factor: float, tells: str) -> None:
    told = said(replace(WELL, rms_m_s2=factor))
    assert told.state is State.DOUBTFUL and tells in told.headline and "is the unit right" in told.headline


@pytest.mark.parametrize(("rms_m_s2", "asks"), [(9.81, True), (9.0, False), (1 / 9.81, True), (0.12, False)])
def test_g_for_m_s2_is_asked_about_while_it_lasts_and_in_a_recording_if_it_ever_was(
    rms_m_s2: float, asks: bool
) -> None:
    """The calibration saw 0.5 to 2 m/s^2: 1 m/s^2 in a wrong unit is told from days twice as calm or stormy."""
    odd = replace(WELL, rms_m_s2=rms_m_s2)
    assert ("is the unit right" in said(WELL, odd).headline) == asks
    assert ("is the unit right" in said(odd, WELL, whole=True).headline) == asks
    assert said(odd, WELL).state is State.NORMAL


@pytest.mark.parametrize(
    ("stamped_hz", "calibration", "state"),
    [
        (100.0, 1.0, State.NORMAL),
        (99.8, 1.0, State.NORMAL),
        (98.0, 1.0, State.DOUBTFUL),
        (98.0, 0.98, State.NORMAL),
        (100.0, 0.98, State.DOUBTFUL),
    ],
)
def test_a_rate_that_the_stamps_contradict_is_a_doubt_unless_calibration_had_the_same(
    stamped_hz: float, calibration: float, state: State
) -> None:
    known, error = replace(KNOWN, clock_ratio=calibration), 2.0 * abs(stamped_hz / 100.0 / calibration - 1.0)
    window = replace(WELL, rates_hz=(100.0, stamped_hz), detectable=(0.01 + error, 0.012 + error, 0.008 + error))
    told = said(window, known=known)
    assert told.state is state
    if state is State.DOUBTFUL:
        assert f"at {stamped_hz:g} Hz by their timestamps, at 100 Hz" in told.headline


@pytest.mark.parametrize(
    ("ratio", "std", "doubtful"),
    [(0.98, 0.0, True), (0.98, 0.01, False), (1.002, 1e-5, False), (20.0, 0.0, False), (0.05, 0.0, False)],
)
def test_a_rate_that_the_driver_measures_is_a_doubt_unless_it_is_unsure_or_data_are_played_back(
    ratio: float, std: float, doubtful: bool
) -> None:
    told = assess(course(replace(WELL, rates_hz=(100.0, 100.0))), KNOWN, clocks=[("node 3", ratio, std)])
    assert (told.state is State.DOUBTFUL) == doubtful
    assert ("at 98 Hz by the clock of this machine (node 3), at 100 Hz" in told.headline) == doubtful


def test_a_clock_that_lets_no_window_be_judged_is_a_doubt() -> None:
    odds = replace(WELL, skipped="the clock and the stated rate are at odds (98 Hz and 100 Hz)", rates_hz=(100.0, 98.0))
    assert said(*[odds] * 50).state is State.DOUBTFUL


def test_strong_motion_that_is_told_as_an_event_does_not_ask_for_the_unit() -> None:
    shaken = WindowFacts(T0, WINDOW_S, STRONG_MOTION, rms_m_s2=100.0)
    assert not any("is the unit right" in text for text in (said(WELL, shaken).headline, *said(WELL, shaken).doubts))
    assert said(WELL, shaken, WELL, whole=True).state is State.NORMAL
    noise = replace(shaken, skipped="pure noise", rms_m_s2=1e-3)
    assert "is the unit right" in said(WELL, noise).headline


def test_the_gravest_is_the_headline_and_the_rest_are_doubts() -> None:
    known = replace(KNOWN, baseline_doubts=("the baseline is of another frame",))
    told = said(replace(LOST, active={2: Level.WARNING}, misfit=9.0, detectable=(None, 0.01, 0.01)), known=known)
    assert told.state is State.WARNING
    assert len(told.doubts) == 3
    assert "goodness of fit" in told.doubts[0] and "another frame" in told.doubts[1] and "not seen" in told.doubts[2]
    assert [s.value for s in sorted(State, key=lambda s: -s.rank)] == [
        "alarm", "warning", "doubtful", "advisory", "not_judged", "normal"
    ]  # fmt: skip


def test_skipped_windows_are_counted_beside_green() -> None:
    gap = replace(WELL, skipped="gap in the data", detectable=None, misfit=None)
    told = said(WELL, gap, WELL)
    assert told.state is State.NORMAL and told.doubts[0].startswith("1 of 3 windows could not be judged (1: gap")


def test_a_channel_that_is_left_out_is_the_headline_until_it_is_back() -> None:
    known = replace(KNOWN, channels=("a1", "a2", "a3"))
    without = replace(WELL, left_out=(("a2", "is stuck (40 % of the window)"),))
    out = said(WELL, without, without, known=known)
    assert out.state is State.DOUBTFUL
    assert out.headline == "Channel a2 is stuck, since 2027-01-15 08:00 UTC; judged with a1, a3."
    more = replace(WELL, left_out=(("a2", "is stuck (90 % of the window)"),))
    assert said(WELL, without, more, known=known).headline == out.headline  # told once
    back = said(WELL, without, more, WELL, known=known)
    assert back.state is State.NORMAL
    assert any(doubt.startswith("Channel a2 was left out (is stuck)") for doubt in back.doubts)
    lost = replace(without, skipped="too few modes", changes=())
    assert "too few" in said(WELL, lost, known=known).headline


def test_an_alarm_stands_above_a_channel_that_is_left_out() -> None:
    out = said(WELL, replace(LOST, left_out=(("a2", "does not move"),)), known=KNOWN)
    assert out.state is State.ALARM
    assert any("a2" in doubt.lower() for doubt in out.doubts)


def test_times_without_a_channel_are_kept_up_to_a_number() -> None:
    without = replace(WELL, left_out=(("a2", "does not move"),))
    kept = course(*[without, WELL] * 80, without).outages
    assert len(kept) == 65 and kept[-1].t_last_ns is None and all(o.t_last_ns is not None for o in kept[:-1])
