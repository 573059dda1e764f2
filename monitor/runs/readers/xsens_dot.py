"""Reads the Xsens DOT dialect of CSV: a packet counter, a microsecond clock of 32 bit, local start time, no units."""

from __future__ import annotations

import re
from dataclasses import replace
from datetime import tzinfo

import numpy as np

from monitor.core import BadInputError
from monitor.runs.readers.delimited import Text, to_tables
from monitor.runs.readers.dialect import Column, Role
from monitor.runs.readers.table import OnWarning, Table
from monitor.runs.readers.units import unit_of

_START = re.compile(r"StartTime:[\s,;]*(\d{4}-\d{2}-\d{2})_(\d{2}:\d{2}:\d{2})_(\d{3})\s*(\w*)")
_COLUMNS = {
    "PacketCounter": (Role.COUNTER, ""),
    "SampleTimeFine": (Role.TIME, "us"),
    "Acc_": (Role.READING, "m/s^2"),
    "Gyr_": (Role.READING, "deg/s"),
}
"""Begin of a column's name -> what it holds, and its unit. [names; Xsens DOT]"""


def is_xsens(text: Text) -> bool:
    """Test whether the header is that of Xsens DOT."""
    return {"PacketCounter", "SampleTimeFine"} <= {column.name for column in text.dialect.columns}


def to_table(text: Text, on_warning: OnWarning, zone: tzinfo | None) -> Table:
    """Convert a text to a table of accelerations and rates of rotation; the default column is Acc_X (errors as `to_tables`)."""
    dialect = replace(text.dialect, columns=tuple(map(_stated, text.dialect.columns)), start_text=_start_text(text))
    (table,) = to_tables(replace(text, dialect=dialect), on_warning, zone)
    moved = [at for at, name in enumerate(table.columns) if name.startswith("Acc_")]
    if not moved:
        raise BadInputError(f"{text.path}: no Acc_ column; export the free or calibrated acceleration")
    # The device writes the orientation before its first acceleration is available: that row is all zeros, even gravity.
    first = int(len(table.values) > 1 and not table.values[0, moved].any())
    chosen = "Acc_X" if "Acc_X" in table.columns else table.columns[moved[0]]
    return replace(table.rows(np.arange(first, len(table.values))), chosen=(chosen,))


def _stated(column: Column) -> Column:
    """Give a column the role and the unit that the device's manual states."""
    for begin, (role, unit) in _COLUMNS.items():
        if column.name.startswith(begin):
            return replace(column, role=role, unit=unit_of(unit), unit_text=unit)
    return column


def _start_text(text: Text) -> str:
    """Return the start time in the preamble; empty where it is not stated."""
    found = next((match for line in text.preamble if (match := _START.search(line))), None)
    return "" if found is None else f"{found[1]} {found[2]}.{found[3]} {found[4]}".strip()
