"""Counters and timestamps to indices and UTC."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from drivers import clock
from drivers.clock import ClockState, Timeline
from drivers.counter import REORDER, Sequencer

RATE = 1024.0
T0 = 1_767_225_600.0


def run(index: np.ndarray, t_s: np.ndarray, sizes: tuple[int, ...] = (128,)) -> tuple[ClockState, Timeline]:
    state, line = ClockState(), Timeline(int(index[0]), round(t_s[0] * 1e6) * 1000, RATE)
    start, turn = 0, 0
    while start < len(index):
        part = slice(start, start + sizes[turn % len(sizes)])
        state, kept = clock.step(state, line, index[part], t_s[part], RATE)
        assert kept is not None
        start, turn, line = part.stop, turn + 1, kept
    return state, line


def arrivals(seconds: float, ppm: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A node that samples `ppm` too fast, its frames up to some ms late."""
    index = np.arange(round(seconds * RATE))
    delay = np.random.default_rng(seed).exponential(1.5e-3, len(index)) + 2e-4
    return index, T0 + index / RATE / (1 + ppm * 1e-6) + delay


@pytest.mark.parametrize("ppm", [-100.0, 0.0, 35.0])
def test_drift_is_found_with_its_uncertainty(ppm: float) -> None:
    misses = []
    for seed in range(5):
        state, _ = run(*arrivals(120.0, ppm, seed))
        found = clock.fit(state, RATE)
        assert state.real_time and state.steps == 0
        assert found.drift_ppm == pytest.approx(ppm, abs=1.0)
        misses.append((found.drift_ppm - ppm) / found.drift_std_ppm)
    assert np.abs(misses).max() < 6.0


def test_a_jump_of_a_second_is_one_step_and_is_followed_without_a_leap() -> None:
    index, t_s = arrivals(60.0, 0.0, 1)
    t_s[30 * 1024 + 300 :] += 1.0
    state, line = run(index, t_s)
    assert state.steps == 1 and state.real_time
    times = np.array([line.at(int(i)) for i in range(0, len(index), 128)])
    assert (times[-1] - times[0]) * 1e-9 == pytest.approx(len(index) / RATE - 0.125 + 1.0, abs=0.01)
    assert np.abs(np.diff(times) * 1e-9 - 0.125).max() < 0.6


def test_a_slow_drift_moves_block_times_by_less_than_a_second_at_a_time() -> None:
    index, t_s = arrivals(400.0, -900.0, 2)  # 0.36 s in all
    state, line = run(index, t_s)
    assert state.steps == 0
    assert 0.2 < line.shift_ns * 1e-9 < 0.4
    assert len(line.shifts) == 1


def test_late_bursts_are_no_steps() -> None:
    index, t_s = arrivals(60.0, 0.0, 3)
    t_s[20 * 1024 : 20 * 1024 + 800] = t_s[20 * 1024 + 800]
    state, line = run(index, t_s)
    assert state.steps == 0 and not line.shifts


@pytest.mark.parametrize("speed", [0.01, 0.5, 100.0])
def test_a_stream_faster_or_slower_than_the_clock_keeps_the_time_of_its_count(speed: float) -> None:
    index, t_s = arrivals(60.0, 0.0, 4)
    state, line = run(index, T0 + (t_s - T0) / speed)
    assert not state.real_time and state.steps == 0 and not line.shifts


def test_a_stream_that_changes_its_pace_is_no_longer_real_time() -> None:
    index, t_s = arrivals(40.0, 0.0, 5)
    half = 20 * 1024
    t_s[half:] = t_s[half] + (t_s[half:] - t_s[half]) / 50.0
    state, _ = run(index, t_s)
    assert not state.real_time and state.steps == 0


@pytest.mark.parametrize("sizes", [(1,), (7, 300), (1024,)])
def test_times_do_not_depend_on_how_frames_are_batched(sizes: tuple[int, ...]) -> None:
    index, t_s = arrivals(20.0, 0.0, 6)
    t_s[8 * 1024 :] += 0.4
    whole = run(index, t_s)
    assert run(index, t_s, sizes) == whole and whole[1].shifts


def number(
    counters: np.ndarray, t_s: np.ndarray, sizes: tuple[int, ...], **options: int
) -> tuple[Sequencer, list[int]]:
    sequencer, out, start, turn = Sequencer(**{"bits": 16} | options), [], 0, 0
    while start < len(counters):
        part = slice(start, start + sizes[turn % len(sizes)])
        index, new = sequencer.number(counters[part], t_s[part], RATE, real_time=True)
        out += index[new].tolist()
        start, turn = part.stop, turn + 1
    sequencer.ended = True
    return sequencer, out


@settings(deadline=None, max_examples=50)
@given(
    seed=st.integers(0, 10**6),
    sizes=st.lists(st.integers(1, 200), min_size=1, max_size=4),
    bits=st.sampled_from([8, 16]),
)
def test_lost_repeated_and_swapped_frames_are_numbered_right(seed: int, sizes: list[int], bits: int) -> None:
    rng = np.random.default_rng(seed)
    truth = np.arange(700) + 65000
    order = truth[rng.random(700) > 0.01]
    order = np.insert(order, at := rng.integers(1, len(order), 7), order[at - 1])  # repeated
    place = np.arange(len(order)) + np.where(
        rng.random(len(order)) < 0.01, rng.integers(1, REORDER // 2, len(order)), 0
    )
    order = order[np.argsort(place, kind="stable")]
    first = order[0]
    counters = order % (1 << bits)
    sequencer, found = number(counters, T0 + order / RATE, tuple(sizes), bits=bits)
    base = first - counters[0]
    expected = np.unique(order[order >= first]) - base
    assert sorted(found) == expected.tolist()
    assert sequencer.lost == expected[-1] - expected[0] + 1 - len(expected)
    assert sequencer.repeated + sequencer.late == len(order) - len(expected)


@pytest.mark.parametrize("away", [40, 5000, 65536, 65535, 65538, 3 * 65536 + 40000])
def test_what_a_wrap_hides_is_told_by_time(away: int) -> None:
    index = np.concatenate((np.arange(2000), 2000 + away + np.arange(2000)))
    t_s = T0 + index / RATE + np.random.default_rng(0).exponential(3e-3, len(index))
    sequencer, found = number(index % 65536, t_s, (128,))
    # After so long, the first frame serves to confirm the jump; if the counter goes on unbroken, it was the time that jumped.
    if away == 65536:
        assert found == list(range(4000))
    else:
        assert found == [*range(2000), *range(2001 + away, 4000 + away)]
        assert sequencer.lost == away + 1
    assert sequencer.restarts == 0


@pytest.mark.parametrize("before", [3000, 40000])
def test_a_node_that_begins_anew_leaves_a_gap_of_the_length_that_time_tells(before: int) -> None:
    counters = np.concatenate((before - 2000 + np.arange(2000), np.arange(4000)))
    t_s = T0 + np.concatenate((np.arange(2000), 2000 + 3 * 1024 + np.arange(4000))) / RATE
    sequencer, found = number(counters, t_s, (100,))
    assert sequencer.restarts == 1
    assert np.all(np.diff(found) > 0)
    assert found[-1] - found[0] == 2000 + 3 * 1024 + 4000 - 1


def test_a_single_frame_with_a_wild_counter_is_left_out() -> None:
    counters = np.arange(1000)
    counters[500] = 30000
    sequencer, found = number(counters, T0 + np.arange(1000) / RATE, (64,))
    assert found == [*range(500), *range(501, 1000)]
    assert (sequencer.stray, sequencer.lost, sequencer.restarts) == (1, 1, 0)


def test_without_a_counter_silence_is_a_gap() -> None:
    index = np.concatenate((np.arange(2000), 5000 + np.arange(100)))
    sequencer, found = number(np.zeros(2100, np.int64), T0 + index / RATE, (128,), bits=0)
    assert found == index.tolist() and sequencer.lost == 3000


@settings(deadline=None)
@given(
    counters=st.lists(st.integers(0, 65535), min_size=1, max_size=200),
    times=st.lists(st.just(np.nan) | st.floats(min_value=0, max_value=4e9), min_size=1, max_size=200),
)
def test_nonsense_still_gives_rising_unique_indices(counters: list[int], times: list[float]) -> None:
    n = min(len(counters), len(times))
    sequencer, found = number(np.array(counters[:n]), np.array(times[:n]), (7,))
    assert len(set(found)) == len(found) and min(found, default=0) >= 0 and sequencer.lost >= 0


@pytest.mark.parametrize("slope", [-1.0, -1.5])
def test_times_that_stand_still_or_run_back_say_nothing_of_the_rate(slope: float) -> None:
    state = ClockState(seconds=tuple(range(9)), offsets=tuple(slope * k for k in range(9)))
    found = clock.fit(state, 128.0)
    assert found.drift_ppm == 0.0 and found.drift_std_ppm == np.inf
