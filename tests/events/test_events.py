"""Events: recognized as motion of the whole structure alone, measured against simulated truth, told once and in time."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import fftconvolve, resample_poly

from drivers.base import ACCELERATION, SampleBlock
from monitor.config import Configuration
from monitor.core import Skipped, WindowResult
from monitor.events import Event, LimitTable, compared, recognition, stage
from monitor.events.ambient import AmbientReading, lasting_loss
from monitor.events.limits import judge
from monitor.events.motion import instrumental_intensity, integrated, response_spectrum
from monitor.events.site import Site
from monitor.model import Building, InstrumentedModel, Model
from monitor.pipeline import Pipeline, Result
from monitor.publish import event_line, event_text, read_event, to_json
from tests.events.shaken import HEIGHTS, RATE, STIFFNESS, T0_NS, Array, Shaken, blocks, configuration, shake
from tests.service.checkpoint import restored
from tests.support.quake import ground, shaken, true_drifts

WINDOWS = {"processing": {"window_s": 100.0, "hop_s": 50.0}}


def run(config: Configuration, data: Sequence[SampleBlock]) -> list[Result]:
    pipeline, out = Pipeline(config), []
    for block in data:
        out += pipeline.push(block)
    return out


def events(results: Sequence[Result]) -> list[Event]:
    return [r for r in results if isinstance(r, Event)]


@pytest.mark.parametrize(("with_ground", "error"), [(True, 0.05), (False, 0.15)])
def test_peak_drifts_are_those_of_the_simulation(with_ground: bool, error: float) -> None:
    told = events(run(configuration(), blocks(shaken(), with_ground=with_ground)))
    assert [e.revision for e in told] == [None, 0]
    truth = true_drifts(shaken(), told[1])
    assert told[1].drift_m == pytest.approx(truth, rel=error)
    assert (np.abs(told[1].drift_m - truth) < 3.0 * told[1].drift_std_m).all()
    assert told[1].drift_ratio == pytest.approx(told[1].drift_m / HEIGHTS)
    assert (told[1].ground is not None) is with_ground
    peak = np.abs(shaken().floors).max(axis=0)
    assert [f.peak_m_s2 for f in told[1].floors] == pytest.approx(peak, rel=0.05)
    assert told[1].during_hz[0] == pytest.approx(3.14, rel=0.05)


def test_any_block_size_tells_the_same() -> None:
    first, second = (run(configuration(**WINDOWS), blocks(shaken(), n=n)) for n in (37, 4000))
    for one, other in zip(events(first), events(second), strict=True):
        assert to_json(event_line(one)) == to_json(event_line(other))
    assert [w.skipped for w in first if isinstance(w, WindowResult)] == [
        w.skipped for w in second if isinstance(w, WindowResult)
    ]


@pytest.mark.parametrize("n_channels", [1, 2, 3])
def test_steps_measured_together_give_the_state_of_each_alone(n_channels: int) -> None:
    settings, rng = configuration().events, np.random.default_rng(n_channels)
    samples = rng.standard_normal((60 * 200, n_channels))
    samples[9000:9600] *= 9.0
    together = alone = recognition.start(n_channels, 100.0, 40.0)
    own, quiet = recognition.own_band(200, 100.0, 40.0, 2.0), 0
    for first in range(0, len(samples), 1000):
        frames = recognition.measure(together.tail, samples[first : first + 1000], 100.0, 40.0)
        passed = recognition.pass_quiet(together, frames, own, settings)
        quiet += passed is not None
        for k in range(5):
            at = first + 200 * k
            one = recognition.measure(alone.tail, samples[at : at + 200], 100.0, 40.0)
            alone, _ = recognition.step(alone, one, 0, own, settings, active=False)
            if passed is None:
                together, _ = recognition.step(together, frames, k, own, settings, active=False)
        together = together if passed is None else passed
        assert together.long_term.tobytes() == alone.long_term.tobytes()
        assert together.tail.tobytes() == alone.tail.tobytes()
        assert (together.steps, together.raised) == (alone.steps, alone.raised)
    assert 6 < quiet < 12


def test_it_is_told_when_strong_motion_ends_and_again_within_a_minute() -> None:
    pipeline, told = Pipeline(configuration()), list[tuple[float, Event]]()
    for block in blocks(shaken(), n=40):
        told += [((block.t_ns - T0_NS) * 1e-9, e) for e in events(pipeline.push(block))]
    (at_first, first), (at_final, final) = told
    end_s = (final.end_ns - T0_NS) * 1e-9
    assert at_first - (first.end_ns - T0_NS) * 1e-9 < 5.0
    assert at_final - end_s < 60.0
    assert abs((final.begin_ns - T0_NS) * 1e-9 - 80.0) < 2.5


def whole(data: Sequence[SampleBlock], **limit: object) -> list[Event]:
    """The events of data that end, by a site with one limit or none."""
    pipeline = Pipeline(configuration(events={"limits": [limit]} if limit else {}))
    out = [r for block in data for r in pipeline.push(block)]
    return events([*out, *pipeline.finish()])


@pytest.mark.parametrize("length_s", [50.0, 110.0])  # shorter than the minute that the average takes, and longer
@pytest.mark.parametrize("into_s", [6.0, 3.0, -1.0, -4.0])
def test_a_quake_amid_which_or_just_before_which_the_recording_begins_is_told(into_s: float, length_s: float) -> None:
    motion = shake(ground(200.0, (80.0, 1.0, 3)), np.random.default_rng(4))[0]
    first, last = (round((80.0 + into_s + s) * RATE) for s in (0.0, length_s))
    floors, base = motion.floors[first:last], motion.ground[first:last]
    cut = Shaken(floors, base, motion.drifts[first:last])
    (told,) = whole(blocks(cut, n=40), drift_ratio=1.0, says="inspect")
    assert told.revision == 0 and "it began before the recording" in told.note
    assert (told.begin_ns - T0_NS) * 1e-9 < 6.0 and 8.0 < (told.end_ns - T0_NS) * 1e-9 + into_s < 25.0
    peak = np.abs(floors[round(4.0 * RATE) :]).max(axis=0)  # after the filters have settled
    assert [f.peak_m_s2 for f in told.floors] == pytest.approx(peak, rel=0.05)
    assert told.cut and told.is_bound.all() and "at least" in event_text(told)
    assert len(told.exceeded) == 3 and all(says.startswith("possibly exceeded") for says in told.exceeded)
    assert read_event(event_line(told)).cut
    (large,) = whole(blocks(cut, n=4000), drift_ratio=1.0, says="inspect")
    assert to_json(event_line(large)) == to_json(event_line(told))


def test_a_quiet_beginning_and_a_gale_that_dies_are_no_events() -> None:
    n = round(150.0 * RATE)
    dying = 1.0 + 4.0 * np.clip(1.0 - np.arange(n) / RATE / 60.0, 0.0, 1.0)
    for seed in range(3):
        for level in (1.0, dying):
            motion = shake(np.zeros(n), np.random.default_rng(seed), level=level)[0]
            assert not whole(blocks(motion, with_ground=False, n=1000))


def test_two_events_twenty_seconds_apart_are_two_and_ten_are_one() -> None:
    def count(gap_s: float) -> int:
        wave = ground(230.0, (80.0, 1.0, 3), (80.0 + 17.0 + gap_s, 1.0, 5))
        motion = shake(wave, np.random.default_rng(4))[0]
        return sum(e.revision == 0 for e in events(run(configuration(), blocks(motion, n=400))))

    assert (count(22.0), count(0.0)) == (2, 1)


def test_spikes_steps_a_knocked_sensor_a_dead_channel_and_a_gale_are_no_events() -> None:
    n, rng = round(600.0 * RATE), np.random.default_rng(8)
    gale = 1.0 + 4.0 * np.clip((np.arange(n) / RATE - 200.0) / 120.0, 0.0, 1.0)
    motion = shake(np.zeros(n), rng, level=gale)[0]
    floors = motion.floors.copy()
    for at in (90.0, 130.0, 170.0):  # a door: all floors for a tenth of a second
        i = round(at * RATE)
        floors[i : i + 20] += rng.normal(0.0, 3.0, (20, 3))
    floors[round(400 * RATE) : round(408 * RATE), 1] += rng.normal(0.0, 5.0, (round(8 * RATE), 1))[:, 0]  # knocked
    floors[round(450 * RATE) :, 2] = 0.0  # dead
    floors[round(500 * RATE) :, 0] += 4.0  # a step
    assert not events(run(configuration(), blocks(replace(motion, floors=floors), with_ground=False, n=500)))


def _disturbed(kind: str, seed: int) -> Array:
    """100 s of ambient motion on three floors, with two disturbances within 2 s of one another after 70 s."""
    rng = np.random.default_rng(seed)
    floors = shake(np.zeros(round(100.0 * RATE)), rng)[0].floors
    first = round((70.0 + rng.uniform()) * RATE)
    second = first + round(rng.uniform(1.0, 2.0) * RATE)
    if kind == "two spikes":
        floors[first, :2] += rng.uniform(1.0, 20.0)
        floors[second] += rng.uniform(1.0, 20.0)
    elif kind == "a spike and a door":
        floors[first, :2] += rng.uniform(1.0, 20.0)
        t = np.arange(200) / RATE
        door = 3.0 * np.exp(-t / 0.1) * np.sin(2.0 * np.pi * rng.uniform(4.0, 12.0) * t)
        floors[second : second + 200] += door[:, None] * rng.uniform(0.1, 1.0, 3)
    else:
        floors[first : first + 1200, 0] += rng.normal(0.0, 3.0, 1200)
        floors[second : second + 1600, 2] += rng.normal(0.0, 5.0, 1600)
    return floors


@pytest.mark.parametrize("kind", ["two spikes", "a spike and a door", "work on two floors at once"])
def test_disturbances_that_together_raise_three_frames_are_no_events(kind: str) -> None:
    for seed in range(6):
        motion = Shaken(_disturbed(kind, seed), np.zeros(0), np.zeros(0))
        assert not events(run(configuration(), blocks(motion, with_ground=False, n=1000))), seed


def test_directions_that_do_not_move_coherently_are_motion_of_the_whole_structure() -> None:
    """An earthquake moves a building in two directions that have little to do with one another."""
    rng, settings = np.random.default_rng(3), configuration().events
    state = recognition.start(2, 100.0, 40.0)
    for _ in range(30):
        frames = recognition.measure(state.tail, rng.standard_normal((200, 2)), 100.0, 40.0)
        state, _ = recognition.step(state, frames, 0, 4, settings, active=False)
    apart = 10.0 * rng.standard_normal((400, 2))
    found = [
        recognition.is_whole(state.long_term, apart, 100.0, 40.0, settings, one_direction=one) for one in (True, False)
    ]
    assert found == [False, True]


def test_a_disturbance_that_stays_is_ambient_motion_after_the_longest_event() -> None:
    motion = shake(np.zeros(round(260.0 * RATE)), np.random.default_rng(5))[0]
    floors, half = motion.floors.copy(), round(80.0 * RATE)
    floors[half:, :2] += np.random.default_rng(6).normal(0.0, 3.0, (len(floors) - half, 2))
    config = configuration(events={"longest_s": 30.0}, processing={"window_s": 50.0, "hop_s": 10.0})
    results = run(config, blocks(replace(motion, floors=floors), with_ground=False, n=500))
    assert not events(results)
    skipped = [
        w.skipped is not None and "strong motion" in w.skipped.reason for w in results if isinstance(w, WindowResult)
    ]
    assert any(skipped) and not any(skipped[-5:])


def test_a_weak_quake_at_six_times_the_ambient_motion_is_recognized() -> None:
    for seed in range(3):
        motion = shake(ground(150.0, (80.0, 0.05, seed)), np.random.default_rng(seed))[0]
        strong, quiet = (motion.floors[part].std(axis=0).mean() for part in (slice(16400, 17600), slice(8000, 16000)))
        assert 4.0 < strong / quiet < 12.0
        found = events(run(configuration(), blocks(motion, n=500)))
        assert [e.revision for e in found] == [None, 0], seed


def test_the_beginning_of_ambient_motion_is_no_event() -> None:
    """Of a frame at rest, which its forces then fill with motion, and of one that moves already; 20 seeds of each."""
    for seed in range(20):
        rng = np.random.default_rng(100 + seed)
        first, state = shake(np.zeros(round(70.0 * RATE)), rng)
        second, _ = shake(np.zeros(round(70.0 * RATE)), rng, start=state)
        for motion in (first, second):
            assert not events(run(configuration(), blocks(motion, with_ground=False, n=1000))), seed


def test_an_event_after_ten_seconds_of_quiet_is_told_and_skips_no_window() -> None:
    """So begins the recording of a test, and its windows are what the user wants to see."""
    motion = shake(ground(160.0, (12.0, 1.0, 3)), np.random.default_rng(4))[0]
    results = run(configuration(**WINDOWS), blocks(motion, n=500))
    told = events(results)
    assert [e.revision for e in told] == [None, 0] and "s of motion before it are known" in told[1].note
    assert told[1].drift_m == pytest.approx(true_drifts(motion, told[1]), rel=0.05)
    reasons = [w.skipped.reason for w in results if isinstance(w, WindowResult) and w.skipped is not None]
    assert not any("strong motion" in reason for reason in reasons)


def test_windows_that_hold_an_event_are_skipped_by_name() -> None:
    motion = shake(ground(420.0, (80.0, 1.0, 3)), np.random.default_rng(4))[0]
    results = run(configuration(**WINDOWS), blocks(motion, n=500))
    windows = [r for r in results if isinstance(r, WindowResult)]
    (event,) = (e for e in events(results) if e.revision == 0)
    begin, end = ((t - T0_NS) * 1e-9 for t in (event.begin_ns, event.end_ns))
    begins = [(w.t_end_ns - T0_NS) * 1e-9 - 100.0 for w in windows]
    held = [b < end + 10.0 and b + 100.0 > begin for b in begins]  # 10 s: what begins again by then belongs to it
    named = [w.skipped is not None and w.skipped.reason.startswith("strong motion") for w in windows]
    assert named == held and not all(held)


def _lasting(lost: float, seed: int) -> Event:
    rng, half = np.random.default_rng(seed), 800.0
    first, state = shake(ground(half, (half - 60.0, 1.0, seed)), rng)
    after = STIFFNESS * np.array([1.0, 1.0 - lost, 1.0])
    second, _ = shake(np.zeros(round(half * RATE)), rng, stiffness=after, start=state)
    motion = Shaken(*(np.concatenate([getattr(first, n), getattr(second, n)]) for n in ("floors", "ground", "drifts")))
    config = configuration(**WINDOWS, events={"revision_s": 700.0, "limits": [LOSS_LIMIT]})
    told = events(run(config, blocks(motion, n=500)))
    assert [e.revision for e in told] == [None, 0, 1]
    assert np.isnan(told[0].loss).all() and (told[1].loss_std > 3.0 * told[2].loss_std).all()
    return told[2]


LOSS_LIMIT = {"residual_loss": 0.05, "says": "send the engineer"}


@pytest.mark.parametrize("lost", [0.0, 0.1])
def test_the_lasting_loss_is_told_after_ambient_motion(lost: float) -> None:
    event = _lasting(lost, 11)
    truth = np.array([0.0, lost, 0.0])
    assert np.abs(event.loss - truth).max() < 0.02
    assert (np.abs(event.loss - truth) < 4.0 * event.loss_std + 0.002).all()
    assert event.verdict == ("send the engineer" if lost else "no limit exceeded")
    assert event.after_hz[0] == pytest.approx(event.before_hz[0], rel=0.005 + 0.5 * lost)


def test_limits_of_the_site_decide_in_its_own_words() -> None:
    def verdict(*limits: dict[str, object], **tables: object) -> Event:
        return events(run(configuration(events={"limits": limits}), blocks(shaken(), n=500)))[-1]

    assert verdict().verdict is None
    assert verdict({"drift_ratio": 0.1, "says": "clear the house"}).verdict == "no limit exceeded"
    beyond = verdict({"drift_ratio": 1e-4, "says": "clear the house"})
    assert beyond.verdict == "clear the house" and "story" in beyond.exceeded[0]
    assert "lear the house" in event_text(beyond)


def test_a_limit_of_the_lasting_loss_alone_is_not_judged_before_the_revision() -> None:
    told = events(run(configuration(events={"limits": [LOSS_LIMIT]}), blocks(shaken(), n=500)))
    assert [e.revision for e in told] == [None, 0] and [e.verdict for e in told] == [None, None]


@pytest.mark.parametrize("with_ground", [True, False])
@pytest.mark.parametrize("reach", [2.0, 5.0, 20.0])
def test_sensors_that_saturate_give_lower_bounds_and_a_limit_that_is_possibly_exceeded(
    reach: float, with_ground: bool
) -> None:
    """The range is so many times the peak of the ambient motion; the limit lies above what the cut-off samples show."""
    motion, limit = shaken(), {"drift_ratio": 0.1, "says": "inspect the joints"}
    ambient = np.abs(motion.floors[: round(70 * RATE)]).max(axis=0)
    cut = replace(motion, floors=np.clip(motion.floors, -reach * ambient, reach * ambient))
    pipeline = Pipeline(configuration(events={"limits": [limit]}))
    results = [r for b in blocks(cut, n=500, with_ground=with_ground) for r in pipeline.push(b)]
    told = [*events(results), *pipeline.finish()]
    assert [e.revision for e in told] == [None, 0]
    for event in told:
        assert {"a1", "a2"} <= set(event.saturated)
        assert event.verdict == "possibly exceeded: inspect the joints"
        assert any("story" in words and "at least" in words for words in event.exceeded)
        assert "reached the end of the range" in event.note and "at least" in event_text(event)
        assert np.isnan(event.drift_std_m[np.isfinite(event.drift_m)]).any()
        line = event_line(event)
        assert line["saturated"] == list(event.saturated) and None in line["drift_peak_std_m"]
        again = read_event(line)
        assert again.saturated == event.saturated
        assert compared(again, LimitTable.model_validate(limit)).possibly.any()
    lower = LimitTable.model_validate(limit | {"drift_ratio": 1e-7})
    sure = judge(
        told[1], replace(pipeline.site, settings=pipeline.site.settings.model_copy(update={"limits": (lower,)}))
    )
    assert sure.verdict == "inspect the joints" and all("drift ratio at least" in words for words in sure.exceeded)
    (alarm,) = pipeline.state.events.alarms
    assert alarm.unacknowledged and f"event {told[0].id} possibly exceeded a limit of the site: inspect" in alarm.says


@pytest.mark.parametrize("reach", [1.5, 2.0, 3.0])
@pytest.mark.parametrize("peak", [1.0, 20.0, 200.0])
def test_a_quake_that_saturates_all_sensors_early_in_the_data_is_an_event(peak: float, reach: float) -> None:
    """The range, not the motion, bounds what the samples exceed the ambient motion by, when little of that is known yet."""
    motion = shake(ground(65.0, (15.0, peak, 3)), np.random.default_rng(4))[0]
    limit = reach * np.abs(motion.floors[: round(10 * RATE)]).max()
    cut = replace(motion, floors=np.clip(motion.floors, -limit, limit))
    told = events(run(configuration(), blocks(cut, n=500, with_ground=False)))
    assert told[0].revision is None and len(told[0].saturated) == 3


def test_a_sensor_that_saturates_leaves_the_stories_that_it_does_not_enter_known() -> None:
    motion = shaken()
    top = np.abs(motion.floors[:, 0]).max()
    floors = np.column_stack([np.clip(motion.floors[:, 0], -0.5 * top, 0.5 * top), motion.floors[:, 1:]])
    config = configuration(events={"limits": [{"drift_ratio": 0.1, "says": "go"}]})
    event = events(run(config, blocks(replace(motion, floors=floors), n=500)))[-1]
    assert event.saturated == ("a1",)
    assert np.isnan(event.drift_std_m).tolist() == [True, False, False]
    assert [words.count("story 1") for words in event.exceeded] == [1]


@pytest.mark.parametrize("fault", [0.0, np.nan])
def test_a_dead_channel_tells_no_drift_and_no_limit_is_judged(fault: float) -> None:
    floors = shaken().floors.copy()
    floors[round(85 * RATE) : round(92 * RATE), 1] = fault
    config = configuration(events={"limits": [{"drift_ratio": 0.1, "says": "clear the house"}]})
    event = events(run(config, blocks(replace(shaken(), floors=floors), n=500)))[-1]
    assert np.isnan(event.drift_m[:2]).all() and event.verdict is None and "a2 gave no motion" in event.note
    assert json.loads(to_json(event_line(event)))["peak_acceleration_m_s2"]["a2"] is None
    assert "a2" not in event_text(event)


def test_a_gap_ends_an_event_and_says_so() -> None:
    data = [b for b in blocks(shaken(), n=50) if not 90.0 < (b.t_ns - T0_NS) * 1e-9 < 95.0]
    told = [e for e in events(run(configuration(), data)) if e.revision == 0]
    assert told and "gap" in told[0].note


def test_an_event_that_the_data_end_in_is_told() -> None:
    pipeline = Pipeline(configuration())
    for block in blocks(shaken(), n=50):
        if (block.t_ns - T0_NS) * 1e-9 < 90.0:
            pipeline.push(block)
    (told,) = pipeline.finish()
    assert told.revision == 0 and "the data end" in told.note and not pipeline.finish()


def test_the_state_survives_a_checkpoint_in_the_middle_of_an_event() -> None:
    data = blocks(shaken(), n=50)
    whole = [to_json(event_line(e)) for e in events(run(configuration(), data))]
    half = Pipeline(configuration())
    told = [e for b in data[:720] for e in events(half.push(b))]
    rest = Pipeline(configuration())
    rest.state = restored(half.state)
    told += [e for b in data[720:] for e in events(rest.push(b))]
    assert [to_json(event_line(e)) for e in told] == whole


def test_the_line_is_strict_json_with_null_for_what_cannot_be_said() -> None:
    told = events(run(configuration(), blocks(shaken(), with_ground=False, n=500)))
    line = json.loads(to_json(event_line(told[0])))
    assert line["revision"] is None and line["ground_peak_m_s2"] is None and line["loss"] == [None] * 3
    assert line["id"] == told[1].id and set(line["peak_acceleration_m_s2"]) == {"a1", "a2", "a3"}


def test_disabled_nothing_is_told_and_no_window_is_skipped() -> None:
    results = run(configuration(**WINDOWS, events={"enabled": False}), blocks(shaken(), n=500))
    assert not events(results)
    windows = [r for r in results if isinstance(r, WindowResult)]
    assert windows and not any(isinstance(w.skipped, Skipped) and "strong motion" in w.skipped.reason for w in windows)


def test_a_lasting_loss_needs_windows_on_both_sides() -> None:
    one = AmbientReading(0, 100, np.ones(1), np.zeros(1), np.zeros(2), np.full(2, 1e-4), 1.0)
    loss, std, note = lasting_loss((one,), (one, one), 2)
    assert np.isnan(loss).all() and np.isnan(std).all() and "before" in note
    louder = replace(one, loss=np.array([0.1, 0.0]), rms_m_s2=3.0)
    loss, std, note = lasting_loss((one, one), (louder, louder), 2)
    assert loss == pytest.approx([0.1, 0.0]) and std == pytest.approx([0.01, 0.01]) and "3 times" in note


def test_an_oscillator_s_response_is_that_of_the_convolution() -> None:
    rng = np.random.default_rng(2)
    wave = np.concatenate([rng.standard_normal(400), np.zeros(600)])
    found = response_spectrum(wave, 100.0)
    k = 30
    w, z, t = 2.0 * np.pi / found.period_s[k], 0.05, np.arange(100_000) / 10_000.0
    damped = w * np.sqrt(1.0 - z * z)
    impulse = np.exp(-z * w * t) * np.sin(damped * t) / damped
    fine = np.interp(t, np.arange(wave.size) / 100.0, wave)
    moved = fftconvolve(fine, impulse)[: t.size] / 10_000.0
    assert found.pseudo_acceleration_m_s2[k] == pytest.approx(w * w * np.abs(moved).max(), rel=0.01)


def test_integration_leaves_out_what_lies_below_the_corner() -> None:
    t = np.arange(0.0, 100.0, 0.01)
    slow, fast = np.sin(2.0 * np.pi * 0.02 * t), np.sin(2.0 * np.pi * 2.0 * t) * np.hanning(t.size)
    moved = integrated((slow + fast)[:, None], 100.0, 0.2, 2)[2000:-2000, 0]
    assert np.abs(moved).max() == pytest.approx(1.0 / (4.0 * np.pi) ** 2, rel=0.05)


def test_the_intensity_is_that_of_the_relation() -> None:
    assert instrumental_intensity(1e-4, 1e-5) == 1.0
    assert instrumental_intensity(1.2, 0.1) == pytest.approx(0.5 * (3.66 * np.log10(120.0) - 1.66 + 3.47 + 2.35))


def test_the_stage_begins_without_samples() -> None:
    state = stage.start()
    assert stage.skipped(state, T0_NS, 100.0, configuration().events) is None


def test_a_ground_of_another_rate_is_read_too() -> None:
    data = blocks(shaken(), with_ground=False, n=50)
    half = resample_poly(shaken().ground, 1, 2).astype(np.float32)
    for i in range(0, half.size, 25):
        t_ns = T0_NS + round(i / 100.0 * 1e9)
        data.append(SampleBlock("/acceleration/ground", t_ns, i, 100.0, ("g",), "m/s^2", half[i : i + 25, None]))
    data.sort(key=lambda b: (b.t_ns, b.topic == ACCELERATION))
    final = events(run(configuration(), data))[-1]
    assert final.ground is not None
    assert final.drift_m == pytest.approx(true_drifts(shaken(), final), rel=0.05)


def test_the_springs_of_a_building_hold_up_the_inertia_above_them() -> None:
    """In a mode the elastic forces are those of inertia: each spring has its stiffness times its strain, with torsion too."""
    plan, eccentricity = np.tile([20.0, 12.0], (3, 1)), np.tile([1.0, 0.4], (3, 1))
    stiffness = np.concatenate([[9e7, 8e7, 7e7], [6e7, 5.5e7, 5e7], [9e9, 8e9, 7e9]])
    model = Model(Building(np.array([1.2e5, 1e5, 0.9e5]), stiffness, 0.01, plan, eccentricity))
    instrumented = InstrumentedModel(model, tuple("abcdefghi"), (0,) * 9, np.full(12, 0.1), rows=np.eye(9))
    site, modes = Site.of(instrumented, ("",) * 9, 100.0, configuration().events), model.modes()
    forces = site.story_forces @ modes.shapes * modes.eigenvalues
    np.testing.assert_allclose(
        forces, stiffness[:6, None] * (site.drifts @ modes.shapes), atol=1e-6 * np.abs(forces).max()
    )
