"""Reads the one sheet with numbers of a workbook (XLSX) as a table of text."""

from __future__ import annotations

import io
from datetime import date, datetime, time
from typing import Any

from monitor.core import BadInputError, import_extra
from monitor.runs.readers.base import File


def as_text(file: File) -> str:
    """Write the sheet as a table of text; BadInputError if it is damaged, has no sheet of numbers or several."""
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
    return "\n".join("\t".join(map(_cell, row)) for row in next(iter(filled.values())))


def _cell(value: Any) -> str:
    """Write a cell as text."""
    if isinstance(value, datetime | date | time):
        return value.isoformat(" ") if isinstance(value, datetime) else value.isoformat()
    if isinstance(value, float):
        return repr(value)
    return str(value).replace("\t", " ").replace("\n", " ")
