"""Export of the history as a table for other programs: Parquet or CSV, one column for each number."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

from monitor.core import BadInputError, MissingInputError, WrongUsageError, demand_place, finish, partial, require_extra
from monitor.service.history import TABLES

_BATCH = 20_000
_TIME = {"windows": "t_end_ns", "alarms": "t_first_ns"}
"""Table -> column of the time by which its rows are ordered; other tables use `t_ns`."""
_LISTS = ("frequencies_hz", "frequencies_std_hz", "damping_ratio", "damping_std", "ddi", "ddi_std", "loss_n_per_m")
FORMATS = (".parquet", ".csv")


def export(database: Path, table: str, out: Path, span_ns: tuple[int, int]) -> int:
    """Write the rows of a table of the history in order of time; a list of n values becomes the columns NAME_1 .. NAME_n.

    Parameters
    ----------
    database : Path
        The file history.db; its daemon may be running.
    table : str
        Name of the table, one of `history.TABLES`.
    out : Path
        File to write; its suffix, one of `FORMATS`, selects the format.
    span_ns : (int, int)
        Start (included) and end (excluded) of the period, UTC, ns since 1970.

    Returns
    -------
    int
        Number of rows.

    Raises
    ------
    WrongUsageError
        The table or the format is unknown.
    MissingInputError
        The database does not exist, or the file cannot be written.
    BadInputError
        The database cannot be read.
    MissingExtraError
        The extra `archive` is not installed.
    """
    if table not in TABLES:
        raise WrongUsageError(f"--table {table}: known: {', '.join(TABLES)}")
    if out.suffix not in FORMATS:
        raise WrongUsageError(f"{out}: name a file that ends in {' or '.join(FORMATS)}")
    if not database.is_file():
        raise MissingInputError(f"{database}: no history here; give a site file, or the dir of its [output]")
    require_extra("archive", "export")
    demand_place(out)
    try:
        with closing(sqlite3.connect(f"{database.resolve().as_uri()}?mode=ro", uri=True, timeout=10.0)) as source:
            rows = _write(source, table, out, span_ns)
    except sqlite3.Error as error:
        partial(out).unlink(missing_ok=True)
        raise BadInputError(f"{database}: cannot be read: {error}") from error
    finish(out)
    return rows


def _write(source: sqlite3.Connection, table: str, out: Path, span_ns: tuple[int, int]) -> int:
    """Write the rows in batches and return their number."""
    import pyarrow as pa
    import pyarrow.csv
    import pyarrow.parquet

    schema, count = pa.schema([(n, _arrow_type(pa, k)) for n, k, *_ in _columns(source, table, span_ns)]), 0
    make: Any = pyarrow.parquet.ParquetWriter if out.suffix == ".parquet" else pyarrow.csv.CSVWriter
    with make(str(partial(out)), schema) as writer:
        for batch in _batches(source, table, span_ns):
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


def _columns(source: sqlite3.Connection, table: str, span_ns: tuple[int, int]) -> Iterator[tuple[str, str, str, int]]:
    """Yield for each column: name, declared type, name in the database, and index in the list or -1."""
    for _, name, declared, *_ in source.execute(f"PRAGMA table_info({table})").fetchall():
        if name in _LISTS and table == "windows":
            (most,) = source.execute(f"SELECT max(json_array_length({name})) {_span(table)}", span_ns).fetchone()
            for k in range(most or 0):
                yield f"{name}_{k + 1}", "REAL", name, k
        elif name != "id":
            yield name, declared, name, -1


def _batches(source: sqlite3.Connection, table: str, span_ns: tuple[int, int]) -> Iterator[dict[str, list[Any]]]:
    """Yield the rows in batches, as lists of values by column."""
    columns = list(_columns(source, table, span_ns))
    names = list(dict.fromkeys(stored_name for *_, stored_name, _ in columns))
    rows = source.execute(f"SELECT {', '.join(names)} {_span(table)}", span_ns)
    while batch := rows.fetchmany(_BATCH):
        stored = dict(zip(names, zip(*batch, strict=True), strict=True))
        lists = {name: [json.loads(text or "[]") for text in stored[name]] for name in names if name in _LISTS}
        yield {
            column: list(stored[name]) if k < 0 else [values[k] if k < len(values) else None for values in lists[name]]
            for column, _, name, k in columns
        }
