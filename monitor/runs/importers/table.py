"""Common form of all imported files: columns of readings on one clock."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from math import radians
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import BadInputError

Array = NDArray[np.float64]
Ticks = NDArray[np.int64]
OnWarning = Callable[[str], None]

UNITS = {"m/s^2": 1.0, "m/s2": 1.0, "m/s²": 1.0, "m/s/s": 1.0, "ms-2": 1.0, "ms^-2": 1.0, "g": 9.80665}
FORCE_UNITS = {"n": 1.0, "kn": 1e3, "lbf": 4.4482216152605}
ROTATION_UNITS = {"rad/s": 1.0, "rad/sec": 1.0, "mrad/s": 1e-3, "deg/s": radians(1.0), "°/s": radians(1.0)}
ROTATION_UNITS |= {"deg/sec": radians(1.0), "dps": radians(1.0), "mdeg/s": radians(1e-3)}
UNITS |= {"mg": 9.80665e-3, "gal": 1e-2, "cm/s^2": 1e-2, "cm/s2": 1e-2, "mm/s^2": 1e-3, "mm/s2": 1e-3}
TICKS = {
    "s": 10**9,
    "sec": 10**9,
    "ms": 10**6,
    "msec": 10**6,
    "us": 1000,
    "\u03bcs": 1000,
    "usec": 1000,
    "ns": 1,
    "min": 60 * 10**9,
}
_SPELT = {"m_s2": "m/s^2", "m_s_2": "m/s^2", "ms2": "m/s^2", "mps2": "m/s^2", "cm_s2": "cm/s^2", "mm_s2": "mm/s^2"}
_SPELT |= {"rad_s": "rad/s", "mrad_s": "mrad/s", "deg_s": "deg/s", "kn": "kN", "lbf": "lbf"}
"""How names write units in which a stroke or a power is no letter; no N alone, which is north."""
_BEHIND = r"(.+?)[\s_/:.,-]+(?:in[\s_]+)?({})"
"""A name, and a unit behind it. [pattern]"""
_UNIT_BEHIND = re.compile(_BEHIND.format("|".join(map(re.escape, (*UNITS, *ROTATION_UNITS, *_SPELT)))), re.IGNORECASE)
_TICK_BEHIND = re.compile(_BEHIND.format("|".join(TICKS)), re.IGNORECASE)


@dataclass(frozen=True, eq=False, slots=True)
class Table:
    """Readings of one file."""

    path: Path
    columns: tuple[str, ...]
    units: tuple[str, ...]
    """As stated in the file; empty if none is stated."""
    values: Annotated[Array, "n columns"]
    """In `units`."""
    default: tuple[str, ...]
    """Columns that are used when the caller names none."""
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

    @property
    def names(self) -> tuple[str, ...]:
        """Names by which a caller may refer to this file."""
        stem = self.path.stem.removesuffix(".csv")  # x.csv.zip
        return (stem, self.path.stem, self.path.name, str(self.path))

    def unit(self, column: str) -> str:
        """Return the unit that the file states of a column, empty if it states none; BadInputError if there is no such column."""
        if column not in self.columns:
            meant = meant_instead(column, self.columns)
            raise BadInputError(f"{self.path}: no column {column!r}{meant}; it has {', '.join(self.columns)}")
        return self.units[self.columns.index(column)]

    def acceleration(self, column: str, unit: str) -> Annotated[Array, "n"]:
        """Convert a column, in `unit` if the file states none, to m/s^2 (errors as `_converted`)."""
        return self._converted(column, unit, unit_factor, "acceleration", UNITS)

    def force(self, column: str) -> Annotated[Array, "n"]:
        """Convert a column, in N if the file states no unit, to N (errors as `_converted`)."""
        return self._converted(column, "N", lambda unit: FORCE_UNITS.get(unit.strip().casefold()), "force", FORCE_UNITS)

    def rotation_rate(self, column: str) -> Annotated[Array, "n"]:
        """Convert a column to rad/s (errors as `_converted`)."""
        return self._converted(column, "", rotation_factor, "a rate of rotation", ROTATION_UNITS)

    def turns(self, column: str) -> bool:
        """Return whether the file states a unit of a rate of rotation for a column (errors as `unit`)."""
        return rotation_factor(self.unit(column)) is not None

    def _converted(
        self, column: str, unit: str, factor_of: Callable[[str], float | None], quantity: str, known: Iterable[str]
    ) -> Annotated[Array, "n"]:
        """Convert a column to the SI unit of a quantity, from `unit` if it states none; BadInputError for one of another."""
        stated = self.unit(column) or unit
        factor = factor_of(stated)
        if factor is None:
            raise BadInputError(
                f"{self.path}: column {column!r} has unit {stated!r}; known for {quantity}: {', '.join(known)}"
            )
        scaled: Array = self.values[:, self.columns.index(column)] * factor
        return scaled


def meant_instead(name: str, known: Iterable[str]) -> str:
    """Ask whether the known name that is most like an unknown one was meant; empty where none is like it.

    Examples
    --------
    >>> meant_instead("rooof", ["roof", "low"]), meant_instead("x", ["roof", "low"])
    (", did you mean 'roof'?", '')
    """
    near = get_close_matches(name, list(known), 1)
    return f", did you mean {near[0]!r}?" if near else ""


def units_in_names(names: Sequence[str]) -> list[str]:
    """Return the unit that each column's name ends with; empty where it ends with none.

    A single letter is no unit where another column's name differs in that letter alone.

    Examples
    --------
    >>> units_in_names(["ax_g", "acc_y_mg", "Accel in g", "roof", "a_m_s2"]), units_in_names(["ch_f", "ch_g"])
    (['g', 'mg', 'g', '', 'm/s^2'], ['', ''])
    """
    found = [_UNIT_BEHIND.fullmatch(name.strip()) for name in names]
    shared = Counter(name.strip()[:-1] for name in names)
    return [
        ""
        if match is None or (len(match[2]) == 1 and shared[match[0][:-1]] > 1)
        else _SPELT.get(match[2].casefold(), match[2])
        for match in found
    ]


def tick_in_name(name: str) -> tuple[str, int | None]:
    """Split a name of a time into what stands before its unit, and the unit, ns; None where it ends with none.

    Examples
    --------
    >>> tick_in_name("time_ms"), tick_in_name("t in us"), tick_in_name("timestamp")
    (('time', 1000000), ('t', 1000), ('timestamp', None))
    """
    match = _TICK_BEHIND.fullmatch(name.strip().casefold())
    return (name, None) if match is None else (match[1], TICKS[match[2]])


def unit_factor(unit: str) -> float | None:
    """Return the factor from `unit` to m/s^2; None if `unit` is no unit of acceleration.

    Examples
    --------
    >>> unit_factor("mg"), unit_factor("V")
    (0.00980665, None)
    """
    return UNITS.get(unit.strip().casefold().replace(" ", "").replace("**", "^"))


def rotation_factor(unit: str) -> float | None:
    """Return the factor from `unit` to rad/s; None if `unit` is no unit of a rate of rotation.

    Examples
    --------
    >>> rotation_factor("mrad/s"), rotation_factor("g")
    (0.001, None)
    """
    return ROTATION_UNITS.get(unit.strip().casefold().replace(" ", ""))


def sample_numbers(path: Path, time_ns: Annotated[Ticks, "n"]) -> tuple[float, Annotated[Ticks, "n"]]:
    """Estimate the sample rate of a clock, and number its samples.

    The rate is in Hz, and numbers begin at 0; lost samples leave a jump.  A clock is refused of which
    one sample in a thousand is off by more than 20 % of a step.

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
