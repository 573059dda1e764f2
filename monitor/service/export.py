"""Export of a run's results for other programs: CSV, Parquet, InfluxDB line protocol, and modes as universal file (UFF)."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from monitor.core import WrongUsageError, demand_place, finish, parse_json, partial, require_extra
from monitor.publish import KEPT, Kind
from monitor.service import line_protocol, universal_file
from monitor.service.run_tables import MODES, open_table

_BATCH = 20_000
_TIME = {"windows": "t_end_ns", "alarms": "t_first_ns", MODES: "t_end_ns"}
"""Table -> column of the time by which its rows are ordered; other tables use `t_ns`."""
_LISTS = tuple(field.key for field in KEPT if field.kind is Kind.NUMBERS)
_SHAPES = ("shape_re", "shape_im")
_LISTS_OF = {"windows": _LISTS, MODES: _SHAPES}
"""Table -> columns that hold lists."""
_FORM_OF = {".csv": "csv", ".parquet": "parquet", ".uff": "uff", ".unv": "uff", ".lp": "influx"}
"""Suffix of a file -> form that it has where none is named."""
FORMS = ("csv", "parquet", "uff", "influx")

Batch = dict[str, list[Any]]


def form_of(out: Path, form: str | None) -> str:
    """Return the form of a file, named or told by its suffix.

    Raises
    ------
    WrongUsageError
        The form is unknown, or none is told.
    """
    chosen = _FORM_OF.get(out.suffix) if form is None else form
    if chosen is None:
        raise WrongUsageError(
            f"{out}: name a file that ends in {', '.join(_FORM_OF)}, or give --format {'|'.join(FORMS)}"
        )
    if chosen not in FORMS:
        raise WrongUsageError(f"--format {form}: known: {', '.join(FORMS)}")
    return chosen


def channels_of(folder: Path) -> tuple[str, ...]:
    """Read the names of a run's channels from its summary.json; empty where it states none."""
    try:
        return tuple(map(str, parse_json((folder / "summary.json").read_bytes())["known"]["channels"]))
    except (OSError, ValueError, KeyError, TypeError):
        return ()


def export(
    folder: Path,
    table: str,
    out: Path,
    span_ns: tuple[int, int],
    *,
    form: str | None = None,
    channels: Sequence[str] = (),
) -> int:
    """Write the rows of a table of a run in order of time; a list of n values becomes the columns NAME_1 .. NAME_n.

    Parameters
    ----------
    folder : Path
        Folder that `run` or `replay` wrote; its daemon may be running.
    span_ns : (int, int)
        Start (included) and end (excluded) of the period, UTC, ns since 1970.
    form : str, optional
        One of `FORMS`; told by the suffix of `out` by default.
    channels : sequence of str
        Names of the channels, for the columns of mode shapes; they are numbered from 1 without.

    Returns
    -------
    int
        Number of rows; of a universal file, of modes.

    Raises
    ------
    WrongUsageError
        The table or the form is unknown, or the form cannot hold the table.
    MissingInputError
        The folder holds no run, or the file cannot be written.
    BadInputError
        The run cannot be read.
    MissingExtraError
        The extra that the form needs is not installed.
    """
    form = form_of(out, form)
    if form in ("csv", "parquet"):
        require_extra("archive", f"{out}:")
    if form == "uff" and table != MODES:
        raise WrongUsageError(f"--format uff: holds mode shapes: give --table {MODES}")
    with open_table(folder, table) as source:
        demand_place(out)
        try:
            batches = _batches(source, table, span_ns, channels)
            if form == "influx":
                names = {n for n, kind, *_ in _columns(source, table, span_ns, channels) if kind == "INTEGER"}
                count = line_protocol.write(
                    batches, partial(out), table, _TIME.get(table, "t_ns"), folder.resolve().name, names
                )
            elif form == "uff":
                count = universal_file.write(_rows(source, table, span_ns), partial(out), channels)
            else:
                count = _write_arrow(source, table, partial(out), form, span_ns, channels)
        except BaseException:
            partial(out).unlink(missing_ok=True)
            raise
    finish(out)
    return count


def _write_arrow(
    source: sqlite3.Connection, table: str, out: Path, form: str, span_ns: tuple[int, int], channels: Sequence[str]
) -> int:
    """Write the rows in batches as Parquet or CSV, and return their number."""
    import pyarrow as pa
    import pyarrow.csv
    import pyarrow.parquet

    schema = pa.schema([(n, _arrow_type(pa, k)) for n, k, *_ in _columns(source, table, span_ns, channels)])
    count, make = 0, pyarrow.parquet.ParquetWriter if form == "parquet" else pyarrow.csv.CSVWriter
    with make(str(out), schema) as writer:
        for batch in _batches(source, table, span_ns, channels):
            writer.write_table(pa.Table.from_pydict(batch, schema=schema))
            count += len(next(iter(batch.values())))
    return count


def _arrow_type(pa: Any, declared: str) -> Any:
    """Return the Arrow type of a column by its declared SQLite type."""
    return {"INTEGER": pa.int64(), "REAL": pa.float64()}.get(declared, pa.string())


def _span(table: str) -> str:
    """Build the SQL that selects the rows of a period, in order of time."""
    time = _TIME.get(table, "t_ns")
    return f"FROM {table} WHERE {time} >= ? AND {time} < ? ORDER BY {time}, id"


def _columns(
    source: sqlite3.Connection, table: str, span_ns: tuple[int, int], channels: Sequence[str]
) -> Iterator[tuple[str, str, str, int]]:
    """Yield for each column: name, declared type, name in the database, and index in the list or -1."""
    for _, name, declared, *_ in source.execute(f"PRAGMA table_info({table})").fetchall():
        if name in _LISTS_OF.get(table, ()):
            (most,) = source.execute(f"SELECT max(json_array_length({name})) {_span(table)}", span_ns).fetchone()
            for k in range(most or 0):
                label = channels[k] if name in _SHAPES and k < len(channels) else str(k + 1)
                yield f"{name}_{label}", "REAL", name, k
        elif name != "id":
            yield name, declared, name, -1


def _batches(
    source: sqlite3.Connection, table: str, span_ns: tuple[int, int], channels: Sequence[str]
) -> Iterator[Batch]:
    """Yield the rows in batches, as lists of values by column."""
    columns = list(_columns(source, table, span_ns, channels))
    names = list(dict.fromkeys(stored_name for *_, stored_name, _ in columns))
    rows = source.execute(f"SELECT {', '.join(names)} {_span(table)}", span_ns)
    listed = _LISTS_OF.get(table, ())
    while batch := rows.fetchmany(_BATCH):
        stored = dict(zip(names, zip(*batch, strict=True), strict=True))
        lists = {name: [json.loads(text or "[]") for text in stored[name]] for name in names if name in listed}
        yield {
            column: list(stored[name]) if k < 0 else [values[k] if k < len(values) else None for values in lists[name]]
            for column, _, name, k in columns
        }


def _rows(source: sqlite3.Connection, table: str, span_ns: tuple[int, int]) -> Iterator[dict[str, Any]]:
    """Yield the rows as they are stored."""
    cursor = source.execute(f"SELECT * {_span(table)}", span_ns)
    names = [name for name, *_ in cursor.description]
    for row in cursor:
        yield dict(zip(names, row, strict=True))
