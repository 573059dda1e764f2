"""Numbers of samples and their rate from timestamps that are cut, jittered or interrupted by pauses."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, BadInputError

Ticks = NDArray[np.int64]

_GRIDS_NS = (10**9, 10**8, 10**7, 10**6, 10**5, 10**4, 10**3, 10**2, 10)
"""Steps to which clocks cut their stamps. [ns; convention: powers of ten]"""
_SCATTERS = 5.0
"""Distance beyond which a jump of the level of stamps is none by chance. [standard deviations; one false in a million]"""
_MOST_AVERAGED = 64
"""Most stamps on each side of a jump that are averaged to see it through the jitter. [stamps; cost]"""
_STAYS = 5
"""Stamps that must follow late for a jump, and not one late stamp. [stamps; judgement]"""
_HUBER = 1.345
"""Residuals, over their scatter, from which they count less. [1; Huber: 95 % efficient at normal scatter]"""
_FIT_ROUNDS = 8
"""Most rounds of the weighted fit. [count; cost: three suffice]"""
_SLOPE_PIECES = 8
"""Pieces whose own slopes show how far a clock wanders. [count; judgement: their scatter is then known within a quarter]"""
_CRYSTAL = 2e-5
"""Distance from a whole rate within which the whole rate is meant. [1; convention: tolerance of quartz crystals]"""
_MOST_WANDER = 0.1
"""Random step of the samples' own spacing, over the mean one, from which they are not evenly spaced. [1; judgement: the phase of
a mode wanders by as much a sample]"""
_CUT_PERIOD = 1e-4
"""Distance, relative, to which a clock may cut its period. [1; judgement: 8333 us for 120 Hz]"""
_LEAST_STAMPS = 16
"""Stamps up to which their scatter tells nothing. [stamps; judgement]"""
_LEAST_RUN = 20
"""Samples between jumps by no whole number of them, below which the stamps are not those of one clock. [samples; judgement]"""
_CHANGED = 1e-3
"""Standard deviation of the rate, relative, from which a line that samples leave by periods is none. [1; judgement: a clock
that wanders is known ten times better]"""
_LEAST_KNOWN = 0.05
"""Standard deviation of the rate, relative, from which stamps tell none. [1; judgement]"""


@dataclass(frozen=True, eq=False, slots=True)
class SampleClock:
    """What stamps tell of the samples' times."""

    rate_hz: float
    """A whole rate where the stamps do not contradict it."""
    rate_std_hz: float
    """Standard deviation of the rate by the stamps, with the wander of their clock."""
    numbers: Annotated[Ticks, "n"]
    """Number of each sample from 0; what is missing leaves a jump."""
    even_ns: Annotated[Ticks, "n"]
    """Stamps without their jitter: evenly spaced in each run."""
    resolution_s: float
    """Step to which the stamps are cut."""
    jitter_s: float
    """Standard deviation of the stamps about evenly spaced samples."""
    pauses: int
    """Jumps of the numbers."""


def sample_clock(stamps_ns: Annotated[Ticks, "n"]) -> SampleClock:
    """Number samples and estimate their rate by a robust line through all stamps between pauses.

    Samples between two jumps of the stamps' level are taken as evenly spaced: the clock that stamps them jitters, not the
    converter.  Within a jump as many samples are missing as fit.  Runs of samples share one slope, each with its own origin,
    since a logger that begins anew does not keep the phase.

    Raises BadInputError if the stamps do not rise or tell no rate.

    References
    ----------
    Huber, Robust Statistics (Wiley, 1981), chapter 7.

    Examples
    --------
    >>> stamps = np.floor(np.arange(2000) * 1e3 / 120.0).astype(np.int64) * 10**6  # 120 Hz, cut to ms
    >>> stamps[1000:] += 5 * 10**9  # and a pause
    >>> clock = sample_clock(stamps)
    >>> clock.rate_hz, clock.pauses, clock.resolution_s
    (120.0, 1, 0.001)
    """
    steps = np.diff(stamps_ns)
    if not steps.size or stamps_ns[-1] <= stamps_ns[0]:
        raise BadInputError("the stamps do not rise")
    lost, resolution = _lost_of_grid(steps), 1
    if lost is None:
        resolution = _resolution(stamps_ns)
        first = _first_period(stamps_ns, resolution)
        if not first > 0.0:
            raise BadInputError(
                f"the stamps are cut to {1e-9 * resolution:.3g} s, too coarse for {len(stamps_ns)} samples to tell a rate"
            )
        lost = _lost(stamps_ns, steps, first, resolution)
    period, std, residuals, lost, odd = _line(stamps_ns, lost, resolution)
    if not period > 0.0 or (len(stamps_ns) > _LEAST_STAMPS and std > _LEAST_KNOWN * period):
        raise BadInputError(
            f"the stamps scatter too much to tell a rate: about {1e9 / max(period, 1.0):.4g} Hz, known to "
            f"{100.0 * std / max(period, 1.0):.2g} %"
        )
    jitter = float(np.std(residuals))
    if std > _CHANGED * period and jitter > max(2.0 * period, resolution):
        raise BadInputError(
            f"the rate changes within the record, or samples are missing here and there: about {1e9 / period:.4g} Hz; evenly "
            f"spaced samples would be off by {1e-9 * jitter:.2g} s"
        )
    if len(stamps_ns) <= _LEAST_STAMPS and jitter > max(0.25 * period, 0.6 * resolution):
        raise BadInputError(f"{len(stamps_ns)} stamps that are not evenly spaced are too few to tell a rate")
    if odd > max(_LEAST_STAMPS, len(stamps_ns) // _LEAST_RUN):
        raise BadInputError(
            f"the stamps jump {odd} times by no whole number of samples: sensors with clocks of their own, or packets"
        )
    even = np.where(lost > 0, period, steps)
    if len(stamps_ns) > _LEAST_STAMPS and (wander := _own_scatter(even, period, resolution)) > _MOST_WANDER * period:
        raise BadInputError(
            f"the samples are not evenly spaced: each step scatters by {100.0 * wander / period:.0f} % on its own"
        )
    rate, rate_std = 1e9 / period, 1e9 / period * std / period
    whole = float(round(rate))
    cut = min(_CUT_PERIOD, resolution / period) if jitter < 0.1 * resolution else 0.0
    meant = whole if whole and abs(rate - whole) <= max(2.0 * rate_std, max(_CRYSTAL, cut) * whole) else rate
    even = stamps_ns - np.rint(residuals).astype(np.int64)
    return SampleClock(
        meant, rate_std, _numbers(lost), even, resolution * 1e-9, jitter * 1e-9, int(np.count_nonzero(lost))
    )


def _own_scatter(steps: Annotated[Array, "n"], period: float, resolution: int) -> float:
    """Return the scatter of steps, ns, that jitter of their stamps does not explain: of that, the next step has the opposite.

    Steps of cut stamps are summed over so many that the cutting no longer matters; 0 where that leaves too few.
    """
    summed = int(np.ceil((resolution / (0.5 * _MOST_WANDER * period)) ** 2 / 6.0))
    if len(steps) < _LEAST_STAMPS * summed:
        return 0.0
    middle = period if summed > 1 else float(np.median(steps))
    away = np.clip(steps - middle, -3.0 * middle, max(3.0 * middle, float(resolution)))
    away = np.add.reduceat(away, np.arange(0, len(away), summed))[: len(away) // summed] / np.sqrt(summed)
    own = float(np.mean(away**2) + 2.0 * np.mean(away[1:] * away[:-1]))
    return float(np.sqrt(max(own, 0.0)))


def _resolution(stamps_ns: Annotated[Ticks, "n"]) -> int:
    """Find the step, ns, to which stamps are cut."""
    away = stamps_ns - stamps_ns[0]
    return next((grid for grid in _GRIDS_NS if not (away % grid).any()), 1)


def _first_period(stamps_ns: Annotated[Ticks, "n"], resolution: int) -> float:
    """Estimate the sampling period, ns, from pairs of samples so far apart that cutting and jitter matter little."""
    n, ticks = len(stamps_ns), np.unique(stamps_ns)
    period = float(np.median(np.diff(ticks))) * len(ticks) / n
    scatter = max(float(np.median(np.abs(np.diff(stamps_ns) - period))), float(resolution))
    apart = 1
    while apart < n // 16 and apart * period < 16.0 * scatter:
        apart *= 2
    spans = stamps_ns[apart:] - stamps_ns[:-apart]
    middle = float(np.median(spans))
    # A mean, since cut stamps have few values; of those pairs alone between which nothing is missing.
    return float(np.mean(spans[np.abs(spans - middle) <= 3.0 * scatter])) / apart


def _lost_of_grid(steps: Annotated[Ticks, "n-1"]) -> Annotated[Ticks, "n-1"] | None:
    """Count the samples that are missing between stamps that are not cut at all: each step is so many times the least one.

    None where steps are of another kind, or no more than cut stamps show: these stay within a tick of evenly spaced ones, but
    for a part of a tick after each pause.
    """
    tick = int(steps.min())
    if (
        tick <= 0
        or len(steps) < _LEAST_STAMPS
        or (steps % tick).any()
        or 2 * np.count_nonzero(steps == tick) < len(steps)
    ):
        return None
    lost = steps // tick - 1
    near = lost[lost <= _STAYS]
    walk = np.ptp(np.cumsum(near - near.mean()))
    return lost if walk > 3.0 + 2.0 * np.sqrt(len(lost) - len(near)) else None


def _lost(
    stamps_ns: Annotated[Ticks, "n"], steps: Annotated[Ticks, "n-1"], period: float, resolution: int
) -> Annotated[Ticks, "n-1"]:
    """Count the samples that are missing behind each one but the last: whole periods by which the stamps' level jumps."""
    scatter = float(np.median(np.abs(steps - period))) * 1.4826 / np.sqrt(2.0)
    scatter = max(scatter, resolution / np.sqrt(12.0))
    level = (stamps_ns - stamps_ns[0]) - period * np.arange(len(stamps_ns))
    clear = _SCATTERS * 2.0 * scatter  # the difference of two medians scatters by 1.8 over root n
    plain = _plain_jumps(level, max(0.5 * period, clear))
    lost = np.zeros(len(steps), dtype=np.int64)
    for at, jump in plain.items():
        lost[at] = max(1, round(jump / period))
        level[at + 1 :] -= jump
    needed = (clear / (0.5 * period)) ** 2
    width = int(min(_MOST_AVERAGED, np.ceil(needed), len(stamps_ns) // 4))
    if needed <= 1.0 or width < 2:
        return lost
    from scipy.ndimage import median_filter

    after = median_filter(level, width, origin=-(width // 2) + (width % 2 == 0), mode="nearest")
    before = median_filter(level, width, origin=(width - 1) // 2, mode="nearest")
    jumps = after[1:] - before[:-1]
    for begin, end in _above(jumps > max(0.5 * period, clear / np.sqrt(width))):
        # The step itself shows where in the stretch the level jumps.
        at = begin + int(np.argmax(np.diff(level[begin : end + 1])))
        lost[at] += max(1, round(float(jumps[begin:end].max()) / period))
    return lost


def _plain_jumps(level: Annotated[Array, "n"], least: float) -> dict[int, float]:
    """Find the steps that no jitter makes, after which the level stays; return place and height, ns."""
    places = np.flatnonzero(np.diff(level) > least)
    ends = [0, *(places + 1).tolist(), len(level)]
    found = {}
    for at, begin, end in zip(places.tolist(), ends, ends[2:], strict=False):
        before, after = level[max(begin, at + 1 - _STAYS) : at + 1], level[at + 1 : min(end, at + 1 + _STAYS)]
        jump = float(np.median(after) - np.median(before))
        if jump > least:
            found[at] = jump
    return found


def _above(high: Annotated[NDArray[np.bool_], "n"]) -> list[tuple[int, int]]:
    """List the stretches, begin and end, in which a condition holds."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], high.view(np.int8), [0]))))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _numbers(lost: Annotated[Ticks, "n-1"]) -> Annotated[Ticks, "n"]:
    """Number samples from 0 by how many are missing behind each one but the last."""
    return np.concatenate(([0], np.cumsum(1 + lost)))


def _line(
    stamps_ns: Annotated[Ticks, "n"], lost: Annotated[Ticks, "n-1"], resolution: int
) -> tuple[float, float, Annotated[Array, "n"], Annotated[Ticks, "n-1"], int]:
    """Fit one period to all runs of samples; return it, its standard deviation, the residuals, the missing samples anew, and how
    many jumps are surely no whole number of periods.

    At first each jump begins a run with an origin of its own.  Where whole periods fit a jump, and could not by chance, both
    sides are one run, whose line is then surer.
    """
    jumps = np.flatnonzero(lost) + 1
    fit = _pooled(_numbers(lost), stamps_ns, np.concatenate(([0], jumps)), resolution)
    period, std, residuals = fit
    if not jumps.size or not period > 0.0:
        return (*fit, lost, 0)
    ends = np.concatenate(([0], jumps, [len(stamps_ns)]))
    # Of each run: its origin against the line, by which the next one is off by whole periods or not.
    level = stamps_ns - stamps_ns[0] - period * np.arange(len(stamps_ns)) - residuals
    gaps = np.diff(level[ends[:-1]]) / period
    noise = max(float(np.std(residuals)), resolution / np.sqrt(12.0))
    lengths = np.diff(ends)
    own = noise * np.sqrt(1.0 / lengths[:-1] + 1.0 / lengths[1:])
    across = (gaps + 0.5 * (lengths[:-1] + lengths[1:])) * std
    sure = 3.0 * np.hypot(own, across) / period
    fits = (np.abs(gaps - np.rint(gaps)) <= sure) & (sure < 0.125)
    lost = lost.copy()
    lost[jumps - 1] = np.maximum(np.rint(gaps).astype(np.int64), 0)
    period, std, residuals = _pooled(_numbers(lost), stamps_ns, np.concatenate(([0], jumps[~fits])), resolution)
    return period, std, residuals, lost, int(np.count_nonzero(~fits & (sure < 0.125)))


def _pooled(
    numbers: Annotated[Ticks, "n"], stamps_ns: Annotated[Ticks, "n"], first: Annotated[Ticks, "runs"], resolution: int
) -> tuple[float, float, Annotated[Array, "n"]]:
    """Fit lines of one slope to runs by Huber's estimate: slope, its standard deviation, and residuals."""
    x = numbers.astype(np.float64)
    y = (stamps_ns - stamps_ns[0]).astype(np.float64)
    weight = np.ones(len(x))
    lengths = np.diff([*first, len(x)])
    slope, residuals, square = 0.0, y, 1.0
    for _ in range(_FIT_ROUNDS):
        total = np.add.reduceat(weight, first)
        away_x = x - np.repeat(np.add.reduceat(weight * x, first) / total, lengths)
        away_y = y - np.repeat(np.add.reduceat(weight * y, first) / total, lengths)
        square = float(np.sum(weight * away_x**2))
        if square <= 0.0:
            return 0.0, np.inf, residuals
        before, slope = slope, float(np.sum(weight * away_x * away_y)) / square
        residuals = away_y - slope * away_x
        scatter = 1.4826 * float(np.median(np.abs(residuals)))
        if scatter <= 0.0 or abs(slope - before) <= 1e-9 * abs(slope):
            break
        weight = np.minimum(1.0, _HUBER * scatter / np.maximum(np.abs(residuals), _HUBER * scatter))
    noise = np.hypot(float(np.std(residuals)), resolution / np.sqrt(12.0))
    # Cut stamps are off by a pattern that may last as long as the longest run.
    longest = float(np.max(x[np.append(first[1:], len(x)) - 1] - x[first]))
    pattern = resolution / np.sqrt(12.0) / max(longest, 1.0)
    return slope, max(noise / np.sqrt(square), pattern, _wander(x, residuals, first)), residuals


def _wander(x: Annotated[Array, "n"], residuals: Annotated[Array, "n"], first: Annotated[Ticks, "runs"]) -> float:
    """Return the standard deviation of the common slope that the slopes of pieces show; 0 where these are too short."""
    slopes, squares = [], []
    for begin, end in pairwise([*first.tolist(), len(x)]):
        for piece in np.array_split(np.arange(begin, end), max(1, round(_SLOPE_PIECES * (end - begin) / len(x)))):
            away = x[piece] - x[piece].mean() if len(piece) else x[:0]
            if (square := float(away @ away)) > 0.0:
                slopes.append(float(away @ residuals[piece]) / square)
                squares.append(square)
    if len(slopes) < 3:
        return 0.0
    share = np.array(squares) / np.sum(squares)
    away = np.array(slopes) - float(share @ np.array(slopes))
    return float(np.sqrt(np.sum(share**2 * away**2) / (1.0 - np.sum(share**2))))
