"""Windows as lag sums: equal to the direct sums, on one grid, never across a gap."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from monitor.core import Skipped, Window
from monitor.signals import windows
from monitor.signals.windows import WindowGrid, WindowState

T0 = 1_767_225_600_123_456_789
LAGS = 6
GRID = WindowGrid(100.0, 60, 20, LAGS)  # blocks of 20 samples
RECORD = np.random.default_rng(1).normal([3.0, -1.0], size=(400, 2))

Item = Window | tuple[int, int, float, Skipped]


def feed(
    grid: WindowGrid, state: WindowState, samples: np.ndarray, edges: list[int] | None = None
) -> tuple[WindowState, list[Item]]:
    items: list[Item] = []
    for part in np.split(samples, edges or []):
        state, new = windows.step(grid, state, part, T0)
        items += new
    return state, items


def run(grid: WindowGrid, samples: np.ndarray, edges: list[int] | None = None) -> list[Item]:
    return feed(grid, windows.start(grid, samples.shape[1], index=0), samples, edges)[1]


def assert_direct_sums(grid: WindowGrid, item: Item, samples: np.ndarray) -> None:
    """The window's sums are those of `samples` about their mean."""
    assert isinstance(item, Window)
    sums, total = item.sums, item.sums.total
    crossed = np.outer(sums.mean, sums.mean) * sums.counts[:, None, None, None]
    moved = sums.shifted[:, :1, :, None] * sums.mean + sums.mean[:, None] * sums.shifted[:, :, None]
    blocks = sums.products - moved + crossed
    v = samples - samples.mean(axis=0)
    n, size = len(v), grid.block_n
    used = n - grid.n_lags + 1  # every lag sums the same number of products
    tolerance = 1e-10 * np.abs(v).max() ** 2 * n
    for b in range(n // size):
        k = np.arange(b * size, min((b + 1) * size, used))
        assert item.sums.counts[b] == k.size
        for tau in range(grid.n_lags):
            np.testing.assert_allclose(blocks[b, tau], v[k].T @ v[k + tau], atol=tolerance)
    np.testing.assert_allclose(total, blocks.sum(axis=0), atol=tolerance)
    np.testing.assert_allclose(item.sums.head, v[: grid.n_lags - 1], atol=1e-12)
    np.testing.assert_allclose(item.sums.tail, v[n - grid.n_lags + 1 :], atol=1e-12)


def same_bits(a: list[Item], b: list[Item]) -> None:
    assert len(a) == len(b)
    for x, y in zip(a, b, strict=True):
        if isinstance(x, Window) and isinstance(y, Window):
            assert (x.index, x.t_end_ns, x.window_s, x.rate_hz) == (y.index, y.t_end_ns, y.window_s, y.rate_hz)
            for name in ("products", "shifted", "mean", "counts", "head", "tail"):
                np.testing.assert_array_equal(getattr(x.sums, name), getattr(y.sums, name))
        else:
            assert x == y


@pytest.mark.parametrize("grid", [GRID, WindowGrid(100.0, 60, 45, LAGS), WindowGrid(100.0, 60, 60, LAGS)])
def test_lag_sums_are_the_direct_sums_about_the_windows_mean(grid: WindowGrid) -> None:
    items = run(grid, RECORD)
    assert len(items) > 4
    for k, item in enumerate(items):
        assert_direct_sums(grid, item, RECORD[k * grid.hop_n : k * grid.hop_n + grid.window_n])


@pytest.mark.parametrize(("max_hz", "n_bins"), [(40.0, 801), (50.0, 1001), (80.0, 1001)])
def test_segments_hold_no_frequency_beyond_half_the_rate(max_hz: float, n_bins: int) -> None:
    grid = WindowGrid.design(rate_hz=100.0, window_s=40.0, hop_s=10.0, n_lags=50, max_hz=max_hz)
    assert (grid.segments.n, grid.segments.n_bins) == (2000, n_bins)


def test_a_large_offset_costs_no_more_than_its_rounding() -> None:
    """A channel that leans in gravity: 9.81 m/s^2 under vibrations of 1 mm/s^2."""
    tilted = 1e-3 * RECORD + 9.81
    for k, item in enumerate(run(GRID, tilted)):
        v = tilted[k * 20 : k * 20 + 60] - tilted[k * 20 : k * 20 + 60].mean(axis=0)
        assert isinstance(item, Window)
        direct = v[:55].T @ v[:55]
        np.testing.assert_allclose(item.sums.total[0], direct, atol=1e-6 * np.trace(direct))


@given(edges=st.lists(st.integers(0, len(RECORD)), max_size=15).map(sorted))
@settings(deadline=None, max_examples=40)
def test_any_split_gives_the_same_bits(edges: list[int]) -> None:
    same_bits(run(GRID, RECORD, edges), run(GRID, RECORD))
    same_bits(run(GRID, RECORD, list(range(len(RECORD)))), run(GRID, RECORD))


@given(blocks=st.integers(1, 6), hops=st.integers(1, 6), n=st.integers(0, 300))
@settings(deadline=None, max_examples=60)
def test_a_record_has_as_many_windows_as_the_contract_says(blocks: int, hops: int, n: int) -> None:
    grid = WindowGrid(100.0, 10 * max(blocks, hops), 10 * hops, LAGS)
    items = run(grid, RECORD[:n])
    assert len(items) == max(0, (n - grid.window_n) // grid.hop_n + 1)
    for k, item in enumerate(items):
        assert isinstance(item, Window)
        assert item.index == k
        assert item.t_end_ns == T0 + (k * grid.hop_n + grid.window_n) * 10_000_000
        assert item.window_s == grid.window_n / 100.0


def test_the_response_level_is_the_mean_of_the_channels_rms() -> None:
    long = np.random.default_rng(2).normal(size=(5000, 2)) * [1.0, 3.0]
    (item,) = run(WindowGrid(100.0, 5000, 100, LAGS), long)
    assert isinstance(item, Window)
    assert item.rms_m_s2 == pytest.approx(long.std(axis=0).mean(), rel=0.01)


@given(first=st.integers(0, 230), hole=st.integers(1, 230), second=st.integers(0, 230))
@settings(deadline=None, max_examples=150)
def test_windows_around_a_gap(first: int, hole: int, second: int) -> None:
    """On one grid: whole windows from one side alone, holed ones with their data length, empty ones absent."""
    end = first + hole + second
    signal = np.random.default_rng(first).normal(size=(end, 2))
    state, items = feed(GRID, windows.start(GRID, 2, index=0), signal[:first])
    state = windows.start(GRID, 2, index=first + hole, previous=state)
    _, after = feed(GRID, state, signal[first + hole :], [second // 3])
    there = np.ones(end, dtype=bool)
    there[first : first + hole] = False
    expected = {}
    for k in range(max(0, (end - GRID.window_n) // GRID.hop_n + 1)):
        inside = there[GRID.hop_n * k : GRID.end(k)]
        # A window ends when the data reach its end; the gap may hold the end of the record's last windows.
        if inside.any() and (GRID.end(k) <= first or second):
            expected[k] = int(inside.sum())
    found = {}
    for item in items + after:
        if isinstance(item, Window):
            found[item.index] = GRID.window_n
            assert item.t_end_ns == T0 + GRID.end(item.index) * 10_000_000
            assert_direct_sums(GRID, item, signal[GRID.hop_n * item.index : GRID.end(item.index)])
        else:
            k, t_end_ns, data_s, skipped = item
            assert t_end_ns == T0 + GRID.end(k) * 10_000_000
            assert isinstance(skipped, Skipped) and "gap" in skipped.reason
            found[k] = round(data_s * 100.0)
            assert data_s < GRID.window_n / 100.0
    assert found == expected
    order = [i.index if isinstance(i, Window) else i[0] for i in items + after]
    assert order == sorted(order)


def test_a_window_over_three_runs_counts_the_data_of_all() -> None:
    state = windows.start(GRID, 2, index=0)
    for begin, end in ((0, 30), (35, 42), (50, 60)):
        if begin:
            state = windows.start(GRID, 2, index=begin, previous=state)
        state, items = feed(GRID, state, RECORD[begin:end])
    assert items == [(0, T0 + 600_000_000, pytest.approx(0.47), Skipped("gap in the data"))]


def test_the_state_does_not_grow_with_the_number_of_gaps() -> None:
    """A daemon with a bad plug meets a million gaps; only those that a coming window touches matter."""
    state = windows.start(GRID, 2, index=0)
    state, _ = feed(GRID, state, RECORD[:30])
    for number in range(1, 200):
        state = windows.start(GRID, 2, index=40 * number, previous=state)
        state, _ = feed(GRID, state, RECORD[:30])
    assert len(state.past_runs) <= 4


def test_a_clock_that_jumps_costs_no_work_for_every_window_that_is_not_there() -> None:
    """1970 until the first time message, then today: 350 million windows in between.  30 days of them show it."""
    grid, away = WindowGrid(100.0, 2000, 500, LAGS), 30 * 86400 * 100
    state, _ = feed(grid, windows.start(grid, 2, index=0), RECORD)
    state = windows.start(grid, 2, index=away, previous=state)
    began = time.process_time()
    _, items = feed(grid, state, np.tile(RECORD, (8, 1)))
    assert [i.index for i in items if isinstance(i, Window)] == [away // 500 + k for k in range(3)]
    assert time.process_time() - began < 0.5


@pytest.mark.parametrize(
    ("window_s", "hop_s", "block"),
    [(400, 10, 1000), (400, 400, 1000), (60, 5, 500), (300, 30, 1000), (70, 7, 700), (8, 8, 400)],
)
def test_blocks_last_at_most_ten_seconds_and_tile_windows_and_hops(window_s: float, hop_s: float, block: int) -> None:
    """Windows that do not overlap have blocks too, or their uncertainty would be lost."""
    grid = WindowGrid.design(100.0, window_s, hop_s, 50)
    assert grid.block_n == block
    assert grid.window_n % block == 0
    assert grid.hop_n % block == 0
