"""Reads GeoCSV, tables of text whose '#' lines state units, rate and start; a file may hold several series in turn."""

from __future__ import annotations

import re
from dataclasses import replace

from monitor.core import BadInputError
from monitor.runs.readers import clocks, delimited, stamps
from monitor.runs.readers.base import File
from monitor.runs.readers.table import Table
from monitor.runs.readers.units import unit_of

_BEGIN = re.compile(rb"(?:\xef\xbb\xbf)?\s*#\s*dataset\s*:\s*GeoCSV", re.IGNORECASE)
_KEYWORD = re.compile(r"\s*#\s*([^:]+?)\s*:\s*(.*?)\s*")
_UTC = re.compile(r"UTC|ISO[ _]?8601", re.IGNORECASE)
"""Unit of a column of dates. [pattern; GeoCSV 2.0]"""


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
            table = _series(replace(file, on_warning=notes.append), lines[:end], begin)
            channels.setdefault(table.columns, []).append(table)
        joined = [table for tables in channels.values() for table in clocks.follow(tables, notes.append)]
        for note in dict.fromkeys(notes):  # most are those of every series
            file.on_warning(note)
        return joined


def _series(file: File, lines: list[str], begin: int) -> Table:
    """Convert the series whose head begins at a line."""
    first = next((at for at in range(begin, len(lines)) if not lines[at].lstrip().startswith("#")), len(lines))
    told = {match[1].casefold(): match[2] for match in map(_KEYWORD.fullmatch, lines[begin:first]) if match is not None}
    if first == len(lines):
        raise BadInputError(f"{file.path}: line {begin + 1}: a head without readings; the file is cut")
    mark = told.get("delimiter", "") or ","
    mark = {"\\t": "\t", "tab": "\t", "comma": ","}.get(mark, mark)
    names, units = ([cell.strip() for cell in text.split(mark)] for text in (lines[first], told.get("field_unit", "")))
    units += [""] * (len(names) - len(units))
    heads = [
        f"{name} [UTC]" if "UTC" in unit else name if not unit or _UTC.search(unit) else f"{name} [{unit}]"
        for name, unit in zip(names, units, strict=False)
    ]
    # Empty lines in place of what stands before keep the numbers of lines in messages.
    text = "\n".join([*[""] * first, mark.join(heads), *lines[first + 1 :]])
    cut = delimited.cut(file.path, text, file.on_warning, file.options.time)
    table = delimited.to_table(cut, file.on_warning, file.options.zone)
    try:
        rate_hz = float(told.get("sample_rate_hz", 0.0)) or table.rate_hz
        stated, scale = int(told.get("sample_count", len(table.values))), float(told.get("scale_factor", 0.0))
        start = (
            stamps.parse([told["start_time"]], file.options.zone)
            if table.start_ns is None and "start_time" in told
            else None
        )
    except ValueError as error:
        raise BadInputError(f"{file.path}: line {begin + 1}: its head is damaged: {error}") from error
    if stated != len(table.values):
        file.on_warning(f"{file.path}: states {stated} samples and has {len(table.values)}")
    if start is not None:
        table = replace(table, start_ns=int(start.t_ns[0]), start_text="" if start.has_zone else told["start_time"])
    if len(table.columns) == 1 and "sid" in told:
        table = replace(table, columns=(told["sid"],))
    return _scaled(file, replace(table, rate_hz=rate_hz), scale, told.get("scale_units", ""))


def _scaled(file: File, table: Table, scale: float, unit: str) -> Table:
    """Convert counts by the sensitivity that a head states, counts of a unit, which is taken as flat."""
    if not scale or unit_of(unit) is None or any(table.quantity(name) != "counts" for name in table.columns):
        return table
    file.on_warning(f"{file.path}: its counts are converted by the sensitivity that it states, {scale:g} of a {unit}")
    return replace(table, values=table.values / scale, units=(unit,) * len(table.columns))
