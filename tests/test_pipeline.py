"""The whole way: the same samples give the same results, however they were cut, filed or interrupted."""

from __future__ import annotations

import copy
import json
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from drivers.base import ACCELERATION, GROUND, SampleBlock
from drivers.mcap_file import McapWriter, read_recordings
from monitor.config import Configuration
from monitor.core import BadInputError, Gap, Samples, UserError, WindowResult
from monitor.damage import Baseline, Known, alarm
from monitor.events import Event
from monitor.identification import SelectionSettings
from monitor.model import MatrixStructure, Model, ShearFrame, simulate
from monitor.pipeline import Pipeline, Result
from monitor.publish import Summary, facts_of_line, to_json, window_line
from monitor.runs import calibrate, cut_into_blocks
from tests.events import shaken
from tests.support import results, short_quake
from tests.support.frames import configured, settings_of, shear_frame
from tests.support.learned import baseline_of, learned, results_of
from tests.support.results import modal_estimate, window_result
from tests.support.samples import T0_NS, Cut, write_blocks
from tests.support.two_directions import HEALTHY, two_directions

RATE = 128.0
DURATION_S = 42.0
Told = tuple[list[str], bytes, list[Gap]]


@pytest.fixture(scope="module")
def site(frame_text: str) -> Configuration:
    return settings_of(frame_text)


@pytest.fixture(scope="module")
def record(site: Configuration) -> np.ndarray:
    return simulate(site.model(), duration_s=DURATION_S, rate_hz=RATE, noise=0.03, seed=6).floors


def push(pipeline: Pipeline, blocks: list[SampleBlock]) -> list[Result]:
    return [result for block in blocks for result in pipeline.push(block)]


def windows(results: list[Result]) -> list[WindowResult]:
    return [r for r in results if isinstance(r, WindowResult)]


def told(results: list[Result]) -> Told:
    """Everything that does not depend on how samples were cut: lines, all conditioned samples, gaps."""
    samples = b"".join(r.values.tobytes() for r in results if isinstance(r, Samples))
    return [to_json(window_line(r)) for r in windows(results)], samples, [r for r in results if isinstance(r, Gap)]


@pytest.fixture(scope="module")
def whole(site: Configuration, record: np.ndarray, cut: Cut) -> Told:
    return told(push(Pipeline(site), cut(record, RATE, [len(record)])))


HOLE = slice(3000, 3131)


def with_hole(record: np.ndarray, cut: Cut, sizes: list[int]) -> list[SampleBlock]:
    after = cut(record[HOLE.stop :], RATE, sizes, first=HOLE.stop)
    return cut(record[: HOLE.start], RATE, sizes) + after


def test_five_stories_at_the_working_rate_are_identified() -> None:
    """A source at 100 Hz has next to nothing between the lowpass and half its rate."""
    site = shear_frame([1e5] * 5, [3.6e8] * 5, processing={"window_s": 200.0})
    motion = simulate(site.model(), duration_s=240.0, rate_hz=100.0, noise=0.01, seed=0).floors
    pipeline = Pipeline(site)
    blocks = cut_into_blocks(ACCELERATION, motion, site.channels, 100.0, 10**18, 1000)
    windows = [r for b in blocks for r in pipeline.push(b) if isinstance(r, WindowResult)]
    assert len(windows) == 5
    for window in windows:
        assert window.modes is not None, window.skipped
        np.testing.assert_allclose(window.modes.frequencies_hz, site.model().modes().frequencies_hz, rtol=0.01)


def test_a_record_without_gaps_has_the_contracts_windows(site: Configuration, record: np.ndarray, cut: Cut) -> None:
    results = windows(push(Pipeline(site), cut(record, RATE)))
    assert [r.index for r in results] == list(range(int((DURATION_S - 20.0) // 5.0) + 1))
    assert [r.t_end_ns for r in results] == [T0_NS + (20 + 5 * k) * 10**9 for k in range(len(results))]
    assert all(r.window_s == 20.0 for r in results)
    truth = site.model().modes().frequencies_hz
    for r in results:
        assert r.skipped is None and r.modes is not None
        np.testing.assert_allclose(r.modes.frequencies_hz, truth, rtol=0.02)


@given(sizes=st.lists(st.integers(1, 1500), min_size=1, max_size=8))
@settings(deadline=None, max_examples=12)
def test_any_block_sizes_give_the_same_bits(
    site: Configuration, record: np.ndarray, cut: Cut, whole: Told, sizes: list[int]
) -> None:
    assert told(push(Pipeline(site), cut(record, RATE, sizes))) == whole


LOST = slice(2600, 3300)
"""Samples without a2: from 20.3 s to 25.8 s."""


@pytest.fixture(scope="module")
def partly_lost(record: np.ndarray) -> np.ndarray:
    spoilt = record.copy()
    spoilt[LOST, 1] = np.nan
    return spoilt


@given(sizes=st.lists(st.integers(1, 1500), min_size=1, max_size=8))
@settings(deadline=None, max_examples=12)
def test_any_block_sizes_give_the_same_bits_without_samples_of_one_channel(
    site: Configuration, partly_lost: np.ndarray, cut: Cut, sizes: list[int]
) -> None:
    pipeline, one = Pipeline(site), Pipeline(site)
    assert told(push(pipeline, cut(partly_lost, RATE, sizes))) == told(push(one, cut(partly_lost, RATE, [5376])))
    assert pipeline.state.align.dropped == 0


def test_a_channel_that_loses_samples_is_left_out_of_their_windows_alone(
    site: Configuration, record: np.ndarray, partly_lost: np.ndarray, cut: Cut
) -> None:
    whole = {r.index: r for r in windows(push(Pipeline(site), cut(record, RATE)))}
    parts = {r.index: r for r in windows(push(Pipeline(site), cut(partly_lost, RATE)))}
    assert [[gone.channel for gone in r.left_out] for r in parts.values()] == [[], ["a2"], ["a2"], ["a2"], ["a2"]]
    assert all(r.skipped is None for r in parts.values())
    assert to_json(window_line(parts[0])) == to_json(window_line(whole[0]))
    for k in (1, 2, 3, 4):
        line = json.loads(to_json(window_line(parts[k])))
        assert line["channels_left_out"] == ["a2"] and line["left_out_reasons"] == ["lost samples"]
        assert [[pair is None for pair in shape] for shape in line["mode_shapes"]] == [[False, True, False]] * 3
        np.testing.assert_allclose(line["frequencies_hz"], window_line(whole[k])["frequencies_hz"], rtol=5e-3)


@pytest.mark.parametrize("stands", [3e38, -3e38, 1e20, -1e8, 1e4])
def test_a_number_that_no_sensor_gives_is_a_lost_sample_of_its_channel_alone(
    site: Configuration, record: np.ndarray, cut: Cut, stands: float
) -> None:
    """As loggers write in the place of a reading: it had been taken for strong motion of all floors."""
    absurd, lost = record.copy(), record.copy()
    places = [700, 2600, 3900]
    absurd[places, 1], lost[places, 1] = stands, np.nan
    found = push(Pipeline(site), cut(absurd, RATE))
    assert told(found) == told(push(Pipeline(site), cut(lost, RATE)))
    for window in windows(found):
        assert window.skipped is None
        assert [(gone.channel, gone.reason) for gone in window.left_out] == [("a2", "lost samples")]


def test_what_stands_in_place_of_lost_samples_reaches_no_other_channel(
    site: Configuration, record: np.ndarray, partly_lost: np.ndarray, cut: Cut
) -> None:
    """The windows without a2 are those of a recording whose a2 holds anything else there."""
    loud = partly_lost.copy()
    loud[: LOST.start, 1] += 30.0 * record.std() * np.random.default_rng(3).normal(size=LOST.start)
    one, other = (windows(push(Pipeline(site), cut(x, RATE))) for x in (partly_lost, loud))
    assert [to_json(window_line(r)) for r in one[1:]] == [to_json(window_line(r)) for r in other[1:]]


@given(sizes=st.lists(st.integers(20, 1500), min_size=1, max_size=5), files=st.integers(1, 4), order=st.randoms())
@settings(deadline=None, max_examples=10)
def test_files_split_anywhere_and_named_in_any_order_give_the_same_bits(
    site: Configuration, record: np.ndarray, cut: Cut, whole: Told, sizes: list[int], files: int, order: object
) -> None:
    blocks = cut(record, RATE, sizes)
    with TemporaryDirectory() as folder:
        paths = [Path(folder) / f"{number}.mcap" for number in range(files)]
        for path, part in zip(paths, np.array_split(np.arange(len(blocks)), files), strict=True):
            with McapWriter(path) as writer:
                for k in part:
                    writer.write(blocks[k])
        paths = [p for p, part in zip(paths, np.array_split(np.arange(len(blocks)), files), strict=True) if part.size]
        order.shuffle(paths)  # type: ignore[attr-defined]
        assert told(push(Pipeline(site), list(read_recordings(paths)))) == whole


def test_files_may_overlap_and_repeat(
    site: Configuration, record: np.ndarray, cut: Cut, whole: Told, tmp_path: Path
) -> None:
    blocks = cut(record, RATE, [77])
    for name, part in (("a", blocks[:40]), ("b", blocks[25:60]), ("c", blocks[55:])):
        write_blocks(tmp_path / f"{name}.mcap", part)
    paths = [tmp_path / f"{name}.mcap" for name in "cabb"]
    pipeline = Pipeline(site)
    assert told(push(pipeline, list(read_recordings(paths)))) == whole
    assert pipeline.state.align.dropped == (15 + 5 + 35) * 77


@given(sizes=st.lists(st.integers(1, 1500), min_size=1, max_size=6))
@settings(deadline=None, max_examples=8)
def test_a_gap_is_the_same_gap_in_any_block_sizes(
    site: Configuration, record: np.ndarray, cut: Cut, sizes: list[int]
) -> None:
    one = told(push(Pipeline(site), with_hole(record, cut, [5000])))
    assert told(push(Pipeline(site), with_hole(record, cut, sizes))) == one
    assert len(one[2]) == 1


def test_events_and_skipped_windows_come_in_the_order_of_the_data_in_any_block_sizes(cut: Cut) -> None:
    """A gap at 20 s, a quake from 30 to 50 s, and windows of 60 s, or of 20 s of which one ends in the gap."""
    floors = short_quake.shaken().floors

    def order(size: int, window_s: float = 60.0, hop_s: float = 5.0, gap: int = 4000) -> list[str]:
        tables = {"processing": {"window_s": window_s, "hop_s": hop_s}, "events": {"merge_s": 5.0, "post_s": 5.0}}
        config = shaken.configuration(**tables)
        blocks = cut(floors[:gap], shaken.RATE, [size]) + cut(floors[4100:], shaken.RATE, [size], first=4100)
        told = [r for r in push(Pipeline(config), blocks) if isinstance(r, Event | WindowResult)]
        return [f"window {r.index}" if isinstance(r, WindowResult) else "event" for r in told]

    assert order(len(floors)) == order(50) == ["event", "event", *(f"window {k}" for k in range(4))]
    short = order(len(floors), 20.0, 20.0, 3900)
    assert short == order(50, 20.0, 20.0, 3900) and short[0] == "window 0" and short.count("event") == 2


def test_windows_around_a_gap_are_skipped_with_their_data_length(
    site: Configuration, record: np.ndarray, cut: Cut
) -> None:
    """131 samples are lost at 23.4 s: what touches them is skipped, what follows lies on the same grid."""
    long = np.concatenate([record, record])
    results = push(Pipeline(site), with_hole(long, cut, [200]))
    (gap,) = [r for r in results if isinstance(r, Gap)]
    assert gap.t_ns == T0_NS + round(HOLE.start / RATE * 1e9)
    assert gap.duration_s == pytest.approx(131 / RATE)
    found = windows(results)
    assert [r.t_end_ns for r in found] == [T0_NS + (20 + 5 * k) * 10**9 for k in range(13)]
    for r in found:
        begin_s, end_s = 5.0 * r.index, 5.0 * r.index + 20.0
        if end_s <= HOLE.start / RATE or begin_s >= HOLE.stop / RATE:
            assert r.skipped is None and r.window_s == 20.0
        else:
            assert r.skipped is not None and "gap" in r.skipped.reason
            assert r.window_s == pytest.approx(20.0 - 131 / RATE, abs=0.03)
            assert r.modes is None and r.damage is None


def test_instants_at_which_no_channel_is_finite_are_a_gap_like_lost_ones(
    site: Configuration, record: np.ndarray, cut: Cut
) -> None:
    spoilt = record.copy()
    spoilt[HOLE] = np.inf
    pipeline = Pipeline(site)
    spoilt_results = told(push(pipeline, cut(spoilt, RATE, [500])))
    assert spoilt_results == told(push(Pipeline(site), with_hole(record, cut, [500])))
    assert pipeline.state.align.dropped == 131


@pytest.mark.parametrize("gap", [False, True])
@given(at=st.integers(0, 60))
@settings(deadline=None, max_examples=8)
def test_a_copied_state_goes_on_as_the_original(
    site: Configuration, record: np.ndarray, cut: Cut, gap: bool, at: int
) -> None:
    blocks = with_hole(record, cut, [90]) if gap else cut(record, RATE, [90])
    original = Pipeline(site)
    before = push(original, blocks[:at])
    kept = copy.deepcopy(original)
    restored = Pipeline(site)
    restored.state = copy.deepcopy(original.state)
    rest = told(push(original, blocks[at:]))
    assert told(push(kept, blocks[at:])) == rest
    assert told(push(restored, blocks[at:])) == rest
    assert told(before)[0] + rest[0] == told(push(Pipeline(site), blocks))[0]


def test_other_topics_change_nothing(site: Configuration, record: np.ndarray, cut: Cut, whole: Told) -> None:
    blocks = [b for block in cut(record, RATE) for b in (replace(block, topic=GROUND), block)]
    assert told(push(Pipeline(site), blocks)) == whole


def test_permuted_and_extra_channels_give_the_same_bits(
    site: Configuration, record: np.ndarray, cut: Cut, whole: Told
) -> None:
    wide = np.column_stack([record[:, 2], np.full(len(record), np.nan), record[:, 0], record[:, 1]])
    assert told(push(Pipeline(site), cut(wide, RATE, channels=("a3", "x", "a1", "a2")))) == whole


def test_a_missing_channel_is_bad_input(site: Configuration, record: np.ndarray, cut: Cut) -> None:
    with pytest.raises(BadInputError, match="a3"):
        Pipeline(site).push(cut(record[:, :2], RATE, channels=("a1", "a2"))[0])


def test_a_changed_rate_starts_over_on_the_same_grid(site: Configuration, record: np.ndarray, cut: Cut) -> None:
    pipeline = Pipeline(site)
    push(pipeline, cut(record, RATE))
    later = T0_NS + 42 * 10**9
    results = push(pipeline, cut(record, 200.0, t0_ns=later))
    assert sum(isinstance(r, Gap) for r in results) == 1
    assert windows(results)[-1].t_end_ns <= later + round(len(record) / 200.0 * 1e9)
    slow = simulate(site.model(), duration_s=60.0, rate_hz=50.0, noise=0.03, seed=7).floors
    results = windows(push(pipeline, cut(slow, 50.0, t0_ns=later + 60 * 10**9)))
    assert all((r.t_end_ns - T0_NS) % (5 * 10**9) == 0 for r in results)
    good = [r for r in results if r.skipped is None]
    assert len(good) >= 7  # 102 s to 162 s: windows that end at 125, 130, .. 160 s
    assert good[0].t_end_ns == T0_NS + 125 * 10**9
    np.testing.assert_allclose(good[0].modes.frequencies_hz[:2], site.model().modes().frequencies_hz[:2], rtol=0.02)


def test_data_before_a_change_of_the_rate_count_by_their_length(
    site: Configuration, record: np.ndarray, cut: Cut
) -> None:
    pipeline = Pipeline(site)
    push(pipeline, cut(record[: 42 * 50], 50.0))
    across = windows(push(pipeline, cut(record, RATE, t0_ns=T0_NS + 42 * 10**9)))[:4]
    assert [r.t_end_ns - T0_NS for r in across] == [k * 10**9 for k in (45, 50, 55, 60)]
    assert [r.window_s for r in across] == pytest.approx([20.0] * 4, abs=0.1)


def test_conditioned_samples_follow_each_other_in_time(site: Configuration, record: np.ndarray, cut: Cut) -> None:
    parts = [r for r in push(Pipeline(site), cut(record, RATE)) if isinstance(r, Samples) and len(r.values)]
    ends = [p.t_ns + round(len(p.values) / p.rate_hz * 1e9) for p in parts]
    assert len(parts) > 10 and abs(parts[0].t_ns - T0_NS) < 1e9
    assert [p.t_ns for p in parts[1:]] == pytest.approx(ends[:-1], abs=2, rel=0)


def test_a_rate_too_slow_for_the_windows_is_refused_as_if_it_had_never_come(
    site: Configuration, record: np.ndarray, cut: Cut, whole: Told
) -> None:
    pipeline, results = Pipeline(site), []
    for k, block in enumerate(cut(record, RATE)):
        if k == 30:
            with pytest.raises(BadInputError, match="hop_s"):
                pipeline.push(replace(block, sample_rate_hz=2.0))
        results += pipeline.push(block)
    assert told(results) == whole


@pytest.mark.parametrize("rate", [99.9, 95.37, 62.5])
def test_a_source_slower_than_wanted_keeps_the_contracts_windows(site: Configuration, cut: Cut, rate: float) -> None:
    """Window k covers [t0 + k hop_s, ...), at whatever rate below the wanted one the source runs."""
    motion = simulate(site.model(), duration_s=41.0, rate_hz=rate, noise=0.03, seed=7)
    results = windows(push(Pipeline(site), cut(motion.floors, rate)))
    assert len(results) == 5
    for k, r in enumerate(results):
        assert r.t_end_ns == pytest.approx(T0_NS + (20 + 5 * k) * 10**9, abs=1e9 / rate)
        assert r.window_s == pytest.approx(20.0, abs=1.0 / rate)
    assert any(r.skipped is None for r in results)


def test_a_hop_too_short_for_a_slow_source_is_told_as_such(frame_text: str, cut: Cut) -> None:
    """0.2 s hold 2 block_rows samples at 100 Hz, but not at 50 Hz."""
    site = settings_of(frame_text.replace("hop_s = 5.0", "hop_s = 0.2"))
    slow = simulate(site.model(), duration_s=30.0, rate_hz=50.0, noise=0.03, seed=8).floors
    with pytest.raises(UserError, match="hop_s"):
        push(Pipeline(site), cut(slow, 50.0))


def test_without_a_baseline_nothing_is_ever_announced(site: Configuration, record: np.ndarray, cut: Cut) -> None:
    drawn = site.model_copy(update={"structure": site.structure.model_copy(update={"masses_kg": (0.25, 0.25, 0.25)})})
    results = windows(push(Pipeline(drawn), cut(record, RATE)))
    assert any(r.damage is not None and np.abs(r.damage.ddi).max() > 0.1 for r in results)
    assert {r.alarm.level.value for r in results} == {"normal"}


def test_the_reason_of_an_alarm_names_its_story(
    site: Configuration, record: np.ndarray, cut: Cut, monkeypatch: pytest.MonkeyPatch
) -> None:
    named = site.structure.model_copy(update={"story_names": ("roof", "middle", "foot")})
    shelved = results.alarm(reason="story 2 shelved: painters")
    monkeypatch.setattr(alarm, "hold", lambda state, t_ns, parts: (state, shelved))
    found = windows(push(Pipeline(site.model_copy(update={"structure": named})), cut(np.zeros_like(record), RATE)))
    assert found
    assert {r.alarm.reason for r in found} == {"story 2 (middle) shelved: painters"}


def directions(stiffness: np.ndarray) -> Configuration:
    structure = two_directions(stiffness).structure
    table = {
        "kind": "matrices",
        "mass_matrix": structure.mass_matrix().tolist(),
        "stiffness_matrix": structure.stiffness_matrix().tolist(),
        "stiffness_derivatives": structure.stiffness_derivatives().tolist(),
        "stiffness_n_per_m": stiffness.tolist(),
    }
    return configured(table, (1, 2, 3, 4), processing={"window_s": 60.0, "hop_s": 20.0})


@pytest.mark.parametrize("loss", [0.06, 0.10, 0.20])
def test_damage_that_brings_modes_into_another_order_is_judged(loss: float) -> None:
    """Two directions at 5.0 and 5.2 Hz: from 8 % in the stiffer one the lower mode is the other."""
    site = directions(HEALTHY)
    healthy = learned(site, site.model(), 1, 200.0)
    damaged = two_directions(HEALTHY * [1.0, 1.0, 1.0 - loss, 1.0 - loss])
    results = results_of(damaged, site, healthy, 2, 200.0)
    judged = [r for r in results if r.skipped is None]
    assert len(judged) >= len(results) - 2
    for r in judged:
        np.testing.assert_allclose(r.damage.ddi, [0.0, 0.0, loss, loss], atol=0.035)
        assert r.modes.model_mode.tolist() == [0, 1, 2, 3]
        assert (r.modes.frequencies_hz[0] > r.modes.frequencies_hz[1]) == (loss > 0.08)
    assert results[-1].alarm.stories and set(results[-1].alarm.stories) <= {3, 4}


@pytest.mark.parametrize("apart", [1.01, 1.001])
def test_a_close_pair_ends_without_a_traceback(apart: float) -> None:
    """Windows may be skipped, and a baseline may have the pair in another order than the drawing; nothing is announced."""
    site = directions(np.array([775.0, 775.0, 775.0 * apart**2, 775.0 * apart**2]))
    healthy = learned(site, site.model(), 1, 300.0)
    results = results_of(site.model(), site, healthy, 2, 300.0)
    judged = [r for r in results if r.skipped is None]
    assert judged
    assert all(r.damage is not None and np.abs(r.damage.ddi).max() < 0.05 for r in judged)
    assert {r.alarm.level.value for r in results} == {"normal"}


def test_modes_that_the_model_cannot_show_give_no_baseline() -> None:
    """Of a mode along one axis, the channel of the other is the gauge."""
    one = np.eye(2)
    table = {
        "kind": "matrices",
        "mass_matrix": one.tolist(),
        "stiffness_matrix": (1000.0 * one).tolist(),
        "stiffness_derivatives": [np.diag([1.0, 0.0]).tolist(), np.diag([0.0, 1.0]).tolist()],
        "stiffness_n_per_m": [1000.0, 1000.0],
    }
    deviations = 1e-3 * np.ones((4, 1, 6)) * np.array([1.0, -1.0, 1.0, -1.0])[:, None, None]
    modes = modal_estimate([5.0], [[0.9, 1.0]], deviations=deviations)
    config = configured(table, (1, 2))
    with pytest.raises(BadInputError, match="cannot be updated"):
        baseline_of(config, [modes])


STEEL = ShearFrame(np.full(5, 1000.0), np.full(5, 7.4e5), 0.005)
"""Drawing of a planar frame: modes at 1.23, 3.60, 5.67, 7.28 and 8.31 Hz."""


def planar(floors: tuple[int, ...]) -> Configuration:
    processing = {"window_s": 150.0, "hop_s": 30.0, "rate_hz": 50.0, "cutoff_hz": 15.0}
    return shear_frame(STEEL.masses_kg, STEEL.stiffness_n_per_m, floors, processing=processing)


def with_torsion(rotation: float) -> Model:
    """The frame with two rotations, of the floors 1 and 3, that its sensors off the axis see weakly; the lower at 6.7 Hz."""
    mass, stiffness = STEEL.mass_matrix(), STEEL.stiffness_matrix()
    twist = rotation * np.array([[1.0, -1.0], [-1.0, 2.0]])
    eccentric = np.zeros((5, 2))
    eccentric[0, 0] = eccentric[2, 1] = 0.02 * np.sqrt(stiffness[0, 0] * twist[0, 0])
    arm = 0.3 * np.array([[1.0, 0.0], [0.5, 0.5], [0.0, 1.0], [0.0, 0.6], [0.0, 0.2]])
    seen = np.block([[np.eye(5), -arm], [np.zeros((2, 5)), np.eye(2)]])
    k = seen.T @ np.block([[stiffness, eccentric], [eccentric.T, twist]]) @ seen
    m = seen.T @ np.block([[mass, np.zeros((5, 2))], [np.zeros((2, 5)), 1000.0 * np.eye(2)]]) @ seen
    return Model(MatrixStructure.create(m, k, k[None], np.ones(1), 0.005))


def by_modes(frequencies_hz: list[float], shapes: np.ndarray, site: Configuration, seed: int) -> list[WindowResult]:
    """Windows of a structure of such modes, with shapes by channel, shape (c, m)."""
    squares = np.diag((2.0 * np.pi * np.array(frequencies_hz)) ** 2)
    truth = Model(MatrixStructure.create(np.eye(len(squares)), squares, squares[None], np.ones(1), 0.005))
    motion = simulate(truth, duration_s=240.0, rate_hz=100.0, noise=0.0, seed=seed).floors @ shapes.T
    motion += 0.05 * motion.std() * np.random.default_rng(seed).standard_normal(motion.shape)
    blocks = cut_into_blocks(ACCELERATION, motion, site.channels, 100.0, 10**18, 1000)
    return windows(push(Pipeline(site), blocks))


TWIST = 0.25 * np.array([1.0, 0.95, 0.75, 0.5, 0.2])
"""Shape of a torsion mode on the five floors."""


def test_a_torsion_mode_stands_beside_the_planar_model_s_modes() -> None:
    site, truth = planar((1, 2, 3, 4, 5)), with_torsion(4.65e6)
    motion = simulate(truth, duration_s=240.0, rate_hz=100.0, noise=0.05, seed=1).floors[:, :5]
    found = windows(push(Pipeline(site), cut_into_blocks(ACCELERATION, motion, site.channels, 100.0, 10**18, 1000)))
    assert len(found) == 4
    sway = truth.modes().frequencies_hz
    torsion = sway[np.abs(sway - 6.7).argmin()]
    for window in found:
        assert window.skipped is None and window.modes is not None and window.stiffness is not None
        assert window.modes.model_mode.tolist() == [0, 1, 2, 3, 4]
        np.testing.assert_allclose(window.modes.frequencies_hz, np.delete(sway[:6], sway[:6] == torsion), rtol=0.01)
        (other,) = [mode for mode in window.modes.others if mode.frequency_std_hz < 0.05]
        assert abs(other.frequency_hz - torsion) < 4.0 * other.frequency_std_hz
        line = window_line(window)
        assert line["model_modes"] == [1, 2, 3, 4, 5] and len(line["mode_tracks"]) == 5
        assert torsion == pytest.approx(line["other_modes"][0]["frequency_hz"], rel=0.01)


def test_a_mode_of_another_shape_is_not_taken_for_the_nearest_of_the_model() -> None:
    """In place of mode 3 (5.67 Hz) there is torsion at 5.3 Hz: no window is lost, and the reason says why mode 3 is missing."""
    site = planar((1, 2, 3, 4, 5))
    shapes = site.model().modes().shapes / np.abs(site.model().modes().shapes).max(axis=0)
    shapes[:, 2] = TWIST
    found = by_modes([1.2305, 3.6, 5.3, 7.3, 8.35], shapes, site, 1)
    assert len(found) == 4
    for window in found:
        assert window.skipped is None and window.modes is not None and window.stiffness is not None
        assert window.modes.model_mode.tolist() == [0, 1, 3, 4]
        np.testing.assert_allclose(window.stiffness.stiffness_n_per_m, STEEL.stiffness_n_per_m, rtol=0.03)
        ((mode, why),) = window.modes.missing
        assert mode == 2 and "mode 3 (5.67 Hz by the model)" in why and "5.3" in why and "torsion?" in why
    healthy = baseline_of(site, found)
    assert healthy.model_mode == (0, 1, 3, 4)


def test_a_baseline_keeps_what_half_of_its_windows_show_of_the_lowest_modes_and_nine_in_ten_of_the_others() -> None:
    def window(*model_modes: int) -> WindowResult:
        n, numbers = len(model_modes), np.array(model_modes)
        modes = modal_estimate(1.0 + numbers, np.ones((n, 1)), model_mode=numbers, deviations=np.ones((2, n, 4)))
        return window_result(modes=modes)

    healthy = [window(0, 1, 3), window(0, 1, 3), window(0, 3), window(0, 1, 2)]
    kept = calibrate.with_common_modes(healthy, required=2)
    assert [w.modes.model_mode.tolist() for w in kept if w.modes is not None] == [[0, 1]] * 3
    seldom = calibrate.with_common_modes([window(0, 1), window(0), window(0)], required=2)
    assert [w.modes.model_mode.tolist() for w in seldom if w.modes is not None] == [[0]] * 3


def with_torsion_for_mode_3(site: Configuration) -> tuple[Baseline, np.ndarray]:
    """Baseline of a frame of five floors, and its motion at them when it has torsion in the place of mode 3."""
    drawn = site.model().modes()
    shapes = drawn.shapes / np.abs(drawn.shapes).max(axis=0)
    healthy = baseline_of(site, by_modes(drawn.frequencies_hz.tolist(), shapes, site, 2))
    without = shapes.copy()
    without[:, 2] = TWIST
    squares = np.diag((2.0 * np.pi * np.array([*drawn.frequencies_hz[:2], 5.3, *drawn.frequencies_hz[3:]])) ** 2)
    truth = Model(MatrixStructure.create(np.eye(5), squares, squares[None], np.ones(1), 0.005))
    return healthy, simulate(truth, duration_s=190.0, rate_hz=100.0, noise=0.01, seed=3).floors @ without.T


def test_where_a_channel_is_left_out_a_missing_mode_is_told_in_a_line_without_advice_on_the_settings() -> None:
    """Without the channels of floors 1 to 4 no mode's shape is told, and neither a setting nor a calibration mends that."""
    site = planar((1, 2, 3, 4, 5))
    healthy, values = with_torsion_for_mode_3(site)
    values[:, 4] = 0.0
    for window in windows(
        push(Pipeline(site, healthy), cut_into_blocks(ACCELERATION, values, site.channels, 100.0, 10**18, 1000))
    ):
        assert window.skipped is not None
        assert window.skipped.reason == "the channels in use do not show mode 3; left out: a5"


def test_where_updating_fails_the_mode_that_the_model_cannot_follow_is_set_aside() -> None:
    """One sensor tells no shapes: torsion at 6.68 Hz is taken for mode 3, and no shear frame has these five frequencies."""
    site = planar((1,))
    top = np.array([[1.0, 1.0, 0.7, 0.6, 0.4]])
    found = by_modes([1.2305, 4.0154, 6.68, 7.6128, 9.661], top, site, 1)
    for window in found:
        assert window.skipped is None and window.modes is not None
        assert window.modes.model_mode.tolist() == [0, 1, 3, 4]
        assert min(abs(mode.frequency_hz - 6.68) for mode in window.modes.others) < 0.05
        assert "did not converge with mode 3 (5.67 Hz by the model, 6.6" in window.modes.missing[0][1]


def test_what_is_estimated_does_not_depend_on_the_level_of_motion(
    site: Configuration, record: np.ndarray, cut: Cut
) -> None:
    """At a thousandth of the motion, noise included: as of a building by the wind, not of a model on a table."""
    strong, weak = (windows(push(Pipeline(site), cut(level * record, 128.0))) for level in (1.0, 1e-3))
    assert len(strong) == len(weak) > 0
    for one, other in zip(strong, weak, strict=True):
        np.testing.assert_allclose(other.modes.frequencies_hz, one.modes.frequencies_hz, rtol=1e-6)
        np.testing.assert_allclose(other.stiffness.stiffness_n_per_m, one.stiffness.stiffness_n_per_m, rtol=1e-5)
        assert other.rms_m_s2 == pytest.approx(1e-3 * one.rms_m_s2, rel=1e-4)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_modes_at_one_multiple_of_the_model_s_frequencies_raise_the_question_of_the_rate(factor: float) -> None:
    site = planar((1, 2, 3, 4, 5))
    drawn = site.model().modes()
    shapes = drawn.shapes / np.abs(drawn.shapes).max(axis=0)
    found = by_modes((factor * drawn.frequencies_hz).tolist(), shapes, site, 1)
    assert len(found) == 4
    for window in found:
        assert f"lie at {factor:g} times the frequencies by the model: are the sampling rate" in window.skipped.reason
    for window in by_modes((factor * drawn.frequencies_hz).tolist(), shapes[:, [1, 2, 0, 4, 3]], site, 1):
        assert window.skipped is None or "times the frequencies" not in window.skipped.reason


def test_floors_and_signs_are_asked_for_only_where_a_turned_channel_gives_the_missing_modes() -> None:
    site = planar((1, 2, 3, 4, 5))
    drawn = site.model().modes()
    shapes = drawn.shapes / np.abs(drawn.shapes).max(axis=0)
    turned = by_modes(drawn.frequencies_hz.tolist(), np.array([[-1.0], [1.0], [1.0], [1.0], [1.0]]) * shapes, site, 1)
    assert len(turned) == 4
    for window in turned:
        assert window.skipped is not None and "check floors and signs" in window.skipped.reason
    for window in by_modes((1.6 * drawn.frequencies_hz[1:4]).tolist(), shapes[:, [3, 4, 2]], site, 1):
        assert window.skipped is not None and "floors and signs" not in window.skipped.reason


def test_a_mode_of_the_baseline_that_is_missing_is_named_and_its_window_keeps_its_modes() -> None:
    """Mode 3 of the healthy frame is gone, torsion is there: that may be the damage, so it is not judged, but nothing is lost."""
    site = planar((1, 2, 3, 4, 5))
    drawn = site.model().modes()
    healthy, values = with_torsion_for_mode_3(site)
    summary = Summary()
    for required, words in ((4, "set [selection] required_modes = 2"), (2, None)):
        settings = site.model_copy(update={"selection": SelectionSettings(required_modes=required)})
        blocks = cut_into_blocks(ACCELERATION, values, site.channels, 100.0, 10**18, 1000)
        for window in windows(push(Pipeline(settings, healthy), blocks)):
            assert window.modes is not None and window.modes.model_mode.tolist() == [0, 1, 3, 4]
            assert len(window.mode_tracks) == 4 + len(window.modes.others)
            assert (window.skipped is None) == (words is None)
            if window.skipped is not None:
                assert words is not None and words in window.skipped.reason
                assert "mode 3 (5.67 Hz by the model)" in window.skipped.reason
                summary.window(window, facts_of_line(window_line(window)), Known((), True, 0.1, 5.0))
    content = summary.content(1.0, drawn.frequencies_hz.tolist())
    assert content["skipped"] == content["windows"] == 2
    assert content["model_modes"] == [1, 2, 4, 5]
    np.testing.assert_allclose(content["frequencies_hz"], drawn.frequencies_hz[[0, 1, 3, 4]], rtol=0.01)
    assert content["other_modes"][0]["frequency_hz"] == pytest.approx(5.3, rel=0.01)
