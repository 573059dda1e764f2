"""Export of a run's results for other programs: CSV, Parquet, InfluxDB line protocol, and modes as universal file (UFF)."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

from monitor.core import WrongUsageError, demand_place, finish, parse_json, partial, require_extra
from monitor.publish import ITEMS, KEPT
from monitor.runs.exports import line_protocol, universal_file
from monitor.runs.exports.run_tables import MODES, open_table

_BATCH = 20_000
_TIME = {"windows": "t_end_ns", "alarms": "t_first_ns", MODES: "t_end_ns"}
"""Table -> column of the time by which its rows are ordered; other tables use `t_ns`."""
_LISTS = {field.key: ITEMS[field.kind] for field in KEPT if field.kind in ITEMS}
_SHAPES = dict.fromkeys(("shape_re", "shape_im"), "REAL")
_LISTS_OF = {"windows": _LISTS, MODES: _SHAPES}
"""Table -> columns that hold lists, with the type of their items."""
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
        rows = Rows(source, table, span_ns, channels)
        try:
            if form == "influx":
                run = folder.resolve().name
                count = line_protocol.write(rows.batches(), partial(out), table, rows.time, run, rows.integers)
            elif form == "uff":
                count = universal_file.write(rows.stored(), partial(out), channels)
            else:
                count = _write_arrow(rows, partial(out), form)
        except BaseException:
            partial(out).unlink(missing_ok=True)
            raise
    finish(out)
    return count


class Rows:
    """Rows of a table in a period, in order of time; the lists of `modes` have a column for each channel.

    `listed` are the columns that hold lists, with the type of their items.
    """

    def __init__(
        self,
        source: sqlite3.Connection,
        table: str,
        span_ns: tuple[int, int],
        channels: Sequence[str] = (),
        listed: Mapping[str, str] | None = None,
    ) -> None:
        self._source, self._span_ns = source, span_ns
        self.time = _TIME.get(table, "t_ns")
        self._from = f"FROM {table} WHERE {self.time} >= ? AND {self.time} < ? ORDER BY {self.time}, id"
        self._table, self._channels, self._listed = (
            table,
            channels,
            _LISTS_OF.get(table, {}) if listed is None else listed,
        )

    @cached_property
    def columns(self) -> list[tuple[str, str, str, int]]:
        """Of each column: name, declared type, name in the database, and index in the list or -1."""
        columns: list[tuple[str, str, str, int]] = []
        for _, name, declared, *_ in self._source.execute(f"PRAGMA table_info({self._table})").fetchall():
            if name in self._listed:
                (most,) = self._ask(f"max(json_array_length({name}))").fetchone()
                for k in range(most or 0):
                    label = self._channels[k] if name in _SHAPES and k < len(self._channels) else str(k + 1)
                    columns.append((f"{name}_{label}", self._listed[name], name, k))
            elif name != "id":
                columns.append((name, declared, name, -1))
        return columns

    def _ask(self, what: str) -> sqlite3.Cursor:
        return self._source.execute(f"SELECT {what} {self._from}", self._span_ns)

    @property
    def integers(self) -> set[str]:
        """Names of the columns of integers."""
        return {name for name, declared, *_ in self.columns if declared == "INTEGER"}

    def batches(self) -> Iterator[Batch]:
        """Yield the rows in batches, as lists of values by column."""
        names = list(dict.fromkeys(stored_name for *_, stored_name, _ in self.columns))
        rows = self._ask(", ".join(names))
        while batch := rows.fetchmany(_BATCH):
            stored = dict(zip(names, zip(*batch, strict=True), strict=True))
            listed = [name for name in names if name in self._listed]
            lists = {name: [json.loads(text or "[]") for text in stored[name]] for name in listed}
            yield {
                column: list(stored[name]) if k < 0 else [row[k] if k < len(row) else None for row in lists[name]]
                for column, _, name, k in self.columns
            }

    def stored(self) -> Iterator[dict[str, Any]]:
        """Yield the rows as they are stored."""
        cursor = self._ask("*")
        names = [name for name, *_ in cursor.description]
        for row in cursor:
            yield dict(zip(names, row, strict=True))


def _write_arrow(rows: Rows, out: Path, form: str) -> int:
    """Write the rows in batches as Parquet or CSV, and return their number."""
    import pyarrow as pa
    import pyarrow.csv
    import pyarrow.parquet

    types = {"INTEGER": pa.int64(), "REAL": pa.float64()}
    schema = pa.schema([(name, types.get(declared, pa.string())) for name, declared, *_ in rows.columns])
    count, make = 0, pyarrow.parquet.ParquetWriter if form == "parquet" else pyarrow.csv.CSVWriter
    with make(str(out), schema) as writer:
        for batch in rows.batches():
            writer.write_table(pa.Table.from_pydict(batch, schema=schema))
            count += len(next(iter(batch.values())))
    return count
