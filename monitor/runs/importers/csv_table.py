"""Reads delimited text of any dialect: delimiter, decimal comma, encoding, leading comments, dates."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import numpy as np

from monitor.core import BadInputError, utc_ns
from monitor.runs.importers.table import (
    TICKS,
    Array,
    OnWarning,
    Table,
    Ticks,
    rotation_factor,
    tick_in_name,
    unit_factor,
    units_in_names,
)

_NUMBER = re.compile(r"[+-]?(\d+[.,]?\d*|[.,]\d+)([eE][+-]?\d+)?|[+-]?(nan|inf)", re.IGNORECASE)
_DATE = re.compile(r"\d{1,4}[-./]\d{1,2}[-./]\d{1,4}([ T_]\d{1,2}:\d{2}.*)?")
_DATE_FORMATS = ("ISO", "%d.%m.%Y %H:%M:%S", "%Y/%m/%d %H:%M:%S", "%m/%d/%Y %H:%M:%S", "%d/%m/%Y %H:%M:%S")
_ZONE = re.compile(r"\b(utc|gmt)\b|(z|[+-]\d{2}:?\d{2})$", re.IGNORECASE)
"""Zone of a time, in its heading or behind it. [pattern; ISO 8601]"""
_HEADER = re.compile(r"(.*?)\s*(?:[\[(]([^\])]*)[\])])?\s*")
_TIME = re.compile(r"(t|time.*|zeit.*|date.*|datum.*|sampletimefine|elapsed.*)", re.IGNORECASE)
_COUNTER = re.compile(r"(|#|index|sample|samples|counter|packetcounter|nr\.?|no\.?|n)", re.IGNORECASE)
_CHUNK_CELLS = 1 << 15
"""Cells of the rows that are converted to numbers together. [count; cost: they take 3 MB]"""


@dataclass(frozen=True, slots=True)
class Cells:
    """Cells of a text file."""

    path: Path
    preamble: tuple[str, ...]
    """Lines before the rows."""
    header: tuple[str, ...]
    """Column names with units; empty without a header row."""
    lines: list[str]
    """Rows of data, one a line; cut into cells some at a time, since the cells of all rows take five times the memory."""
    delimiter: str | None
    """Mark between cells; None for white space."""
    first_line: int
    """Of the first row, counted from 1."""

    @property
    def first_row(self) -> list[str]:
        """Cells of the first row of data."""
        return _split(self.lines[0], self.delimiter)

    def column(self, at: int) -> list[str]:
        """Return the cells of a column, from the first row on."""
        return [_split(line, self.delimiter)[at] for line in self.lines]

    def numbers(self, column: int) -> Annotated[Array, "rows"]:
        """Convert one column to numbers (errors as `table`)."""
        return self.table([column])[:, 0]

    def table(self, columns: Sequence[int]) -> Annotated[Array, "rows columns"]:
        """Convert columns to numbers; an empty cell is a missing sample (NaN)."""
        out = np.empty((len(self.lines), len(columns)))
        step = max(1, _CHUNK_CELLS // len(self.first_row))
        for begin in range(0, len(self.lines), step):
            rows = [_split(line, self.delimiter) for line in self.lines[begin : begin + step]]
            for at, column in enumerate(columns):
                cells = [(row[column] or "nan").replace(",", ".") for row in rows]
                try:
                    out[begin : begin + len(rows), at] = np.array(cells, dtype=np.float64)
                except ValueError:
                    bad = next((k for k, cell in enumerate(cells) if not _NUMBER.fullmatch(cell)), 0)
                    raise BadInputError(
                        f"{self.path}: line {self.first_line + begin + bad}: {rows[bad][column][:40]!r} in column {column + 1} "
                        "is no number"
                    ) from None
        return out


def decode_text(path: Path, raw: bytes) -> str:
    """Decode a file's bytes: UTF-16 if they begin with its byte order mark, else UTF-8, cp1252 or latin-1."""
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        return raw.decode("utf-16", errors="replace")
    if not raw.strip():
        raise BadInputError(f"{path}: is empty")
    if b"\0" in raw:
        raise BadInputError(
            f"{path}: is no text table and no other known format (CSV, zipped CSV, NPZ, MAT, HDF5, UFF)"
        )
    for encoding in ("utf-8-sig", "cp1252"):
        try:
            return raw.decode(encoding)
        except UnicodeDecodeError:
            continue
    return raw.decode("latin-1")


def cut_into_cells(path: Path, text: str, on_warning: OnWarning) -> Cells:
    """Find delimiter, header and data rows of a text, and cut it into cells."""
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    while lines and not lines[-1].strip(" ,;\t"):
        lines.pop()
    # The end of the table shows its shape, because the head may be comments.  The last line may be incomplete.
    tail = [line for line in lines[-101:] if line.strip()][:-1] or lines
    delimiter = next((mark for mark in "\t;," if sum(mark in line for line in tail) * 2 > len(tail)), None)
    try:
        widths = [len(_split(line, delimiter)) for line in lines]
        tail_widths = Counter(
            n for n, line in zip(widths[-101:], lines[-101:], strict=True) if any(_split(line, delimiter))
        )
        width = tail_widths.most_common(1)[0][0] if tail_widths else 0
        first = next((at for at, n in enumerate(widths) if n == width and _is_data(_split(lines[at], delimiter))), None)
        if first is None:
            raise BadInputError(f"{path}: no rows of numbers found; is it a CSV table?")
        rows = [_split(line, delimiter) for line in lines[:first]]
    except csv.Error as error:
        raise BadInputError(f"{path}: {error}") from error
    head = next((at for at in range(first - 1, -1, -1) if any(rows[at])), None)
    header: list[str] = []
    # Some loggers end the header with a delimiter, but not the rows.
    if head is not None and (len(rows[head]) == width or rows[head][width:] == [""]):
        header = rows[head][:width]
        header[0] = header[0].lstrip("#% ") or header[0]  # comment mark of numpy.savetxt
        if any(map(_NUMBER.fullmatch, header)) and not any(_TIME.fullmatch(tick_in_name(name)[0]) for name in header):
            bad = next((cell for cell in header if not _NUMBER.fullmatch(cell)), header[0])
            raise BadInputError(f"{path}: line {head + 1}: {bad[:40]!r} is no number")
    preamble, body = tuple(lines[:first]), lines[first:]
    if len(body) > 1 and widths[-1] < width:
        on_warning(f"{path}: line {len(lines)} is cut short and left out")
        body.pop()
        widths.pop()
    for at, n in enumerate(widths[first:], first + 1):
        if n != width:
            raise BadInputError(f"{path}: line {at}: {n} cells where {width} are expected")
    return Cells(path, preamble, tuple(header), body, delimiter, first + 1)


def to_table(cells: Cells, on_warning: OnWarning) -> Table:
    """Convert cells to a table of numbers, with the time column, if there is one, as clock."""
    first_row = cells.first_row
    width = len(first_row)
    parts = [_HEADER.fullmatch(name) for name in cells.header]
    names = [part[1] if part else "" for part in parts] or [f"column{at + 1}" for at in range(width)]
    units = [(part[2] or "") if part else "" for part in parts] or [""] * width
    units = [
        unit.strip(" -").removeprefix("in ") or named for unit, named in zip(units, units_in_names(names), strict=True)
    ]
    dated = [at for at in range(width) if _DATE.fullmatch(first_row[at])]
    clock = next(iter(dated or [at for at in range(width) if _TIME.fullmatch(tick_in_name(names[at])[0])]), None)
    time_ns = start_ns = None
    start_text = ""
    if clock in dated and clock is not None:
        time_ns = _date_column(cells, clock)
        start_ns = int(time_ns[0])
        _warn_of_swapped_date(cells.path, start_ns, on_warning)
        named = f"{names[clock]} {units[clock]} {first_row[clock]}"
        start_text = "" if _ZONE.search(named) else first_row[clock]
    elif clock is not None:
        time_ns = _tick_column(cells, clock, names[clock], units[clock])
        if time_ns[0] > 10**18:  # seconds since 1970, after 2001
            start_ns = int(time_ns[0])
    kept = [at for at in range(width) if at != clock and not _COUNTER.fullmatch(names[at])]
    if not kept:
        raise BadInputError(f"{cells.path}: no column besides time and counter")
    columns = tuple(names[at] for at in kept)
    if len(set(columns)) != len(columns):
        raise BadInputError(f"{cells.path}: columns of the same name in the header: {', '.join(columns)}")
    default = columns
    if any(units[at] for at in kept):
        # Trust the units that a file states: columns such as strains and forces are no accelerations.
        default = tuple(names[at] for at in kept if unit_factor(units[at]) is not None) or columns
        others = [names[at] for at in kept if names[at] not in default and rotation_factor(units[at]) is None]
        if others:
            on_warning(f"{cells.path}: left out, since they have no unit of acceleration: {', '.join(others)}")
    return Table(
        path=cells.path,
        columns=columns,
        units=tuple(units[at] for at in kept),
        values=cells.table(kept),
        default=default,
        time_ns=time_ns,
        start_ns=start_ns,
        start_text=start_text,
    )


def _split(line: str, delimiter: str | None) -> list[str]:
    """Split a line into cells; without a delimiter, at white space."""
    if delimiter and '"' in line:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [""])]
    return [cell.strip(' \t"') for cell in (line.split(delimiter) if delimiter else line.split())]


def _is_data(row: list[str]) -> bool:
    """Test whether a row has numbers, and otherwise only dates or empty cells."""
    numbers = sum(bool(_NUMBER.fullmatch(cell)) for cell in row)
    others = sum(bool(cell) and not _NUMBER.fullmatch(cell) and not _DATE.fullmatch(cell) for cell in row)
    return numbers > 0 and others == 0


def _tick_column(cells: Cells, column: int, name: str, unit: str) -> Annotated[Ticks, "rows"]:
    """Convert a column of numbers in a unit of time to ns."""
    if name.casefold() == "sampletimefine":
        tick = TICKS["us"]
    else:
        tick = TICKS.get(unit.casefold(), 0) if unit else tick_in_name(name)[1] or TICKS["s"]
    if not tick:
        raise BadInputError(f"{cells.path}: unknown unit {unit!r} of column {name!r}; known: {', '.join(TICKS)}")
    seconds = cells.numbers(column)
    if not np.isfinite(seconds).all() or np.abs(seconds).max() > 4e18 / tick:
        bad = int(np.argmax(~np.isfinite(seconds)))
        raise BadInputError(f"{cells.path}: line {cells.first_line + bad}: no time in column {name!r}")
    ticks: Ticks = np.rint(seconds * tick).astype(np.int64)
    return ticks


def _date_column(cells: Cells, column: int) -> Annotated[Ticks, "rows"]:
    """Convert a column of dates to UTC, ns since 1970."""
    texts = cells.column(column)
    # One date format for the whole file, so that month and day are never exchanged within it.
    for form in _DATE_FORMATS:
        times = [_parse_date(text, form) for text in texts[:1]]
        if times[0] is not None and None not in (times := [_parse_date(text, form) for text in texts]):
            return np.array(times, dtype=np.int64)
    bad = next(
        (at for at, text in enumerate(texts) if not any(_parse_date(text, form) is not None for form in _DATE_FORMATS)),
        0,
    )
    raise BadInputError(f"{cells.path}: line {cells.first_line + bad}: {texts[bad][:40]!r} is no date")


def _parse_date(text: str, form: str) -> int | None:
    """Parse a date in the given format, in UTC unless it states a zone; return ns since 1970, None if it does not match."""
    try:
        if form != "ISO":
            clock, _, fraction = text.rpartition(":")[2].replace(",", ".").partition(".")
            whole = text.rpartition(":")[0] + ":" + clock
            text = datetime.strptime(whole, form).replace(microsecond=int(fraction[:6].ljust(6, "0"))).isoformat()
        return utc_ns(text)
    except ValueError:
        return None


def _warn_of_swapped_date(path: Path, start_ns: int, on_warning: OnWarning) -> None:
    """Warn if the date in the file's name is the start with day and month exchanged."""
    day = datetime.fromtimestamp(start_ns / 1e9, UTC).date()
    named = re.search(r"(\d{4})-(\d{2})-(\d{2})", path.name)
    if (
        named
        and (int(named[1]), int(named[2]), int(named[3])) == (day.year, day.day, day.month)
        and day.day != day.month
    ):
        on_warning(f"{path}: starts on {day}, but its name says {named[0]}: day and month seem swapped; see --start")
