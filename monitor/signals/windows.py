"""Sliding windows as lag sums: the cost of a hop is independent of the window's length.

The time axis is cut into blocks that tile windows and hops, on a fixed grid.  A block's lagged products are formed
once, and a window is the sum of its blocks.  No running sum is kept, so rounding errors do not accumulate.  The
uncertainty is estimated from the same blocks.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from math import ceil, gcd
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import GAP, Array, ComplexArray, LagSums, Skipped, Window
from monitor.signals.welch import SegmentDesign, transform

_CORRELATION_BLOCK_S = 10.0
"""Length of the blocks from which the scatter of the correlations is estimated. [s; judgement]"""
_LEAST_BLOCKS = 2
"""Blocks of a window, at least. [count; definition: one has no scatter]"""


def common_step_s(window_s: float, hop_s: float) -> float:
    """Return the largest time step that divides window and hop, s; both are rounded to milliseconds.

    The step is 0 where the hop is shorter than one millisecond.

    Examples
    --------
    >>> common_step_s(25.0, 10.0)
    5.0
    """
    return gcd(round(window_s * 1e3), round(hop_s * 1e3)) / 1e3 if round(hop_s * 1e3) else 0.0


@dataclass(frozen=True, slots=True)
class WindowGrid:
    """Grid of windows, blocks and segments on the axis of conditioned samples.

    Examples
    --------
    >>> grid = WindowGrid.design(rate_hz=100.0, window_s=40.0, hop_s=10.0, n_lags=50)
    >>> grid.window_n, grid.block_n, grid.end(1)
    (4000, 1000, 5000)
    """

    rate_hz: float
    window_n: int
    hop_n: int
    n_lags: int
    segment_s: float = 20.0
    max_hz: float = 40.0
    """Highest frequency kept of the segments' transforms, Hz."""

    @classmethod
    def design(
        cls, rate_hz: float, window_s: float, hop_s: float, n_lags: int, segment_s: float = 20.0, max_hz: float = 40.0
    ) -> WindowGrid:
        """Design the grid of windows; `rate_hz` times `common_step_s` must be a whole number of samples."""
        return cls(rate_hz, round(window_s * rate_hz), round(hop_s * rate_hz), n_lags, segment_s, max_hz)

    @property
    def block_n(self) -> int:
        """Samples in a block: the longest block of at most 10 s that divides windows and hops."""
        return _block_n(self.window_n, self.hop_n, self.n_lags, self.rate_hz)

    @property
    def segment_step(self) -> int:
        """Blocks from the start of one segment to the start of the next, half a segment; 0 without segments."""
        step = max(1, round(0.5 * self.segment_s * self.rate_hz / self.block_n)) if self.segment_s else 0
        return min(step, max(1, self.window_n // (2 * self.block_n)))  # a window of seconds has one segment

    @property
    def segments(self) -> SegmentDesign:
        """Length and frequencies of the segments."""
        n = 2 * self.segment_step * self.block_n
        return SegmentDesign(self.rate_hz, n, min(n // 2 + 1, round(self.max_hz * n / self.rate_hz) + 1))

    def end(self, k: int) -> int:
        """Return the grid index just past the last sample of window k."""
        return k * self.hop_n + self.window_n


@lru_cache(maxsize=16)
def _block_n(window_n: int, hop_n: int, n_lags: int, rate_hz: float) -> int:
    """Return the samples in a block (`WindowGrid.block_n`); a block has at least `n_lags`, if any division allows it."""
    step = gcd(window_n, hop_n)
    least = max(ceil(step / (_CORRELATION_BLOCK_S * rate_hz)), ceil(_LEAST_BLOCKS * step / window_n))
    parts = (q for q in range(least, step // n_lags + 1) if step % q == 0)
    return step // next(parts, 1)


@dataclass(frozen=True, eq=False, slots=True)
class _Block:
    """Lagged products of one block of samples."""

    products: Annotated[Array, "lags c c"]
    """Sums of the products whose first factor lies in this block; in the latest block only those
    with both factors inside."""
    shifted: Annotated[Array, "lags c"]
    """Sums of the second factors of these products; at lag 0 these are the first factors as well."""
    head: Annotated[Array, "head c"]
    """The block's first samples, one less than there are lags."""


@dataclass(frozen=True, eq=False, slots=True)
class WindowState:
    """State of the window stage between samples: the current run without gaps, and the extent of earlier runs."""

    start: int
    """Grid index of the current run's first sample."""
    n: int
    """Samples in the current run."""
    next_window: int
    samples: Annotated[Array, "n_kept c"]
    """The latest samples of the run: two blocks or one segment, whichever is longer."""
    blocks: tuple[_Block, ...]
    """The latest complete blocks of the run, at most one window of them."""
    segments: tuple[tuple[int, ComplexArray], ...] = ()
    """(number, transform) of the run's latest segments, at most one window of them."""
    past_runs: tuple[tuple[int, int, int], ...] = ()
    """(start, end, samples) of earlier runs that a later window may overlap.  Runs within one block are one entry, so
    that many gaps in a short time do not lengthen the list."""
    lost: tuple[int, ...] = ()
    """Grid index of the run's latest lost sample of each channel, -1 for none; empty before the first."""


def start(grid: WindowGrid, n_channels: int, *, index: int, previous: WindowState | None = None) -> WindowState:
    """Return the state before the first sample of a run that begins at grid index `index`."""
    runs: tuple[tuple[int, int, int], ...] = ()
    next_window = 0
    if previous is not None:
        runs = _all_runs(grid, previous)
        next_window = _next_window_with_data(grid, runs, index, previous.next_window)
        if runs and runs[0][1] <= next_window * grid.hop_n:
            runs = tuple(r for r in runs if r[1] > next_window * grid.hop_n)
    return WindowState(index, 0, next_window, np.zeros((0, n_channels)), (), (), runs)


def _all_runs(grid: WindowGrid, state: WindowState) -> tuple[tuple[int, int, int], ...]:
    """List the earlier runs and the current one, in order."""
    runs, begin, end, n = state.past_runs, state.start, state.start + state.n, state.n
    if n and runs and runs[-1][0] // grid.block_n == (end - 1) // grid.block_n:
        begin, n = runs[-1][0], n + runs[-1][2]
        runs = runs[:-1]
    return (*runs, (begin, end, n)) if n else runs


def step(
    grid: WindowGrid,
    state: WindowState,
    samples: Annotated[Array, "n c"],
    t0_ns: int,
    lost: Annotated[NDArray[np.bool_], "n c"] | None = None,
) -> tuple[WindowState, list[Window | tuple[int, int, float, Skipped]]]:
    """Add samples, m/s^2, and emit the windows that they complete; one with a gap is ``(index, t_end_ns, data_s, Skipped)``.

    Parameters
    ----------
    t0_ns
        UTC of grid index 0.
    lost
        Mask of samples whose values are made up: a window names their channels in `Window.lost`.
    """
    results: list[Window | tuple[int, int, float, Skipped]] = []
    while samples.shape[0]:
        # Cut at block boundaries: each block is then formed from the same samples, however the input was divided.
        room = grid.block_n - (state.start + state.n) % grid.block_n
        part, samples = samples[:room], samples[room:]
        if lost is not None:
            state, lost = replace(state, lost=_latest_lost(state, lost[:room])), lost[room:]
        state = _append(grid, state, part)
        end = state.start + state.n
        if end % grid.block_n == 0:
            state = _close_segment(grid, _close_block(grid, state))
        while grid.end(state.next_window) <= end:
            k = state.next_window
            state = replace(state, next_window=_next_window_with_data(grid, state.past_runs, state.start, k + 1))
            results.extend(_emit(grid, state, k, t0_ns))
    return state, results


def _next_window_with_data(grid: WindowGrid, runs: tuple[tuple[int, int, int], ...], start: int, k: int) -> int:
    """Find the first window from k on that holds data of earlier `runs` or of the run that begins at `start`.

    Windows that lie wholly in a gap are skipped in one step, however long the gap.
    """
    if runs and runs[-1][1] > k * grid.hop_n:
        return k
    return max(k, (start - grid.window_n) // grid.hop_n + 1)


def _append(grid: WindowGrid, state: WindowState, part: Array) -> WindowState:
    """Append samples to the current run and drop those that no block or segment needs."""
    keep = max(2 * grid.block_n, grid.segments.n)
    joined = np.concatenate([state.samples, part])[-keep:]
    return replace(state, n=state.n + part.shape[0], samples=joined)


def _latest_lost(state: WindowState, lost: NDArray[np.bool_]) -> tuple[int, ...]:
    """Find each channel's latest lost sample, with those of the next samples."""
    before, at = state.lost or (-1,) * lost.shape[1], state.start + state.n
    return tuple(at + int(np.flatnonzero(own)[-1]) if own.any() else b for own, b in zip(lost.T, before, strict=True))


def _close_block(grid: WindowGrid, state: WindowState) -> WindowState:
    """Form the lagged products of the completed block, and those that reach into it from the block before."""
    size, lags = grid.block_n, grid.n_lags
    if state.n < size:  # the run began inside this block
        return state
    from monitor.signals.kernels import lag_products  # compiled code takes a while to load

    block = np.ascontiguousarray(state.samples[-size:].T)
    inner = lag_products(block, size - lags + 1, lags)
    blocks = list(state.blocks)
    if blocks:
        around = np.ascontiguousarray(state.samples[-size - lags + 1 : -size + lags - 1].T)
        products, shifted = lag_products(around, lags - 1, lags)  # first factors: its last lags - 1 samples
        b = blocks[-1]
        blocks[-1] = _Block(b.products + products, b.shifted + shifted, b.head)
    blocks.append(_Block(*inner, state.samples[-size:][: lags - 1].copy()))
    return replace(state, blocks=tuple(blocks[-(grid.window_n // size) :]))


def _close_segment(grid: WindowGrid, state: WindowState) -> WindowState:
    """Transform the segment that ends at the latest sample, if one does and lies wholly in the run."""
    if not grid.segment_step:
        return state
    design = grid.segments
    number, odd = divmod((state.start + state.n) // grid.block_n - 2 * grid.segment_step, grid.segment_step)
    if odd or state.n < design.n:
        return state
    segment = (number, transform(design, state.samples[-design.n :]))
    n_kept = max(0, grid.window_n // (grid.segment_step * grid.block_n) - 1)
    return replace(state, segments=(*state.segments, segment)[-n_kept:] if n_kept else ())


def _emit(
    grid: WindowGrid, state: WindowState, k: int, t0_ns: int
) -> Iterator[Window | tuple[int, int, float, Skipped]]:
    """Yield window k if it lies wholly in the current run, else the skipped window if it holds any data."""
    end = grid.end(k)
    begin = end - grid.window_n
    t_end_ns = t0_ns + round(end / grid.rate_hz * 1e9)
    if begin >= state.start:
        step = grid.segment_step * grid.block_n
        inside = [(i, x) for i, x in state.segments if i * step >= begin]
        yield Window(
            index=k,
            t_end_ns=t_end_ns,
            window_s=grid.window_n / grid.rate_hz,
            rate_hz=grid.rate_hz,
            sums=_sum_up(grid, state),
            first_block=begin // grid.block_n,
            segments=tuple(x for _, x in inside),
            segment_bin_hz=grid.segments.step_hz if inside else 0.0,
            first_segment=inside[0][0] if inside else 0,
            lost=tuple(channel for channel, latest in enumerate(state.lost) if latest >= begin),
        )
        return
    data_n = sum(max(0, min(n, end - s, e - begin, grid.window_n)) for s, e, n in _all_runs(grid, state))
    if data_n:  # a window without any data is not reported
        yield k, t_end_ns, data_n / grid.rate_hz, Skipped(GAP)


def _sum_up(grid: WindowGrid, state: WindowState) -> LagSums:
    """Add up the blocks of the state to the lag sums of one window."""
    lags, blocks, c = grid.n_lags, state.blocks, state.samples.shape[1]
    counts = np.full(len(blocks), grid.block_n)
    counts[-1] = grid.block_n - lags + 1
    products = np.concatenate([b.products for b in blocks]).reshape(-1, lags, c, c)
    shifted = np.concatenate([b.shifted for b in blocks]).reshape(-1, lags, c)
    head, tail, sums = blocks[0].head, state.samples[state.samples.shape[0] - lags + 1 :], shifted.sum(axis=0)
    mean = (sums[0] + tail.sum(axis=0)) / grid.window_n
    moved = sums[0][:, None] * mean + mean[:, None] * sums[:, None, :]
    total = products.sum(axis=0) - moved + counts.sum() * np.outer(mean, mean)
    return LagSums(products, shifted, mean, counts, head - mean, tail - mean, total)
