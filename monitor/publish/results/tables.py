"""The tables of a run, as SQLite: a daemon's history, and what `export` makes from the files that every run writes."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Mapping, Sequence
from typing import Any

from monitor.publish.results.window_fields import KEPT, Field, Kind

TABLES_VERSION = 1
"""Version of the schema, stored as the database's user_version; to be raised with an entry in `UPGRADES` when anything but the
columns of `windows` changes: those follow from `KEPT`, and `make_tables` adds the ones that a table lacks."""
UPGRADES: Mapping[int, str] = {}
"""Version -> SQL that upgrades a database of that version to the next version; a new database begins as `_SCHEMA`, version 1, and
is upgraded by the same."""
_SQL = {
    Kind.NEVER_NULL_INTEGER: "INTEGER",
    Kind.NEVER_NULL_NUMBER: "REAL",
    Kind.INTEGER: "INTEGER",
    Kind.NUMBER: "REAL",
    Kind.FLAG: "INTEGER",
    Kind.TEXT: "TEXT",
}
"""Kind of a window's field -> type of its column; all else is JSON in a column of text. [none; definition]"""
ITEMS = {Kind.NUMBERS: "REAL", Kind.INTEGERS: "INTEGER", Kind.TEXTS: "TEXT"}
"""Kind of a list -> type of a column of its items, as `export` writes them. [none; definition]"""


def _column(field: Field) -> str:
    """Declare the column of a window's field."""
    return f"{field.key} {_SQL.get(field.kind, 'TEXT')}"


_SCHEMA = """
CREATE TABLE windows (id INTEGER PRIMARY KEY, {windows}, level TEXT, state TEXT, UNIQUE (t_end_ns, window));
CREATE TABLE alarms (
    id INTEGER PRIMARY KEY, story INTEGER NOT NULL, t_first_ns INTEGER NOT NULL, t_last_ns INTEGER, level TEXT,
    ddi REAL, ddi_std REAL, loss_n_per_m REAL, change REAL, change_std REAL, UNIQUE (story, t_first_ns));
CREATE TABLE requests (id INTEGER PRIMARY KEY, t_ns INTEGER, action TEXT, story INTEGER, who TEXT, note TEXT, seconds REAL);
CREATE TABLE findings (
    id INTEGER PRIMARY KEY, t_ns INTEGER NOT NULL, from_ns INTEGER NOT NULL, reason TEXT, verdict TEXT, says TEXT, causes TEXT,
    UNIQUE (t_ns, from_ns));
CREATE TABLE gaps (
    id INTEGER PRIMARY KEY, t_ns INTEGER NOT NULL, duration_s REAL, reason TEXT, number INTEGER NOT NULL DEFAULT 1, lost_s REAL,
    UNIQUE (t_ns, reason));
CREATE TABLE health (
    id INTEGER PRIMARY KEY, t_ns INTEGER NOT NULL UNIQUE, rate_hz REAL, samples INTEGER, availability REAL, gaps INTEGER,
    lost_s REAL, overlaps INTEGER, channels TEXT);
CREATE TABLE thinned (name TEXT PRIMARY KEY, id INTEGER NOT NULL);
""".format(windows=", ".join(map(_column, KEPT)))
TABLES = ("windows", "alarms", "requests", "findings", "gaps", "health")
_UPDATED = {"alarms": "(story, t_first_ns)", "findings": "(t_ns, from_ns)"}
"""Table whose rows are updated -> columns that identify a row; rows of the other tables never change."""

Row = dict[str, Any]


def make_tables(
    database: sqlite3.Connection,
    version: int = TABLES_VERSION,
    upgrades: Mapping[int, str] = UPGRADES,
    kept: Sequence[Field] = KEPT,
) -> None:
    """Create the tables of an empty database, or upgrade older ones; raise sqlite3.Error where a newer program wrote them.

    `upgrades` change the tables of an older version.  Columns of ``windows`` need none: those of `kept` that the table lacks are
    added, empty in the rows of before.
    """
    (written,) = database.execute("PRAGMA user_version").fetchone()
    if written > version:
        raise sqlite3.DatabaseError(f"written by a newer program (version {written}, this one knows {version})")
    for before in range(written, version):
        script = _SCHEMA if before == 0 else upgrades.get(before)
        if script is None:
            raise sqlite3.DatabaseError(f"of version {before}, which cannot be upgraded")
        database.executescript(f"BEGIN; {script} PRAGMA user_version = {before + 1}; COMMIT;")
    present = {name for _, name, *_ in database.execute("PRAGMA table_info(windows)")}
    for field in kept:
        if field.key not in present:
            database.execute(f"ALTER TABLE windows ADD COLUMN {_column(field)}")


def window_row(line: Mapping[str, Any], kept: Sequence[Field] = KEPT) -> Row:
    """Return the row of a window, given as its line of results.jsonl, and with `state` the structure's."""
    row = {f.key: line.get(f.key) if f.kind in _SQL else compact(line.get(f.key)) for f in kept}
    return row | {"level": line["alarm"]["level"], "state": line.get("state")}


def alarm_row(episode: Mapping[str, Any]) -> Row:
    """Return the row of an alarm, given as in summary.json; see `History.episodes`."""
    row = {key: value for key, value in episode.items() if key not in {"part", "t_level_ns", "direction", "index"}}
    return row | {"story": episode.get("part", episode.get("index", episode["story"])) or 0}


def insert(database: sqlite3.Connection, table: str, row: Row) -> None:
    """Insert a row; once more, it updates the row in the tables of `_UPDATED` and has no effect in the others."""
    database.execute(_statement(table, tuple(row)), tuple(row.values()))


def _statement(table: str, names: tuple[str, ...]) -> str:
    """Build the SQL of an insertion; repeating it updates the row in the tables of `_UPDATED` and has no effect in the others."""
    head = f"INSERT INTO {table} ({', '.join(names)}) VALUES ({', '.join('?' * len(names))}) ON CONFLICT"
    if table not in _UPDATED:
        return f"{head} DO NOTHING"
    changes = ", ".join(f"{name} = excluded.{name}" for name in names)
    return f"{head} {_UPDATED[table]} DO UPDATE SET {changes}"


def compact(value: Any) -> str | None:
    """Encode a list, or values by name, as compact JSON; None stays None."""
    return None if value is None else json.dumps(value, separators=(",", ":"))
