"""Joins files by their clocks, and aligns clocks that do not agree by what the files hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations, pairwise
from pathlib import Path
from typing import Annotated

import numpy as np

from monitor.core import BadInputError
from monitor.runs.readers.table import Array, OnWarning, Table, Ticks
from monitor.signals import best_shift, sample_clock

_LEAST_CORRELATION = 0.1
"""Whitened correlation below which a shift is not believed. [1; judgement: unlike records of 20 s at 100 Hz reach 0.06]"""
_DOUBTFUL = 0.6
"""Share of the best correlation from which another shift may be the true one. [ratio; judgement]"""
_MOST_ALIGNED = 1 << 24
"""Most samples of a file to be aligned. [samples; cost: half a GB of memory]"""
_OFF = 0.1
"""Part of a sample by which channels lie apart and are told. [1; judgement: 0.6 rad of phase at the Nyquist rate]"""
_ONE_RATE = 1.02
"""Ratio of the rates of files up to which they are one. [ratio; judgement: stamps of few rows, cut to ms]"""


def follow(tables: list[Table], on_warning: OnWarning) -> list[Table]:
    """Join tables of the same columns that follow one another in time, as files of following days do.

    Each shares less than half of its time with the one before, of which the readings are then kept. Where several do not follow
    one another, each that states start and rate has a clock by these.
    """
    if len(tables) < 2:
        return tables
    tables = [_with_clock(table) for table in tables]
    if any(table.start_ns is None or table.time_ns is None for table in tables):
        return tables
    tables_in_time = sorted(tables, key=lambda table: table.start_ns or 0)
    times = [_times_ns(table) for table in tables_in_time]
    if len({(table.columns, table.units) for table in tables}) > 1 or not all(map(_follows, times, times[1:])):
        return tables
    _demand_one_rate(tables_in_time)
    names = ", ".join(dict.fromkeys(table.path.name for table in tables_in_time))
    on_warning(f"{names}: follow one another in time, and are joined")
    firsts = [0, *(_first_after(int(before[-1]), after) for before, after in pairwise(times))]
    if again := sum(firsts):
        on_warning(f"{names}: {again} samples stand twice; those of the file that begins first are kept")
    return [_joined(tables_in_time, times, firsts)]


def _joined(tables: Sequence[Table], times: Sequence[Ticks], firsts: Sequence[int]) -> Table:
    """Put tables, each from its row in `firsts` on, behind one another."""
    return replace(
        tables[0],
        values=np.concatenate([table.values[first:] for table, first in zip(tables, firsts, strict=True)]),
        time_ns=np.concatenate([t_ns[first:] for t_ns, first in zip(times, firsts, strict=True)]),
        index=None,
        start_text=next((table.start_text for table in tables if table.start_text), ""),
    )


def _with_clock(table: Table) -> Table:
    """Give a table that states start and rate the times that follow from them."""
    if table.time_ns is not None or table.start_ns is None or table.rate_hz is None:
        return table
    steps = np.rint(np.arange(len(table.values)) * (1e9 / table.rate_hz)).astype(np.int64)
    return replace(table, time_ns=table.start_ns + steps)


def _follows(before: Annotated[Ticks, "n"], after: Annotated[Ticks, "m"]) -> bool:
    """Test whether times share less than half of their length, or that of the others, with the times before them."""
    length_ns = min(before[-1] - before[0], after[-1] - after[0])
    return bool(before[-1] - after[0] <= length_ns / 2)


def _first_after(end_ns: int, t_ns: Annotated[Ticks, "n"]) -> int:
    """Return the place of the first of some times that lies half a step or more behind an end."""
    step_ns = float(np.median(np.diff(t_ns))) if len(t_ns) > 1 else 0.0
    return int(np.searchsorted(t_ns, end_ns + step_ns / 2, side="left"))


def _demand_one_rate(tables: Sequence[Table]) -> None:
    """Raise BadInputError if files run at several rates, each as stated or by its times."""
    rates = [table.rate_hz or _rate_hz(table) for table in tables]
    told = [rate for rate in rates if rate]
    if told and max(told) > _ONE_RATE * min(told):
        names = [table.path.name for table in tables]
        shown = names if len(set(names)) > 1 else [", ".join(table.columns) for table in tables]
        each = ", ".join(f"{name} {rate:.6g} Hz" for name, rate in zip(shown, rates, strict=True) if rate)
        raise BadInputError(
            f"{tables[0].path}: several rates: {each}; import those of one rate, or name them by --channel"
        )


def _rate_hz(table: Table) -> float:
    """Return the rate by a table's times; 0 where they tell none."""
    try:
        return 0.0 if table.time_ns is None else sample_clock(table.time_ns).rate_hz
    except BadInputError:
        return 0.0


def _times_ns(table: Table) -> Annotated[Ticks, "n"]:
    """Return the times of a table with a clock, UTC where it states its start."""
    return table.clock_ns + (0 if table.start_ns is None else table.start_ns - table.clock_ns[0])


def tell_apart(path: Path, samples: float, on_warning: OnWarning) -> None:
    """Tell by how much of a sample channels lie apart in time, where it matters."""
    if samples > _OFF:
        on_warning(
            f"{path}: channels are sampled up to {samples:.2g} of a sample apart; phases of shapes are off by that"
        )


def join(tables: list[Table], on_warning: OnWarning) -> tuple[list[Table], Annotated[Ticks, "n"] | None]:
    """Cut tables to their common samples, and return them with their common clock, ns; None without clocks.

    With clocks, only the samples whose times agree in all files within half a step are kept. Without clocks, all files are
    assumed to begin at the same time.
    """
    if len(tables) == 1:
        return tables, tables[0].time_ns
    _demand_one_rate(tables)
    shortest, *_, longest = sorted(len(table.values) for table in tables)
    clocks = _clocks(tables)
    if not clocks:
        if shortest != longest:
            on_warning(f"files of different lengths without a clock: taken as begun together, cut to {shortest}")
        return [table.rows(np.arange(shortest)) for table in tables], None
    base = clocks[0]
    half_ns = _step_ns(tables[0].path, base) / 2
    partners = [_nearest(clock, base) for clock in clocks]
    off_ns = np.max([np.abs(clock[at] - base) for clock, at in zip(clocks, partners, strict=True)], axis=0)
    keep = off_ns <= half_ns
    if keep.sum() * 2 < shortest:
        raise BadInputError(
            f"the clocks of the files do not agree: they share {keep.sum()} of {shortest} samples. {_apart(tables, clocks)} "
            "Record with synchronised sensors, or give --align, which shifts the files until their readings fit each other"
        )
    if keep.sum() < longest:
        on_warning(f"{keep.sum()} samples are common to all files; the others are left out")
    tell_apart(tables[0].path, float(np.median(off_ns[keep])) / (2.0 * half_ns), on_warning)
    return [table.rows(near[keep]) for table, near in zip(tables, partners, strict=True)], base[keep]


def _step_ns(path: Path, clock: Annotated[Ticks, "n"]) -> float:
    try:
        return 1e9 / sample_clock(clock).rate_hz
    except BadInputError as error:
        raise BadInputError(f"{path}: its times are irregular: {error}") from error


def _clocks(tables: Sequence[Table]) -> list[Ticks]:
    """Return the times of all tables, or none; BadInputError where some have a clock and others none."""
    clocks = [table.time_ns for table in tables if table.time_ns is not None]
    if 0 < len(clocks) < len(tables):
        without = ", ".join(str(table.path) for table in tables if table.time_ns is None)
        raise BadInputError(f"{without}: no time column, but other files have one; give all or none")
    return clocks


def _nearest(clock: Annotated[Ticks, "m"], base: Annotated[Ticks, "n"]) -> Annotated[Ticks, "n"]:
    """Return the places in a clock that are nearest to the times of another one."""
    last = len(clock) - 1
    right = np.clip(np.searchsorted(clock, base), min(1, last), last)
    left = np.maximum(right - 1, 0)
    return np.where(base - clock[left] < clock[right] - base, left, right)


def _apart(tables: Sequence[Table], clocks: Sequence[Ticks]) -> str:
    """Say how far the clocks of files lie apart, which of them overlap, and for how long."""
    spans = {table.path.name: (int(t[0]), int(t[-1])) for table, t in zip(tables, clocks, strict=True)}
    (first, (begin, _)), *others = spans.items()
    starts = "; ".join(f"{name} starts {(span[0] - begin) / 1e9:+.3f} s" for name, span in others)
    shared = [
        (one, other, (min(spans[one][1], spans[other][1]) - max(spans[one][0], spans[other][0])) / 1e9)
        for one, other in combinations(spans, 2)
    ]
    told = ", ".join(f"{one} with {other} ({length_s:.1f} s)" for one, other, length_s in shared if length_s > 0)
    if told:
        return f"Against {first}: {starts}. By their clocks these overlap: {told}."
    return (
        f"Against {first}: {starts}. By their clocks no two files overlap; those that follow one another are joined "
        "where each states its date, and all the same columns and units."
    )


def align(tables: list[Table], columns: Sequence[tuple[Table, str]], on_warning: OnWarning) -> list[Table]:
    """Shift the clock of each file so that its readings fit those of the first file best, by their correlation.

    Each file has a clock, and is compared by its column among `columns`, else by the first of its default columns. Clocks are
    shifted by whole steps; half a step remains unknown. `on_warning` is told of each shift and of its correlation, for the user
    to judge.
    """
    tables = [_with_clock(table) for table in tables]
    if len(tables) < 2 or any(table.time_ns is None for table in tables):
        raise BadInputError(f"{tables[0].path}: --align is for several files, each with a column of time")
    chosen = {id(table): column for table, column in reversed(columns)}
    base, *others = tables
    step_ns = float(np.median(np.diff(base.clock_ns)))
    reference = _on_grid(base, chosen.get(id(base)), step_ns)
    aligned = [base]
    for table in others:
        steps = np.diff(table.clock_ns)
        if steps.min() <= 0 or not 1 / 1.02 < float(np.median(steps)) / step_ns < 1.02:
            raise BadInputError(f"{table.path}: its times must rise throughout at the rate of {base.path.name}")
        found = best_shift(reference, _on_grid(table, chosen.get(id(table)), step_ns))
        if abs(found.correlation) < _LEAST_CORRELATION:
            raise BadInputError(
                f"{table.path}: its readings fit those of {base.path.name} nowhere (correlation {found.correlation:.2f}); "
                "--align needs a motion that both took"
            )
        moved_ns = int(base.clock_ns[0]) + round(found.shift * step_ns) - int(table.clock_ns[0])
        told = f"{table.path.name}: clock shifted by {moved_ns / 1e9:+.3f} s to fit {base.path.name}"
        if abs(found.other_correlation) > _DOUBTFUL * abs(found.correlation):
            other_s = (found.other - found.shift) * step_ns / 1e9
            told += f", or by {other_s:+.3f} s more, which fits nearly as well: shapes and phases of modes are in doubt"
        on_warning(f"{told} (correlation {found.correlation:.2f}; half a sample remains unknown)")
        start_ns = None if table.start_ns is None else table.start_ns + moved_ns
        aligned.append(replace(table, time_ns=table.clock_ns + moved_ns, start_ns=start_ns))
    return aligned


def _on_grid(table: Table, column: str | None, step_ns: float) -> Annotated[Array, "n"]:
    """Return a column on a regular grid of its clock, without its mean; 0 where a reading is missing."""
    values = table.values[:, table.columns.index(column or table.default[0])]
    place = np.rint((table.clock_ns - table.clock_ns[0]) / step_ns).astype(np.int64)
    if place.min() < 0 or place[-1] >= _MOST_ALIGNED:
        raise BadInputError(f"{table.path}: its times jump or do not rise; --align cannot use them")
    grid, finite = np.zeros(int(place.max()) + 1), np.isfinite(values)
    if finite.any():
        grid[place[finite]] = values[finite] - values[finite].mean()
    return grid
