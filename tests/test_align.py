"""Blocks in any disorder to one run of samples, with every loss counted."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.base import ACCELERATION, SampleBlock
from monitor import align
from monitor.align import AlignState, Piece
from monitor.errors import BadInputError

T0 = 1_767_225_600_000_000_000
RATE = 100.0
CHANNELS = ("a1", "a2")
VALUES = np.random.default_rng(3).normal(size=(1000, 2)).astype(np.float32)


def block(begin: int, end: int, **changes: object) -> SampleBlock:
    """Samples [begin, end) of the record at their times."""
    t_ns = T0 + begin * 10_000_000
    return replace(SampleBlock(ACCELERATION, t_ns, begin, RATE, CHANNELS, "m/s^2", VALUES[begin:end]), **changes)


def feed(*blocks: SampleBlock, channels: tuple[str, ...] = CHANNELS) -> tuple[AlignState, list[Piece]]:
    state = align.start()
    pieces: list[Piece] = []
    for item in blocks:
        state, new = align.step(state, item, channels)
        pieces += new
    return state, pieces


def joined(pieces: list[Piece]) -> np.ndarray:
    return np.concatenate([p.values for p in pieces])


def assert_record(pieces: list[Piece], *runs: tuple[int, int]) -> None:
    """The pieces are the record's samples of `runs`, with a gap before each but the first."""
    gaps = [p for p in pieces if p.gap is not None]
    assert len(gaps) == len(runs) - 1
    np.testing.assert_array_equal(joined(pieces), np.concatenate([VALUES[a:b] for a, b in runs]))
    for piece, (_, before), (begin, _) in zip(gaps, runs[:-1], runs[1:], strict=True):
        assert piece.gap is not None
        assert piece.t_ns == T0 + begin * 10_000_000
        assert piece.gap.t_ns == T0 + before * 10_000_000
        assert piece.gap.duration_s == pytest.approx((begin - before) / RATE)


def dropped(state: AlignState) -> int:
    return state.dropped


def test_blocks_in_order_pass_as_they_are() -> None:
    state, pieces = feed(block(0, 100), block(100, 130), block(130, 300))
    assert_record(pieces, (0, 300))
    assert [p.t_ns for p in pieces] == [T0, T0 + 10**9, T0 + 13 * 10**8]
    assert all(p.values.dtype == np.float64 for p in pieces)
    assert dropped(state) == 0


def test_a_repeated_block_is_dropped_and_counted() -> None:
    state, pieces = feed(block(0, 100), block(100, 200), block(100, 200), block(0, 100), block(200, 300))
    assert_record(pieces, (0, 300))
    assert dropped(state) == 200


def test_of_an_overlapping_block_only_the_new_part_counts() -> None:
    state, pieces = feed(block(0, 100), block(40, 160), block(160, 200))
    assert_record(pieces, (0, 200))
    assert dropped(state) == 60


def test_a_late_block_is_dropped_and_its_place_stays_a_gap() -> None:
    state, pieces = feed(block(0, 100), block(200, 300), block(100, 200), block(300, 400))
    assert_record(pieces, (0, 100), (200, 400))
    assert dropped(state) == 100


def test_lost_blocks_are_a_gap_that_says_how_many_samples() -> None:
    state, pieces = feed(block(0, 100), block(250, 300), block(300, 310))
    assert_record(pieces, (0, 100), (250, 310))
    assert pieces[1].gap is not None
    assert "150 samples" in pieces[1].gap.reason
    assert dropped(state) == 0


def test_one_lost_sample_is_a_gap() -> None:
    assert_record(feed(block(0, 100), block(101, 200))[1], (0, 100), (101, 200))


def test_a_sequence_that_restarts_with_the_next_file_goes_on_where_time_does() -> None:
    _, pieces = feed(block(0, 500), block(500, 600, sequence=0), block(600, 700, sequence=100))
    assert_record(pieces, (0, 700))


def test_a_sequence_that_restarts_later_is_a_gap_of_the_time_between() -> None:
    _, pieces = feed(block(0, 500), block(700, 800, sequence=0), block(800, 900, sequence=100))
    assert_record(pieces, (0, 500), (700, 900))


def test_a_jitter_of_the_blocks_times_is_no_gap_while_the_sequence_goes_on() -> None:
    rng = np.random.default_rng(4)
    blocks = [block(k, k + 50) for k in range(0, 1000, 50)]
    _, pieces = feed(*(replace(b, t_ns=b.t_ns + int(rng.integers(-200_000_000, 200_000_000))) for b in blocks[1:]))
    assert all(p.gap is None for p in pieces)
    np.testing.assert_array_equal(joined(pieces), VALUES[50:])


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_rows_that_are_not_finite_are_dropped_counted_and_leave_a_gap(bad: float) -> None:
    spoilt = VALUES[:200].copy()
    spoilt[60:75, 1] = bad
    state, pieces = feed(block(0, 200, samples=spoilt), block(200, 300))
    assert_record(pieces, (0, 60), (75, 300))
    assert dropped(state) == 15
    assert np.isfinite(joined(pieces)).all()


def test_bad_rows_at_a_blocks_edges_leave_one_gap() -> None:
    spoilt = VALUES.copy()
    spoilt[90:110] = np.nan
    state, pieces = feed(block(0, 100, samples=spoilt[:100]), block(100, 200, samples=spoilt[100:200]))
    assert_record(pieces, (0, 90), (110, 200))
    assert dropped(state) == 20


def test_bad_rows_before_the_first_good_one_are_counted_too() -> None:
    spoilt = VALUES[:100].copy()
    spoilt[:30] = np.nan
    state, pieces = feed(block(0, 100, samples=spoilt))
    np.testing.assert_array_equal(joined(pieces), VALUES[30:100])
    assert pieces[0].t_ns == T0 + 300_000_000
    assert dropped(state) == 30


def test_nothing_finite_is_no_run() -> None:
    _, pieces = feed(block(0, 100, samples=np.full((100, 2), np.nan, dtype=np.float32)))
    assert pieces == []


def test_a_change_of_rate_begins_a_new_run() -> None:
    state, pieces = feed(block(0, 100), block(100, 200, sample_rate_hz=200.0), block(200, 250, sample_rate_hz=200.0))
    assert [p.gap is not None for p in pieces] == [False, True, False] or len(pieces) == 2
    assert pieces[1].gap is not None and "rate" in pieces[1].gap.reason
    assert pieces[1].rate_hz == 200.0
    assert state is not None and state.rate_hz == 200.0


def test_empty_blocks_change_nothing() -> None:
    state, pieces = feed(block(0, 100), block(100, 100), block(100, 200))
    assert_record(pieces, (0, 200))
    assert dropped(state) == 0
    assert align.step(None, block(5, 5), CHANNELS) == (None, [])


def test_channels_are_found_by_name_and_others_ignored() -> None:
    wide = np.column_stack([np.full(100, 9.0), VALUES[:100, 1], np.full(100, np.nan), VALUES[:100, 0]])
    mixed = block(0, 100, channels=("x", "a2", "battery", "a1"), samples=wide.astype(np.float32))
    state, pieces = feed(mixed, block(100, 200))
    assert_record(pieces, (0, 200))
    assert dropped(state) == 0


def test_a_missing_channel_is_bad_input_that_names_it_and_what_there_is() -> None:
    with pytest.raises(BadInputError, match=r"a3, a4 .*a1, a2"):
        feed(block(0, 100), channels=("a1", "a3", "a4"))


def test_another_unit_is_bad_input() -> None:
    with pytest.raises(BadInputError, match=r"degC.*m/s\^2"):
        feed(block(0, 100, unit="degC"))


@given(
    edges=st.sets(st.integers(1, 999), max_size=12),
    lost=st.sets(st.integers(0, 12), max_size=3),
    again=st.lists(st.tuples(st.integers(0, 12), st.integers(0, 4)), max_size=4),
)
@settings(deadline=None, max_examples=150)
def test_whatever_is_lost_or_repeated_each_sample_comes_once_at_its_time(
    edges: set[int], lost: set[int], again: list[tuple[int, int]]
) -> None:
    """Every sample that comes in time is passed once, at its own time; the rest is dropped and counted."""
    cuts = [0, *sorted(edges), 1000]
    parts = [(a, b) for i, (a, b) in enumerate(pairwise(cuts)) if i not in lost]
    if not parts:
        return
    order = list(parts)
    for which, later in again:  # repeats, some blocks after the original
        part = parts[which % len(parts)]
        order.insert(min(order.index(part) + 1 + later, len(order)), part)
    state, pieces = feed(*(block(a, b) for a, b in order))
    times = np.concatenate([p.t_ns + np.arange(len(p.values)) * 10_000_000 for p in pieces])
    expected = np.concatenate([np.arange(a, b) for a, b in parts])
    np.testing.assert_array_equal(times, T0 + expected * 10_000_000)
    np.testing.assert_array_equal(joined(pieces), VALUES[expected])
    assert dropped(state) == sum(b - a for a, b in order) - len(expected)
    assert sum(p.gap is not None for p in pieces) == np.count_nonzero(np.diff(expected) > 1)


@pytest.mark.parametrize("true_rate", [100.01, 99.99])
def test_a_sensor_clock_a_little_off_loses_no_sample_in_a_day_or_says_so(true_rate: float) -> None:
    """100 parts in a million: by sequence nothing is missing, so nothing may be cut out without a gap."""
    zeros = np.zeros((6000, 2), dtype=np.float32)
    state = align.start()
    silent, before = 0, 0
    for minute in range(1440):
        first = 6000 * minute
        item = SampleBlock(ACCELERATION, T0 + round(first / true_rate * 1e9), first, 100.0, CHANNELS, "m/s^2", zeros)
        state, pieces = align.step(state, item, CHANNELS)
        cut_out = state.dropped > before
        silent += cut_out and all(p.gap is None for p in pieces)
        before = state.dropped
    assert silent == 0


def test_a_clock_set_back_while_the_sequence_goes_on_is_told_as_a_gap() -> None:
    """A time server sets the clock back 5 s: the samples of these seconds may be lost, but not in silence."""
    later = [block(k, k + 100, t_ns=T0 + k * 10_000_000 - 5 * 10**9) for k in range(200, 1000, 100)]
    _, pieces = feed(block(0, 100), block(100, 200), *later)
    passed = joined(pieces)
    whole = len(passed) == 1000 and np.array_equal(passed, VALUES)
    assert whole or any(p.gap is not None for p in pieces)
