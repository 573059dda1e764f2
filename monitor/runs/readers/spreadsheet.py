"""Reads the first sheet with readings of a workbook (XLSX) as if its cells were a table of text."""

from __future__ import annotations

import io
from datetime import date, datetime, time
from typing import Any

from monitor.core import BadInputError, import_extra
from monitor.runs.readers import delimited
from monitor.runs.readers.base import File
from monitor.runs.readers.table import Table


def read_tables(file: File) -> list[Table]:
    """Convert a workbook; BadInputError if it is damaged, has no sheet of numbers or several."""
    calamine = import_extra("python_calamine", f"{file.path}: a workbook (XLSX)")
    try:
        book = calamine.CalamineWorkbook.from_filelike(io.BytesIO(file.raw))
        sheets = {name: book.get_sheet_by_name(name).to_python() for name in book.sheet_names}
    except Exception as error:
        raise BadInputError(f"{file.path}: damaged workbook: {error}") from error
    filled = {
        name: rows for name, rows in sheets.items() if any(isinstance(c, int | float) for row in rows for c in row)
    }
    if len(filled) != 1:
        raise BadInputError(
            f"{file.path}: {len(filled)} sheets hold numbers ({', '.join(filled) or 'none'}); save the one to be read as CSV"
        )
    lines = "\n".join("\t".join(map(_cell, row)) for row in next(iter(filled.values())))
    text = delimited.cut(file.path, lines, file.on_warning, file.options.time)
    return [delimited.to_table(text, file.on_warning, file.options.zone)]


def _cell(value: Any) -> str:
    """Write a cell as text."""
    if isinstance(value, datetime | date | time):
        return value.isoformat(" ") if isinstance(value, datetime) else value.isoformat()
    if isinstance(value, float):
        return repr(value)
    return str(value).replace("\t", " ").replace("\n", " ")
