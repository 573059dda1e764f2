"""Blocks in any disorder to one run of samples, with every loss counted."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from drivers.base import ACCELERATION, SampleBlock
from monitor.core import BadInputError
from monitor.signals import alignment
from monitor.signals.alignment import AlignState, Piece

T0 = 1_767_225_600_000_000_000
RATE = 100.0
CHANNELS = ("a1", "a2")
VALUES = np.random.default_rng(3).normal(size=(1000, 2)).astype(np.float32)


def block(begin: int, end: int, **changes: object) -> SampleBlock:
    """Samples [begin, end) of the record at their times."""
    t_ns = T0 + begin * 10_000_000
    return replace(SampleBlock(ACCELERATION, t_ns, begin, RATE, CHANNELS, "m/s^2", VALUES[begin:end]), **changes)


def feed(*blocks: SampleBlock, channels: tuple[str, ...] = CHANNELS) -> tuple[AlignState, list[Piece]]:
    state = alignment.start()
    pieces: list[Piece] = []
    for item in blocks:
        state, new = alignment.step(state, item, channels)
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
        assert piece.t_ns == T0 + begin * 10_000_000
        assert piece.gap.t_ns == T0 + before * 10_000_000
        assert piece.gap.duration_s == pytest.approx((begin - before) / RATE)


SPOILT = VALUES.copy()
SPOILT[90:110] = np.nan
WIDE = np.column_stack([np.full(100, 9.0), VALUES[:100, 1], np.full(100, np.nan), VALUES[:100, 0]]).astype(np.float32)


@pytest.mark.parametrize(
    ("blocks", "runs", "dropped"),
    [
        pytest.param([block(0, 100), block(100, 130), block(130, 300)], [(0, 300)], 0, id="in order"),
        pytest.param(
            [block(0, 100), block(100, 200), block(100, 200), block(0, 100), block(200, 300)], [(0, 300)], 200,
            id="a repeated block is dropped",
        ),
        pytest.param(
            [block(0, 100), block(40, 160), block(160, 200)], [(0, 200)], 60, id="of an overlap the new part counts"
        ),
        pytest.param(
            [block(0, 100), block(200, 300), block(100, 200), block(300, 400)], [(0, 100), (200, 400)], 100,
            id="the place of a late block stays a gap",
        ),
        pytest.param([block(0, 100), block(101, 200)], [(0, 100), (101, 200)], 0, id="one lost sample is a gap"),
        pytest.param(
            [block(0, 500), block(500, 600, sequence=0), block(600, 700, sequence=100)], [(0, 700)], 0,
            id="a sequence that restarts with the next file goes on where time does",
        ),
        pytest.param(
            [block(0, 500), block(700, 800, sequence=0), block(800, 900, sequence=100)], [(0, 500), (700, 900)], 0,
            id="a sequence that restarts later is a gap of the time between",
        ),
        pytest.param(
            [block(0, 100, samples=SPOILT[:100]), block(100, 200, samples=SPOILT[100:200])], [(0, 90), (110, 200)], 20,
            id="bad rows at the edges of blocks leave one gap",
        ),
        pytest.param([block(0, 100), block(100, 100), block(100, 200)], [(0, 200)], 0, id="empty blocks change nothing"),
        pytest.param(
            [block(0, 100, channels=("x", "a2", "battery", "a1"), samples=WIDE), block(100, 200)], [(0, 200)], 0,
            id="channels are found by name and others ignored",
        ),
        pytest.param(
            [block(0, 100), block(100, 200), block(100, 200, t_ns=T0 + 10**9 + 50_000_000), block(200, 300)], [(0, 300)],
            100, id="jitter does not make a repeated block look new",
        ),
    ],
)  # fmt: skip
def test_blocks_become_runs_with_every_loss_counted(
    blocks: list[SampleBlock], runs: list[tuple[int, int]], dropped: int
) -> None:
    state, pieces = feed(*blocks)
    assert_record(pieces, *runs)
    assert state.dropped == dropped
    assert all(p.values.dtype == np.float64 for p in pieces)
    n, begins = [len(p.values) for p in pieces], np.concatenate([np.arange(*run) for run in runs])
    assert [p.t_ns for p in pieces] == [T0 + int(begins[k]) * 10_000_000 for k in np.cumsum([0, *n[:-1]])]


def test_lost_blocks_are_a_gap_that_says_how_many_samples() -> None:
    state, pieces = feed(block(0, 100), block(250, 300), block(300, 310))
    assert_record(pieces, (0, 100), (250, 310))
    assert "150 samples" in pieces[1].gap.reason
    assert state.dropped == 0


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
    assert state.dropped == 15
    assert np.isfinite(joined(pieces)).all()


def test_bad_rows_before_the_first_good_one_are_counted_too() -> None:
    spoilt = VALUES[:100].copy()
    spoilt[:30] = np.nan
    state, pieces = feed(block(0, 100, samples=spoilt))
    np.testing.assert_array_equal(joined(pieces), VALUES[30:100])
    assert pieces[0].t_ns == T0 + 300_000_000
    assert state.dropped == 30


def test_nothing_finite_is_no_run() -> None:
    _, pieces = feed(block(0, 100, samples=np.full((100, 2), np.nan, dtype=np.float32)))
    assert pieces == []


def test_a_change_of_rate_begins_a_new_run() -> None:
    state, pieces = feed(block(0, 100), block(100, 200, sample_rate_hz=200.0), block(200, 250, sample_rate_hz=200.0))
    assert [p.gap is not None for p in pieces] == [False, True, False]
    assert pieces[1].gap is not None and "rate" in pieces[1].gap.reason
    assert pieces[1].rate_hz == 200.0
    assert state is not None and state.rate_hz == 200.0


def test_an_empty_block_begins_nothing() -> None:
    assert alignment.step(None, block(5, 5), CHANNELS) == (None, [])


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
    assert state.dropped == sum(b - a for a, b in order) - len(expected)
    assert sum(p.gap is not None for p in pieces) == np.count_nonzero(np.diff(expected) > 1)


@pytest.mark.parametrize("true_rate", [100.01, 99.99])
def test_a_sensor_clock_a_little_off_loses_no_sample_in_a_day_or_says_so(true_rate: float) -> None:
    """100 parts in a million: by sequence nothing is missing, so nothing may be cut out without a gap."""
    zeros = np.zeros((6000, 2), dtype=np.float32)
    state = alignment.start()
    silent, before = 0, 0
    for minute in range(1440):
        first = 6000 * minute
        item = SampleBlock(ACCELERATION, T0 + round(first / true_rate * 1e9), first, 100.0, CHANNELS, "m/s^2", zeros)
        state, pieces = alignment.step(state, item, CHANNELS)
        cut_out = state.dropped > before
        silent += cut_out and all(p.gap is None for p in pieces)
        before = state.dropped
    assert silent == 0


def stream(
    count: int, offset_ns: Callable[[int], int], *, size: int = 100, rate: float = RATE
) -> Iterator[tuple[AlignState, list[Piece]]]:
    """Blocks in sequence whose times are off by what `offset_ns` says of each one's number."""
    state = alignment.start()
    for k in range(count):
        values = np.resize(VALUES[k * size % 1000 :][:size], (size, 2))
        t_ns = T0 + round(k * size / rate * 1e9) + offset_ns(k)
        state, pieces = alignment.step(
            state, SampleBlock(ACCELERATION, t_ns, k * size, rate, CHANNELS, "m/s^2", values), CHANNELS
        )
        yield state, pieces


@pytest.mark.parametrize("ppm", [100, -100])
def test_a_clock_that_drifts_for_days_makes_no_gap_and_times_follow_it(ppm: int) -> None:
    """Three days, a minute a block: 26 s off in the end."""
    drift_ns = lambda k: round(k * 60e9 * ppm * 1e-6)  # noqa: E731
    state = alignment.start()
    for k, (state, pieces) in enumerate(stream(3 * 1440, drift_ns, size=6000)):  # noqa: B007
        (piece,) = pieces
        assert piece.gap is None
        assert abs(piece.t_ns - (T0 + k * 60 * 10**9 + drift_ns(k))) <= 250_000_000
    assert state.dropped == 0


def test_a_clock_set_anew_by_less_than_a_second_is_followed_and_small_jitter_is_not() -> None:
    shifts = [0, 5_000_000, -90_000_000, 400_000_000, 410_000_000, 380_000_000]
    pieces = [piece for _, found in stream(6, lambda k: shifts[k]) for piece in found]
    assert [p.gap for p in pieces] == [None] * 6
    assert [p.shift_ns for p in pieces] == [0, 0, 0, 400_000_000, 0, 0]
    labels = [p.t_ns - T0 - k * 10**9 for k, p in enumerate(pieces)]
    assert labels == [0, 0, 0, 400_000_000, 400_000_000, 400_000_000]


@pytest.mark.parametrize("jump_s", [-5.0, -1.0, 1.0, 3600.0])
def test_a_jump_of_the_clock_in_sequence_is_one_gap_and_loses_no_sample(jump_s: float) -> None:
    pieces = [piece for _, found in stream(20, lambda k: round(jump_s * 1e9) * (k >= 10)) for piece in found]
    assert [p.gap is not None for p in pieces] == [k == 10 for k in range(20)]
    assert pieces[10].gap is not None and f"the clock jumped by {jump_s:+.3f}" in pieces[10].gap.reason
    np.testing.assert_array_equal(joined(pieces), np.tile(VALUES, (2, 1)))
    assert all(p.t_ns == T0 + k * 10**9 + (k >= 10) * round(jump_s * 1e9) for k, p in enumerate(pieces))


@pytest.mark.parametrize("true_rate", [99.0, 200.0, 1e9])
def test_a_rate_that_its_own_times_deny_is_told(true_rate: float) -> None:
    """Times that advance otherwise than rate and samples say: never windows of the wrong length in silence."""
    pieces = [
        piece for _, found in stream(300, lambda k: round(k * 100 * (1e9 / true_rate - 1e9 / RATE))) for piece in found
    ]
    assert any(p.gap is not None for p in pieces[:200])


@pytest.mark.parametrize("size", [7, 70, 100, 1000])
def test_a_clock_set_back_with_a_sequence_begun_anew_is_believed_after_a_minute(size: int) -> None:
    """A node restarts without the time: its blocks are late, but they go on being late.  Of any size, to the same sample."""
    state, _ = feed(block(0, 1000, sequence=100_000))
    anew, accepted = [], 0
    for begin in range(0, 7000, size):
        values = np.zeros((size, 2), np.float32)
        item = block(0, 1, t_ns=T0 - 86400 * 10**9 + begin * 10**7, sequence=begin, samples=values)
        state, pieces = alignment.step(state, item, CHANNELS)
        anew += [p.gap for p in pieces if p.gap is not None]
        accepted += sum(len(p.values) for p in pieces)
    assert len(anew) == 1
    assert accepted == 1000 and state.dropped == 6000


def test_one_forged_block_does_not_stop_the_stream() -> None:
    century_ns = 80 * 365 * 86400 * 10**9
    forged = block(0, 100, t_ns=T0 + century_ns, sequence=1 << 61)
    state, _ = feed(block(0, 1000), forged)
    accepted = 0
    for k in range(70):
        state, pieces = alignment.step(
            state, block(0, 100, t_ns=T0 + (10 + k) * 10**9, sequence=1000 + 100 * k), CHANNELS
        )
        accepted += sum(len(p.values) for p in pieces)
    assert accepted >= 1000


@pytest.mark.parametrize(
    "changes",
    [
        {"t_ns": -1},
        {"t_ns": 1 << 62},
        {"sequence": (1 << 64) - 1},
        {"sample_rate_hz": 1e9},
        {"channels": tuple(f"c{k}" for k in range(10_000)), "samples": np.zeros((1, 10_000), np.float32)},
    ],
)
def test_absurd_numbers_are_bad_input(changes: dict[str, object]) -> None:
    with pytest.raises(BadInputError, match=str(ACCELERATION)):
        feed(block(0, 100, **changes))
