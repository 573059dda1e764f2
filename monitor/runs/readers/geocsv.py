"""Reads GeoCSV, tables of text whose '#' lines state units, rate and start; a file may hold several series in turn."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import zip_longest

from monitor.core import BadInputError
from monitor.runs.readers import clocks, delimited, stamps
from monitor.runs.readers.base import File
from monitor.runs.readers.dialect import MARKS, Column, Dialect, Role, is_missing, is_number, split
from monitor.runs.readers.table import Table
from monitor.runs.readers.units import TIME, unit_of

_BEGIN = re.compile(rb"(?:\xef\xbb\xbf)?\s*#\s*dataset\s*:\s*GeoCSV", re.IGNORECASE)
_KEYWORD = re.compile(r"\s*#\s*([^:]+?)\s*:\s*(.*?)\s*")


class GeoCsv:
    """GeoCSV: series as sample-value pairs with their times (tspair), as lists without (slist), or a table of any columns."""

    name = "GeoCSV"

    def is_mine(self, file: File) -> bool:
        """Test whether the first line states the format."""
        return _BEGIN.match(file.raw) is not None

    def read(self, file: File) -> list[Table]:
        """Convert the series; those of one channel are joined in time."""
        lines = delimited.lines_of(delimited.decode(file.path, file.raw))
        is_head = [line.lstrip().startswith("#") for line in lines]
        begins = [at for at, head in enumerate(is_head) if head and not (at and is_head[at - 1])]
        channels: dict[tuple[str, ...], list[Table]] = {}
        notes: list[str] = []
        for begin, end in zip(begins, [*begins[1:], len(lines)], strict=True):
            table = _series(replace(file, on_warning=notes.append), lines, begin, end)
            channels.setdefault(table.columns, []).append(table)
        joined = [table for tables in channels.values() for table in clocks.follow(tables, notes.append)]
        for note in dict.fromkeys(notes):  # most are those of every series
            file.on_warning(note)
        return joined


def _series(file: File, lines: list[str], begin: int, end: int) -> Table:
    """Convert the series between two lines, of which the head states the dialect."""
    first = next((at for at in range(begin, end) if not lines[at].lstrip().startswith("#")), end)
    numbers = [at + 1 for at in range(first + 1, end) if lines[at].strip()]
    if not numbers:
        raise BadInputError(f"{file.path}: line {begin + 1}: a head without readings; the file is cut")
    told = {match[1].casefold(): match[2] for match in map(_KEYWORD.fullmatch, lines[begin:first]) if match is not None}
    mark = told.get("delimiter", "") or ","
    mark = {"\\t": "\t", "tab": "\t"}.get(mark, mark)
    if mark not in MARKS:
        raise BadInputError(f"{file.path}: line {begin + 1}: the delimiter {mark!r} is not known")
    try:
        rate_hz, count = float(told.get("sample_rate_hz", 0.0)), int(told.get("sample_count", 0))
        scale = float(told.get("scale_factor", 0.0))
    except ValueError as error:
        raise BadInputError(f"{file.path}: line {begin + 1}: its head is damaged: {error}") from error
    names, units, cells = (
        split(text, mark) for text in (lines[first], told.get("field_unit", ""), lines[numbers[0] - 1])
    )
    columns = [_column(*one) for one in zip_longest(names, units[: len(names)], cells[: len(names)], fillvalue="")]
    if "sid" in told and [column.role for column in columns].count(Role.READING) == 1:
        columns = [replace(one, name=told["sid"]) if one.role is Role.READING else one for one in columns]
    start = told.get("start_time", "")
    dialect = Dialect(file.path, mark, ".", "", first + 1, len(names), tuple(columns), rate_hz or None, start)
    for number in numbers:
        if (width := len(split(lines[number - 1], mark))) != len(names):
            raise BadInputError(f"{file.path}: line {number}: {width} cells where {len(names)} are expected")
    text = delimited.Text(file.path, [lines[number - 1] for number in numbers], numbers, dialect, ())
    table, *others = delimited.to_tables(text, file.on_warning, file.options.zone)
    if others:
        raise BadInputError(f"{file.path}: line {begin + 1}: a series with sensors of several clocks")
    if count and count != len(table.values):
        file.on_warning(f"{file.path}: states {count} samples and has {len(table.values)}")
    return _scaled(file, table, scale, told.get("scale_units", ""))


def _column(name: str, unit_text: str, cell: str) -> Column:
    """Say what a column holds, by its unit and the cell in its first row."""
    unit = unit_of(unit_text)
    if stamps.form_of(cell) is not None:
        return Column(name, Role.STAMP, None, unit_text, False, "dates and times")
    is_time = unit is not None and unit.quantity == TIME
    role = Role.TIME if is_time else Role.READING if is_number(cell) or is_missing(cell) else Role.TEXT
    return Column(name, role, unit, unit_text, False, "by its unit and its first cell")


def _scaled(file: File, table: Table, scale: float, unit: str) -> Table:
    """Convert counts by the sensitivity that a head states, counts of a unit, which is taken as flat."""
    if not scale or unit_of(unit) is None or any(table.quantity(name) != "counts" for name in table.columns):
        return table
    file.on_warning(f"{file.path}: its counts are converted by the sensitivity that it states, {scale:g} of a {unit}")
    return replace(table, values=table.values / scale, units=(unit,) * len(table.columns))
