"""Common form of all imported files: columns of readings on one clock."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from monitor.core import BadInputError

Array = NDArray[np.float64]
Ticks = NDArray[np.int64]
OnWarning = Callable[[str], None]

UNITS = {"m/s^2": 1.0, "m/s2": 1.0, "m/s²": 1.0, "m/s/s": 1.0, "ms-2": 1.0, "ms^-2": 1.0, "g": 9.80665}
FORCE_UNITS = {"n": 1.0, "kn": 1e3, "lbf": 4.4482216152605}
UNITS |= {"mg": 9.80665e-3, "gal": 1e-2, "cm/s^2": 1e-2, "cm/s2": 1e-2, "mm/s^2": 1e-3, "mm/s2": 1e-3}


@dataclass(frozen=True, eq=False, slots=True)
class Table:
    """Readings of one file."""

    path: Path
    columns: tuple[str, ...]
    units: tuple[str, ...]
    """Unit of each column as stated in the file; empty if none is stated."""
    values: Array
    """Readings, shape (n_samples, n_columns), in `units`."""
    default: tuple[str, ...]
    """Columns that are used when the caller names none."""
    time_ns: Ticks | None = None
    """Time of each sample by the file's own clock, shape (n_samples,), ns; None without a clock."""
    index: Ticks | None = None
    """Sample counter of the device, shape (n_samples,); None without a counter."""
    start_ns: int | None = None
    """UTC of the first sample, ns since 1970; None if the file does not state it."""
    rate_hz: float | None = None
    """Sample rate stated in the file, Hz; None if the file does not state it."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names by which a caller may refer to this file."""
        stem = self.path.stem.removesuffix(".csv")  # x.csv.zip
        return (stem, self.path.stem, self.path.name, str(self.path))

    def acceleration(self, column: str, unit: str) -> Array:
        """Convert a column to m/s^2, shape (n_samples,).

        Parameters
        ----------
        column : str
            Name of the column.
        unit : str
            Unit of the column if the file states none.

        Raises
        ------
        BadInputError
            If there is no such column, or its unit is no unit of acceleration.
        """
        return self._converted(column, unit, unit_factor, "acceleration", UNITS)

    def force(self, column: str) -> Array:
        """Convert a column to N, shape (n_samples,); a column without a unit is in N.

        Raises
        ------
        BadInputError
            If there is no such column, or its unit is no unit of force.
        """
        return self._converted(column, "N", lambda unit: FORCE_UNITS.get(unit.strip().casefold()), "force", FORCE_UNITS)

    def _converted(
        self, column: str, unit: str, factor_of: Callable[[str], float | None], quantity: str, known: Iterable[str]
    ) -> Array:
        """Convert a column to the SI unit of a quantity, shape (n_samples,); `unit` is that of a column without one."""
        if column not in self.columns:
            raise BadInputError(f"{self.path}: no column {column!r}; it has {', '.join(self.columns)}")
        at = self.columns.index(column)
        stated = self.units[at] or unit
        factor = factor_of(stated)
        if factor is None:
            raise BadInputError(
                f"{self.path}: column {column!r} has unit {stated!r}; known for {quantity}: {', '.join(known)}"
            )
        scaled: Array = self.values[:, at] * factor
        return scaled


def unit_factor(unit: str) -> float | None:
    """Return the factor from `unit` to m/s^2; None if `unit` is no unit of acceleration.

    Examples
    --------
    >>> unit_factor("mg"), unit_factor("V")
    (0.00980665, None)
    """
    return UNITS.get(unit.strip().casefold().replace(" ", "").replace("**", "^"))


def sample_numbers(path: Path, time_ns: Ticks) -> tuple[float, Ticks]:
    """Estimate the sample rate of a clock, and number its samples.

    Parameters
    ----------
    path : Path
        File of the clock, for messages.
    time_ns : array, shape (n,)
        Time of every sample, ns.

    Returns
    -------
    float
        Sample rate, Hz.
    array, shape (n,)
        Number of every sample from 0; lost samples leave a jump.

    Raises
    ------
    BadInputError
        If the clock is irregular: one sample in a thousand is off by more than 20 % of a step.

    Examples
    --------
    >>> sample_numbers(Path("a.csv"), np.array([0, 10_000_000, 30_000_000, 40_000_000]))
    (100.0, array([0, 1, 3, 4]))
    """
    steps = np.diff(time_ns)
    step = float(np.median(steps)) if steps.size else 0.0
    if step <= 0 or steps.min() <= 0:
        raise BadInputError(f"{path}: the time column does not rise throughout; mend it or give --rate")
    counts = np.maximum(np.rint(steps / step), 1).astype(np.int64)
    if np.quantile(np.abs(steps - counts * step), 0.999) > 0.2 * step:
        raise BadInputError(f"{path}: the time column is irregular (more than 20 % of a sample); give --rate")
    numbers = np.concatenate(([0], np.cumsum(counts)))
    # The mean over the whole file, because a single step is only as fine as the clock's ticks.
    rate = 1e9 * float(numbers[-1]) / float(time_ns[-1] - time_ns[0])
    nominal = float(round(rate))
    return (nominal if nominal and abs(rate / nominal - 1) < 1e-4 else round(rate, 6)), numbers


def join_tables(tables: list[Table], on_warning: OnWarning) -> tuple[list[Table], Ticks | None]:
    """Cut tables to their common samples.

    With clocks, only the samples whose times agree in all files within half a step are kept.  Without clocks, all files are
    assumed to begin at the same time.

    Returns
    -------
    list of Table
        Tables with n samples each.
    array, shape (n,), or None
        Common clock, ns; None without clocks.

    Raises
    ------
    BadInputError
        If only some files have a clock, the clocks run at different rates or not forwards, or the files have less than half of
        the shortest file in common.
    """
    clocks = [table.time_ns for table in tables if table.time_ns is not None]
    if len(tables) == 1:
        return tables, tables[0].time_ns
    shortest = min(len(table.values) for table in tables)
    if not clocks:
        if shortest != max(len(table.values) for table in tables):
            on_warning(f"files of different lengths without a clock: taken as begun together, cut to {shortest}")
        return [_select_rows(table, np.arange(shortest)) for table in tables], None
    if len(clocks) != len(tables):
        without = ", ".join(str(table.path) for table in tables if table.time_ns is None)
        raise BadInputError(f"{without}: no time column, but other files have one; give all or none")
    base = clocks[0]
    steps = [float(np.median(np.diff(clock))) for clock in clocks]
    if any((np.diff(clock) <= 0).any() for clock in clocks) or max(steps) > 1.02 * min(steps):
        each = "; ".join(
            f"{table.path}: {1e9 / step if step else 0:.2f} Hz" for table, step in zip(tables, steps, strict=True)
        )
        raise BadInputError(f"the files' times must rise throughout and have one rate: {each}")
    half = steps[0] / 2
    keep = np.ones(len(base), dtype=bool)
    partners = []
    for clock in clocks:
        right = np.clip(np.searchsorted(clock, base), 1, max(len(clock) - 1, 1))
        nearest = right - (base - clock[right - 1] < clock[np.minimum(right, len(clock) - 1)] - base)
        nearest = np.minimum(nearest, len(clock) - 1)
        keep &= np.abs(clock[nearest] - base) <= half
        partners.append(nearest)
    if keep.sum() * 2 < shortest:
        offsets = "; ".join(
            f"{table.path.name} starts {(clock[0] - base[0]) / 1e9:+.3f} s"
            for table, clock in zip(tables[1:], clocks[1:], strict=True)
        )
        raise BadInputError(
            f"the clocks of the files do not agree: they share {keep.sum()} of {shortest} samples. "
            f"Against {tables[0].path.name}: {offsets}. Record with synchronised sensors"
        )
    if keep.sum() < max(len(clock) for clock in clocks):
        on_warning(f"{keep.sum()} samples are common to all files; the others are left out")
    return [_select_rows(table, near[keep]) for table, near in zip(tables, partners, strict=True)], base[keep]


def _select_rows(table: Table, rows: NDArray[np.int64]) -> Table:
    """Select rows, shape (n,), of a table; its start moves to the first of these rows."""
    start = table.start_ns
    if start is not None and table.time_ns is not None and len(rows):
        start += int(table.time_ns[rows[0]] - table.time_ns[0])
    return Table(
        path=table.path,
        columns=table.columns,
        units=table.units,
        values=table.values[rows],
        default=table.default,
        time_ns=None if table.time_ns is None else table.time_ns[rows],
        index=None if table.index is None else table.index[rows],
        start_ns=start,
        rate_hz=table.rate_hz,
    )
