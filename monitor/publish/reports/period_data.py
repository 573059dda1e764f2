"""Results of a run over a period, in bounded memory: curves keep a mean and an envelope for each bin of time."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from heapq import nlargest
from itertools import pairwise
from math import inf
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from monitor.core import Array, BadInputError, MissingInputError
from monitor.damage import Course, Known, follow
from monitor.publish.results.files import RESULTS, closed_files, read_all_lines, read_lines
from monitor.publish.results.lines import facts_of_line, read_line
from monitor.publish.results.recorded_time import due_windows, reaches_between

MAX_BINS = 1000
"""Largest number of bins of a curve, which is drawn as the two sides of its envelope: 2000 points."""
_GAP_BINS = 3
"""Empty bins of a gap that charts shorten: curves are interrupted there. [count; definition: `Curve.drawn`]"""
_GAP_WIDTH = 0.06
"""Greatest share of a chart's width that a shortened gap takes. [ratio; judgement: seen, and a label fits]"""
_MOST_GAPS = 50
"""Most gaps that are shortened. [count; judgement: as many stretches have no width to show anything]"""
_MAX_MODES = 8
"""Largest number of modes that are drawn."""
_SAME_MODE = 0.1
"""Relative difference of two frequencies below which they are one mode, where tracking has not identified the mode yet."""
_SAME_OTHER_MODE = 0.02
"""The same for modes that the model has no counterpart for, which may be close to others."""
_HEAD, _TAIL_BYTES = 50, 1 << 17
"""Number of lines at the beginning and of bytes at the end of the file from which its extent is read."""
_T_END = re.compile(rb'"t_end_ns": (\d{1,18}|[1-8]\d{18})\b')


class Grid:
    """Grid of bins over ``(from_ns, to_ns]`` (UTC), equal but for the gaps in which no window ends and which charts shorten.

    There are `n` bins outside the gaps, which are given by their ends, UTC in ns, in order.

    Examples
    --------
    >>> grid = Grid(0, 1000, 4, [(20, 980)])
    >>> grid.at(10), grid.at(20), grid.at(1000), grid.n
    (0, 1, 6, 7)
    """

    def __init__(self, from_ns: int, to_ns: int, n: int, gaps: Sequence[tuple[int, int]] = ()) -> None:
        self.from_ns, self.to_ns, self.gaps = from_ns, to_ns, tuple(gaps)
        self._ends = [from_ns, *(t for gap in gaps for t in gap), to_ns]
        parts, length = list(pairwise(self._ends)), sum(b - a for a, b in self.stretches)
        counts = [_GAP_BINS if k % 2 else max(1, round(n * (b - a) / length)) for k, (a, b) in enumerate(parts)]
        counts = counts if gaps else [n]
        inside = (a + (b - a) * i // m for (a, b), m in zip(parts, counts, strict=True) for i in range(1, m + 1))
        self.edges_ns = np.array([from_ns, *inside])
        self.n = self.edges_ns.size - 1
        share = min(_GAP_WIDTH, 0.5 / max(1, len(gaps)))
        rest = 1.0 - share * len(gaps)
        widths = [share if k % 2 else rest * (b - a) / length for k, (a, b) in enumerate(parts)]
        self._shares = np.concatenate([[0.0], np.cumsum(widths)])

    @property
    def stretches(self) -> list[tuple[int, int]]:
        """Ends of what lies outside the gaps, UTC in ns."""
        return list(zip(self._ends[::2], self._ends[1::2], strict=True))

    def at(self, t_ns: int) -> int:
        """Find the bin of a time; the nearest bin where the time is outside the period."""
        return min(max(int(np.searchsorted(self.edges_ns, t_ns)) - 1, 0), self.n - 1)

    def places(self) -> list[tuple[float, float, float, float]]:
        """List what lies outside the gaps: its ends, s since 1970 UTC, and their places along a chart."""
        ends = [(a, b, *self.share(np.array([a, b], dtype=float)).tolist()) for a, b in self.stretches]
        return [(a * 1e-9, b * 1e-9, begin, end) for a, b, begin, end in ends]

    def share(self, t_ns: Array | float) -> Array:
        """Return the places of times along a chart, from 0 at its left to 1 at its right, of the shape of `t_ns`."""
        ends = np.array(self._ends) - self.from_ns
        return np.asarray(np.interp(np.asarray(t_ns, dtype=float) - self.from_ns, ends, self._shares))


class Curve:
    """A quantity over a period: in each bin its mean, and its least and greatest value with their half-intervals."""

    def __init__(self, grid: Grid) -> None:
        self._grid = grid
        self._low, self._high = np.full(grid.n, inf), np.full(grid.n, -inf)
        self._total, self._count = np.zeros(grid.n), np.zeros(grid.n)
        self.values = 0
        self.latest = self.latest_half = 0.0
        self.damping: tuple[float, float | None] | None = None
        """Latest damping ratio of the mode, with its standard deviation."""
        self.mode: int | None = None
        """Number of the model's mode whose frequency it is, 1 = lowest; None for any other quantity or mode."""

    @property
    def range(self) -> tuple[float, float]:
        """Least and greatest value, with their half-intervals."""
        return float(self._low.min()), float(self._high.max())

    def add(self, at: int, value: float, half: float = 0.0) -> None:
        """Add a value with its half-interval to bin `at`."""
        self._low[at] = min(self._low[at], value - half)
        self._high[at] = max(self._high[at], value + half)
        self._total[at] += value
        self._count[at] += 1
        self.values, self.latest, self.latest_half = self.values + 1, value, half

    def drawn(self) -> tuple[Annotated[Array, "k"], list[Annotated[Array, "k"]]]:
        """Return the times, and low, mean and high, with NaN where more than one bin in between is empty."""
        use, edges = np.flatnonzero(self._count), self._grid.edges_ns
        t_ns, cuts = 0.5 * edges[use] + 0.5 * edges[use + 1], np.flatnonzero(np.diff(use) > 2) + 1
        times = np.insert(t_ns, cuts, 0.5 * (t_ns[cuts - 1] + t_ns[cuts]))
        sides = self._low[use], self._total[use] / self._count[use], self._high[use]
        return times, [np.insert(values, cuts, np.nan) for values in sides]


@dataclass(slots=True)
class PeriodResults:
    """Results in results.jsonl over a period."""

    grid: Grid
    hop_s: float
    begun_ns: int
    """UTC of one hop before the end of the run's first window."""
    course: Course = field(default_factory=Course)
    """The windows, as far as the state depends on them, and the alarm episodes."""
    judged: list[int] = field(init=False)
    """Number of judged windows in each bin."""
    refused: list[int] = field(init=False)
    """Number of skipped windows in each bin."""
    modes: list[Curve] = field(default_factory=list)
    """Frequencies with two standard deviations, Hz."""
    ddi: list[Curve] = field(default_factory=list)
    """Damage index of each story, with two standard deviations."""
    stiffness: list[Curve] = field(default_factory=list)
    """Stiffness of each story, N/m, with two standard deviations."""
    changes: list[Curve] = field(default_factory=list)
    """Change of each mode's frequency, or feature, since the baseline, with two standard deviations, where there is no model."""
    residuals: list[Curve] = field(default_factory=list)
    """What the covariates leave of each feature, in healthy standard deviations."""
    covariates: dict[str, Curve] = field(default_factory=dict)
    """Temperature, level and named covariates of every window, judged or not."""
    misfit: Curve | None = None
    damaged: int = 0
    """Number of lines that cannot be read."""
    no_baseline: bool = False
    between: Sequence[tuple[int, int]] = ()
    """Ends of the times between a replay's recordings, UTC in ns."""
    window_s: float = 0.0
    """Length of a window; 0 where the run does not state it."""
    _tracks: dict[int, Curve] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.judged, self.refused = [0] * self.grid.n, [0] * self.grid.n

    @property
    def due(self) -> int:
        """Number of windows that an unbroken stream would have given since the run began; none between a replay's recordings."""
        ends_ns = max(self.grid.from_ns, self.begun_ns), self.grid.to_ns
        count = due_windows(ends_ns, self.begun_ns, round(self.hop_s * 1e9), self.window_s, self.between)
        return max(self.course.windows, count)

    def add(self, line: Mapping[str, Any]) -> None:
        """Add the values of one line of results.jsonl; a line that cannot be read adds nothing."""
        t_ns, skipped = int(line["t_end_ns"]), line["skipped"] is not None
        if skipped and reaches_between(t_ns, self.window_s, self.between):
            return
        at = self.grid.at(t_ns)
        self._add_modes(at, line)
        for name, value in (line.get("covariates") or {}).items():
            if value is not None:
                self.covariates.setdefault(name, Curve(self.grid)).add(at, value)
        (self.refused if skipped else self.judged)[at] += 1
        if skipped:
            return
        of_parts = (self.ddi, "ddi", "ddi_std"), (self.stiffness, "stiffness_n_per_m", "stiffness_std")
        changes = ((self.changes, f"{of}_change", f"{of}_change_std") for of in ("frequency", "feature"))
        for curves, key, std in (*of_parts, *changes):
            self._add_each(curves, at, line.get(key) or (), line.get(std) or ())
        sigma = line.get("residual_sigma") or ()
        self._add_each(self.residuals, at, sigma, [0.0] * len(sigma))
        if (misfit := line.get("misfit")) is not None:
            self.misfit = self.misfit or Curve(self.grid)
            self.misfit.add(at, misfit)

    def _add_modes(self, at: int, line: Mapping[str, Any]) -> None:
        """Add the frequencies of the model's modes and of the others."""
        tracks = line.get("mode_tracks") or []
        frequencies, stds = line.get("frequencies_hz") or [], line.get("frequencies_std_hz") or []
        dampings = list(zip(line.get("damping_ratio") or (), line.get("damping_std") or (), strict=False))
        numbers = line.get("model_modes") or range(1, len(frequencies) + 1)
        for i, (mode, f, std) in enumerate(zip(numbers, frequencies, stds, strict=True)):
            curve = self._mode(tracks[i] if i < len(tracks) else -1 - mode, f)
            curve.add(at, f, 2.0 * (std or 0.0))
            curve.mode, curve.damping = mode, dampings[i] if i < len(dampings) else None
        for other in line.get("other_modes") or []:
            f, std = other["frequency_hz"], other["frequency_std_hz"]
            self._mode(other["track"], f, _SAME_OTHER_MODE).add(at, f, 2.0 * (std or 0.0))

    def _add_each(self, curves: list[Curve], at: int, values: Sequence[Any], stds: Sequence[Any]) -> None:
        """Add the values of all stories or modes to their curves, which the first of them makes; None is not known."""
        curves += [Curve(self.grid) for _ in values] if not curves else []
        for curve, value, std in zip(curves, values, stds, strict=False):
            if value is not None and std is not None:
                curve.add(at, value, 2.0 * std)

    def _mode(self, track: int, frequency: float, apart: float = _SAME_MODE) -> Curve:
        """Find the curve that a frequency continues: the curve of its track, else the nearest one, else a new one."""
        if track in self._tracks:
            return self._tracks[track]
        near = [c for c in self.modes if abs(frequency - c.latest) < apart * c.latest]
        curve = min(near, key=lambda c: abs(frequency - c.latest), default=None)
        if curve is None:
            curve = Curve(self.grid)
            self.modes.append(curve)
        if track != -1:
            self._tracks[track] = curve
        return curve

    def common_modes(self) -> list[Curve]:
        """Return the curves of the modes that are identified most often, by ascending frequency."""
        common = [c for c in self.modes if c.values >= 0.02 * self.course.windows]
        most_frequent = sorted(common, key=lambda c: -c.values)[:_MAX_MODES]
        return sorted(most_frequent, key=lambda c: c.latest)


def read_results(
    folder: Path,
    from_ns: int | None,
    to_ns: int | None,
    known: Known,
    between: Sequence[tuple[int, int]] = (),
    window_s: float = 0.0,
) -> PeriodResults:
    """Read results.jsonl of a folder, and its closed months; windows belong to the period (UTC) in which they end.

    By default the period is that of the run.  A replay has times `between` its recordings, UTC in ns, and windows of
    `window_s`.

    Raises MissingInputError if the file does not exist, BadInputError if no window ends in the period, the files hold no
    results, or a packed month is damaged.
    """
    path = folder / RESULTS
    try:
        first_ns, last_ns, hop_s = _extent(folder)
        begun_ns = first_ns - round(hop_s * 1e9)
        start = begun_ns if from_ns is None else from_ns
        stop = last_ns if to_ns is None else to_ns
        gaps = _shortened_gaps(folder, start, stop, round(hop_s * 1e9))
        length_s = (stop - start - sum(b - a for a, b in gaps)) * 1e-9
        grid = Grid(start, max(stop, start + 1), int(np.clip(length_s / hop_s, 1, MAX_BINS)), gaps)
        results = PeriodResults(grid, hop_s, begun_ns, between=between, window_s=window_s)
        for raw in _lines_between(read_all_lines(folder), start, stop):
            try:
                line = read_line(raw)
                if line["skipped"] is None or not reaches_between(line["t_end_ns"], window_s, between):
                    course = follow(results.course, facts_of_line(line), known)
                    results.add(line)
                    results.course = course
                    if line["skipped"] is None:
                        results.no_baseline = line["alarm"]["reason"].startswith("no baseline")
            except (ValueError, KeyError, TypeError, IndexError):
                results.damaged += 1
    except OSError as error:
        raise MissingInputError(
            f"{error.filename or path}: {error.strerror}; give the folder that 'replay --out' or [output] dir names"
        ) from error
    if not results.course.windows:
        has = f"it has {utc(first_ns)} to {utc(last_ns)}"
        raise BadInputError(f"{path}: no window ends within the period; {has} UTC: change --from and --to")
    return results


def _lines_between(lines: Iterator[bytes], start: int, stop: int) -> Iterator[bytes]:
    """Select the complete lines whose windows end in ``(start, stop]``, UTC in ns, and those that do not say when."""
    for raw in lines:
        found = _T_END.search(raw)
        if raw.endswith(b"\n") and (found is None or start < int(found[1]) <= stop):
            yield raw


def _shortened_gaps(folder: Path, start: int, stop: int, hop_ns: int) -> list[tuple[int, int]]:
    """List the gaps that would leave a chart empty: each is longer than all that lies outside them.  UTC in ns, in order."""
    lines = _lines_between(read_all_lines(folder), start, stop)
    ends = (int(found[1]) for raw in lines if (found := _T_END.search(raw)) is not None)
    steps = ((a, b - hop_ns) for a, b in pairwise(ends) if b - hop_ns > a)
    longest = nlargest(_MOST_GAPS, steps, key=lambda gap: gap[1] - gap[0])
    left, cut = stop - start, 0
    for k, (a, b) in enumerate(longest, start=1):
        left -= b - a
        cut = k if b - a > left else cut
    return sorted(longest[:cut])


def _extent(folder: Path) -> tuple[int, int, float]:
    """Read the ends of the first and the last window, UTC in ns, and the hop in s."""
    path = folder / RESULTS
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - _TAIL_BYTES))
        tail = _T_END.findall(file.read())
    for file_lines in map(read_lines, (path, *reversed(closed_files(folder)))):
        if not tail:  # the present month has no window yet, or a damaged line is longer than that
            tail = [found[1] for raw in file_lines if (found := _T_END.search(raw))][-1:]
    lines = read_all_lines(folder)
    head = [int(found[1]) for _, raw in zip(range(_HEAD), lines, strict=False) if (found := _T_END.search(raw))]
    if not head or not tail:
        raise BadInputError(f"{path}: no results in it; was the recording shorter than a window?")
    steps = [b - a for a, b in pairwise(head) if b > a]
    hop_ns = sorted(steps)[len(steps) // 2] if steps else 10_000_000_000
    return head[0], max(int(tail[-1]), head[0]), hop_ns * 1e-9


def utc(t_ns: float) -> str:
    """Write a time to the second, ISO 8601 without its zone."""
    return str(np.datetime64(round(t_ns * 1e-9), "s")).replace("T", " ")
