"""Common form of all files that are read: columns of readings on one clock."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import BadInputError
from monitor.runs.readers.units import ACCELERATION, FORCE, ROTATION, Unit, unit_of

Array = NDArray[np.float64]
Ticks = NDArray[np.int64]
OnWarning = Callable[[str], None]

KNOWN_UNITS = {
    ACCELERATION: "m/s^2, g, mg, gal, cm/s^2, mm/s^2, ft/s^2, in/s^2",
    ROTATION: "rad/s, deg/s",
    FORCE: "N, kN, lbf",
}
"""Quantity -> units that a message names."""
_OTHER_NAME = re.compile(
    r"(.*gyro?.*|gy?_?[xyz]|omega.*|w[xyz]|.*mag(net.*)?|mag?_?[xyz]|roll|pitch|yaw|q(uat)?_?[0-3wxyz]|te?mp(erature)?.{0,4}"
    r"|hum(idity)?|rh|press(ure)?|baro.*|lat(itude)?|lon(g|gitude)?|alt(itude)?|speed|heading|gps.*|sats?|batt?(ery)?.*|v_?bat.*"
    r"|volt(age)?|status|state|flags?|event|error|quality|rssi|crc|checksum|table|result)",
    re.IGNORECASE,
)
"""Names of columns of other quantities, which count where others are left. [names; conventions of loggers]"""
_SAME = 1e-3
"""Distance, relative to its largest reading, within which a column is the magnitude of others. [1; rounding: four digits]"""
_FILLERS = (-7999.0, -9999.0, -99999.0, 9999.0, 99999.0, -6999.0, 7999.0, -999.0)
"""Numbers that loggers write for a missing reading. [numbers; Campbell: 7999 and -7999, COSMOS: -999, others by convention]"""
_ABSURD = 1e30
"""Reading from which a number stands for none. [any unit; as floating point's largest]"""
_APART = 10.0
"""Ratio to all other readings from which such a number is none of them. [1; judgement]"""


@dataclass(frozen=True, eq=False, slots=True)
class Table:
    """Readings of one file."""

    path: Path
    columns: tuple[str, ...]
    units: tuple[str, ...]
    """As stated in the file; empty if none is stated."""
    values: Annotated[Array, "n columns"]
    """In `units`; NaN where a reading is missing."""
    time_ns: Annotated[Ticks, "n"] | None = None
    """Time of each sample by the file's own clock; None without a clock."""
    index: Annotated[Ticks, "n"] | None = None
    """Sample counter of the device; None without a counter."""
    start_ns: int | None = None
    """UTC of the first sample, ns since 1970; None if the file does not state it."""
    rate_hz: float | None = None
    """As stated in the file; None if it does not state it."""
    start_text: str = ""
    """Time of the first sample as the file writes it, where it has no zone and is taken as UTC; else empty."""
    by_name: tuple[bool, ...] = ()
    """Of each column, whether its unit is part of its name."""
    is_scaled: bool = False
    """Whether counts were converted by --inventory."""
    chosen: tuple[str, ...] = ()
    """Columns that are used when the caller names none, where the units do not say it."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names by which a caller may refer to this file."""
        stem = self.path.stem
        for end in (".csv", ".txt", ".xlsx"):
            stem = stem.removesuffix(end)  # x.csv.zip
        return (stem, self.path.stem, self.path.name, str(self.path))

    @property
    def clock_ns(self) -> Annotated[Ticks, "n"]:
        """Times of a table that has them."""
        assert self.time_ns is not None
        return self.time_ns

    @property
    def default(self) -> tuple[str, ...]:
        """Columns that are accelerations: by their unit where any states one, else by their name; no magnitude of others."""
        if self.chosen:
            return self.chosen
        known = [unit_of(text) if text else None for text in self.units]
        if not any(self.units):
            found = tuple(name for name in self.columns if not _OTHER_NAME.fullmatch(name)) or self.columns
        else:
            moves = any(unit is not None and unit.quantity == ACCELERATION for unit in known)
            found = tuple(
                name
                for name, unit in zip(self.columns, known, strict=True)
                if unit is not None and unit.quantity == (ACCELERATION if moves else "counts")
            )
        magnitudes = self.magnitudes(found)
        return tuple(name for name in found if name not in magnitudes)

    def magnitudes(self, names: Iterable[str]) -> tuple[str, ...]:
        """Find the columns that are the magnitude of the others, by their readings."""
        at = [self.columns.index(name) for name in names]
        if len(at) not in (3, 4):
            return ()
        values = self.values[np.isfinite(self.values[:, at]).all(axis=1)][:, at]
        found = []
        for k in range(len(at)) if len(values) > 2 else ():
            size = np.sqrt((np.delete(values, k, axis=1) ** 2).sum(axis=1))
            if values[:, k].max() > 0.0 and np.abs(values[:, k] - size).max() <= _SAME * values[:, k].max():
                found.append(self.columns[at[k]])
        return tuple(found)

    def unit(self, column: str) -> str:
        """Return the unit that the file states of a column, empty if it states none; BadInputError if there is no such column."""
        if column not in self.columns:
            meant = meant_instead(column, self.columns)
            raise BadInputError(f"{self.path}: no column {column!r}{meant}; it has {', '.join(self.columns)}")
        return self.units[self.columns.index(column)]

    def is_by_name(self, column: str) -> bool:
        """Return whether a column's unit is part of its name."""
        return bool(self.by_name) and self.by_name[self.columns.index(column)]

    def quantity(self, column: str) -> str:
        """Return the quantity of a column by its unit; empty where the unit is not known, or none is stated."""
        unit = unit_of(self.unit(column))
        return "" if unit is None else unit.quantity

    def converted(self, column: str, quantity: str, unit: str, override: str | None = None) -> Annotated[Array, "n"]:
        """Convert a column to the SI unit of a quantity, from `unit` if it states none, from `override` in any case.

        Raises BadInputError for a column of another quantity, or of a unit that is not known.
        """
        stated = override or self.unit(column) or unit
        known = unit_of(stated)
        if known is None or known.quantity != quantity:
            raise BadInputError(
                f"{self.path}: column {column!r} has unit {stated!r}; known for {quantity}: {KNOWN_UNITS[quantity]}"
                + ("; --unit states it anew" if quantity == ACCELERATION else "")
            )
        return in_si(self.values[:, self.columns.index(column)], known)

    def of_columns(self, places: Sequence[int]) -> Table:
        """Select columns by their places."""
        return replace(
            self,
            columns=tuple(self.columns[at] for at in places),
            units=tuple(self.units[at] for at in places),
            by_name=tuple(self.by_name[at] for at in places),
            values=self.values[:, places],
        )

    def rows(self, keep: Annotated[Ticks, "m"]) -> Table:
        """Select rows; the start moves to the first of them."""
        start = self.start_ns
        if start is not None and self.time_ns is not None and len(keep):
            start += int(self.time_ns[keep[0]] - self.time_ns[0])
        return replace(
            self,
            values=self.values[keep],
            time_ns=None if self.time_ns is None else self.time_ns[keep],
            index=None if self.index is None else self.index[keep],
            start_ns=start,
        )


def in_si(values: Annotated[Array, "n"], unit: Unit) -> Annotated[Array, "n"]:
    """Convert readings to the unit in which their quantity is kept."""
    return values * unit.factor + unit.offset


def meant_instead(name: str, known: Iterable[str]) -> str:
    """Ask whether the known name that is most like an unknown one was meant; empty where none is like it.

    Examples
    --------
    >>> meant_instead("rooof", ["roof", "low"]), meant_instead("x", ["roof", "low"])
    (", did you mean 'roof'?", '')
    """
    near = get_close_matches(name, list(known), 1)
    return f", did you mean {near[0]!r}?" if near else ""


def without_fillers(table: Table, on_warning: OnWarning) -> Table:
    """Replace numbers that stand for no reading by NaN, and tell it."""
    values = table.values if table.values.flags.writeable else table.values.copy()
    for name, column in zip(table.columns, values.T, strict=True):
        absurd = np.abs(column) >= _ABSURD
        if absurd.any():
            on_warning(
                f"{table.path}: {name}: {np.count_nonzero(absurd)} readings are missing: {column[absurd][0]:g} stands for them"
            )
            column[absurd] = np.nan
        for filler in _FILLERS:
            held = column == filler
            if not held.any():
                continue
            rest = np.abs(column[~held & np.isfinite(column)])
            if rest.size and rest.max() * _APART < abs(filler):
                on_warning(
                    f"{table.path}: {name}: {np.count_nonzero(held)} readings are missing: {filler:g} stands for them"
                )
                column[held] = np.nan
    return replace(table, values=values)


def in_order(table: Table, on_warning: OnWarning) -> Table:
    """Leave out rows that stand twice, put rows in the order of their stamps, and tell both.

    Of readings that differ at one time, as of records that overlap, those that stand first in the file are kept.
    """
    if table.time_ns is None or (np.diff(table.time_ns) > 0).all():
        return table
    backwards = bool((np.diff(table.time_ns) < 0).any())
    order = np.argsort(table.time_ns, kind="stable")
    same_time = np.diff(table.time_ns[order]) == 0
    before, after = table.values[order[:-1][same_time]], table.values[order[1:][same_time]]
    same = ((after == before) | (np.isnan(after) & np.isnan(before))).all(axis=1)
    twice, differ = np.count_nonzero(same), np.count_nonzero(~same)
    if differ and not backwards:
        return table  # as of stamps that are cut
    if differ:
        on_warning(
            f"{table.path}: records overlap: {differ} samples stand twice with other readings; those that stand first are kept"
        )
    elif not twice:
        on_warning(f"{table.path}: its rows are not in the order of their times, and are put into it")
    if twice:
        on_warning(f"{table.path}: {twice} rows stand twice and are counted once")
    return table.rows(order[np.concatenate(([True], ~same_time))])
