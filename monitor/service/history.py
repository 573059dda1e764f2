"""History of years of results for queries: an SQLite database beside results.jsonl, which stays the authoritative record.

A separate thread writes the rows from a bounded queue.  A write to a locked database or a full disk is repeated; a damaged
database is renamed and a new one begun.  Neither delays or ends the monitor.
"""

from __future__ import annotations

import contextlib
import json
import logging
import sqlite3
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from monitor.config import StateSettings
from monitor.core import Retry, Work, Worker, set_aside as rename_aside
from monitor.publish import KEPT, Field, Kind

_log = logging.getLogger(__name__)

VERSION = 1
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
_NORMAL = {"windows": "level = 'normal'", "health": "gaps = 0 AND availability >= 1.0"}
_ONE_IN = 60
_LIMIT_EVERY, _LIMIT_ROWS = 1000, 5000

Row = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Pace:
    """How often the history is written, and how much of it at most waits and is kept."""

    commit_s: float = 1.0
    """Time in which rows are collected for one transaction."""
    retry_s: float = 10.0
    """Pause before a write that failed is repeated."""
    lock_s: float = 2.0
    """Longest wait for a database that somebody else has locked."""
    most_queued: int = 20_000
    most_gaps: int = 100_000
    """Most rows of gaps; the oldest go first (some 10 MB)."""


class History:
    """Database of the results, written in the background; no method but `close` waits, and none raises.

    Age is counted in rows, which a wrong clock cannot falsify: one window comes each `hop_s`, one health span each `span_s`.
    Gaps at most `hop_s` apart are one row.  Rows for which there is no room are lost and counted in `dropped`.  Where the
    settings want no history the rows are discarded and no file is opened.
    """

    def __init__(self, path: Path, settings: StateSettings, hop_s: float, span_s: float, pace: Pace = Pace()) -> None:
        self._path, self._enabled, self._pace = path, settings.history, pace
        day = 86_400.0
        full = {"windows": settings.windows_days * day / hop_s, "health": settings.health_days * day / span_s}
        per_day = {"windows": day / hop_s, "health": day / span_s}
        self._neighbour_ns = round(hop_s * 1e9)
        """Time between two gaps up to which they are one row: no window moves on between them."""
        self._keep = {t: (int(full[t]), int(settings.keep_days * per_day[t])) for t in full}
        self._rows: deque[tuple[str, Row]] = deque()
        self._stored_alarms: dict[tuple[int | None, int], Row] = {}
        self._inserted = 0
        self.dropped, self._losing = 0, False
        self._database: sqlite3.Connection | None = None
        work = Work[None](idle=self._write_all, finish=self._write_all, shut=self._shut)
        retry = Retry((sqlite3.Error, OSError), pace.retry_s, pace.retry_s)
        self._worker = Worker("history", work, retry=retry)
        if self._enabled:
            self._worker.start()

    @property
    def failed(self) -> str | None:
        """Why rows wait; None if none do."""
        return self._worker.failed

    def window(self, line: Mapping[str, Any]) -> None:
        """Store the result of a window, given as its line of results.jsonl, and with `state` the structure's."""
        self._put("windows", window_row(line))

    def episodes(self, episodes: Iterable[Mapping[str, Any]]) -> None:
        """Store those of the latest alarms that are new or changed; story None is the structure as a whole.

        Where modes alone are judged, the column `story` has the number of the mode or shape (`damage.modal_parts`).
        """
        latest = {}
        for episode in episodes:
            row = alarm_row(episode)
            latest[row["story"], row["t_first_ns"]] = row
        for key, row in latest.items():
            if self._stored_alarms.get(key) != row:
                self._put("alarms", row)
        self._stored_alarms = latest

    def request(self, t_ns: int, request: Mapping[str, Any]) -> None:
        """Store a request of an operator, applied at `t_ns` (UTC, ns since 1970)."""
        row = dict(request)
        if (event := row.pop("event")) is not None:  # the table has a column for the story alone
            row["note"] = f"event {event}: {row['note']}"
        self._put("requests", {"t_ns": t_ns, **row})

    def finding(self, finding: Mapping[str, Any]) -> None:
        """Store the finding of a diagnosis."""
        names = ("t_ns", "from_ns", "reason", "verdict", "says")
        self._put("findings", {name: finding[name] for name in names} | {"causes": _text(finding["causes"])})

    def gap(self, t_ns: int, duration_s: float, reason: str) -> None:
        """Store a gap in the data that begins at `t_ns` (UTC, ns since 1970) and lasts `duration_s`.

        A row holds neighbouring gaps: from the first one's beginning to the last one's end, their number, the time lost in all,
        and the first one's reason.
        """
        self._put("gaps", {"t_ns": t_ns, "duration_s": duration_s, "reason": reason, "lost_s": duration_s})

    def health(self, span: Mapping[str, Any]) -> None:
        """Store the sensors' health in a span of data."""
        names = ("t_ns", "rate_hz", "samples", "availability", "gaps", "lost_s", "overlaps")
        self._put("health", {name: span[name] for name in names} | {"channels": _text(span["channels"])})

    def close(self, timeout_s: float) -> None:
        """Write the rows that wait, for at most `timeout_s`."""
        self._worker.close(timeout_s)

    def _put(self, table: str, row: Row) -> None:
        if len(self._rows) >= self._pace.most_queued:
            if not self._losing:
                _log.error("%s: %d rows wait; rows are lost from here on", self._path, len(self._rows))
            self._losing = True
            self.dropped += 1
        elif self._enabled:
            self._rows.append((table, row))
            self._worker.wake(self._pace.commit_s)  # many rows are collected for one transaction

    def _write_all(self) -> None:
        """Write the rows that wait; a damaged database is set aside, and they go into a new one."""
        try:
            self._write()
        except sqlite3.Error as error:
            if not is_damage(error):
                raise
            self._shut()
            if not set_aside(self._path, str(error)):
                raise
            self._write()

    def _shut(self) -> None:
        if self._database is not None:
            self._database.close()
        self._database = None

    def _write(self) -> None:
        """Write all queued rows in one transaction; now and then remove old rows."""
        batch = list(self._rows)
        if not batch:
            return
        if self._database is None:
            self._database = open_database(self._path, wait_s=self._pace.lock_s)
        database = self._database
        with database:
            for table, row in batch:
                try:
                    if table != "gaps" or not merge_gap(database, row, self._neighbour_ns):
                        insert(database, table, row)
                except (ValueError, OverflowError) as error:  # a damaged line: text or a number that no database holds
                    self.dropped += 1
                    _log.warning("%s: a row of %s is left out: %s", self._path, table, error)
        for _ in batch:
            self._rows.popleft()
        self._losing = False
        self._inserted += len(batch)
        if self._inserted >= _LIMIT_EVERY:
            self._inserted = 0
            for table, (full, most) in self._keep.items():
                with database:
                    limit(database, table, full, most)
            with database:
                database.execute("DELETE FROM gaps WHERE id <= (SELECT max(id) FROM gaps) - ?", (self._pace.most_gaps,))


def open_database(
    path: Path, version: int = VERSION, upgrades: Mapping[int, str] = UPGRADES, wait_s: float = 2.0
) -> sqlite3.Connection:
    """Open the database; create it, or upgrade its schema, if necessary; raise sqlite3.Error as `make_tables`."""
    with contextlib.suppress(OSError):  # the files that SQLite keeps beside it get its mode
        path.touch(0o600, exist_ok=False)
    database = sqlite3.connect(path, timeout=wait_s, check_same_thread=False)
    try:
        database.execute("PRAGMA journal_mode = WAL")
        database.execute("PRAGMA synchronous = NORMAL")
        make_tables(database, version, upgrades)
    except BaseException:
        database.close()
        raise
    return database


def make_tables(database: sqlite3.Connection, version: int = VERSION, upgrades: Mapping[int, str] = UPGRADES) -> None:
    """Create the tables of an empty database, or upgrade older ones; raise sqlite3.Error where a newer program wrote them.

    `upgrades` change the tables of an older version.  Columns of ``windows`` need none: those of `KEPT` that the table lacks are
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
    for field in KEPT:
        if field.key not in present:
            database.execute(f"ALTER TABLE windows ADD COLUMN {_column(field)}")


def window_row(line: Mapping[str, Any]) -> Row:
    """Return the row of a window, given as its line of results.jsonl, and with `state` the structure's."""
    row = {f.key: line.get(f.key) if f.kind in _SQL else _text(line.get(f.key)) for f in KEPT}
    return row | {"level": line["alarm"]["level"], "state": line.get("state")}


def alarm_row(episode: Mapping[str, Any]) -> Row:
    """Return the row of an alarm, given as in summary.json; see `History.episodes`."""
    row = {key: value for key, value in episode.items() if key != "part"}
    return row | {"story": episode.get("part", episode["story"]) or 0}


def insert(database: sqlite3.Connection, table: str, row: Row) -> None:
    """Insert a row; once more, it updates the row in the tables of `_UPDATED` and has no effect in the others."""
    database.execute(_statement(table, tuple(row)), tuple(row.values()))


def is_damage(error: Exception) -> bool:
    """Return whether an error means a damaged database, which a later attempt cannot cure, unlike a lock or a full disk."""
    return type(error) is sqlite3.DatabaseError


def set_aside(path: Path, reason: str) -> bool:
    """Rename a database that cannot be used; return whether the disk allowed it."""
    with contextlib.suppress(OSError):
        place = rename_aside(path)
        _log.error("%s: %s; set aside as %s, a new one is begun", path, reason, place.name)
        for end in ("-wal", "-shm"):
            path.with_name(path.name + end).unlink(missing_ok=True)
        return True
    return False


def merge_gap(database: sqlite3.Connection, gap: Row, neighbour_ns: int) -> bool:
    """Merge a gap into the row before it in time, if that holds it already or ends at most `neighbour_ns` before it.

    Return False if there is no such row.
    """
    latest = "SELECT id, t_ns, duration_s FROM gaps WHERE t_ns <= ? ORDER BY t_ns DESC LIMIT 1"
    before = database.execute(latest, (gap["t_ns"],)).fetchone()
    if before is None:
        return False
    row, t_ns, duration_s = before
    end_ns = t_ns + round(duration_s * 1e9)
    begun_ns, lasts_s = gap["t_ns"], (gap["t_ns"] - t_ns) * 1e-9 + gap["duration_s"]
    if begun_ns > end_ns + neighbour_ns:
        return False
    if lasts_s > duration_s + 1e-9:  # else a restart tells it once more
        database.execute(
            "UPDATE gaps SET duration_s = ?, number = number + 1, lost_s = lost_s + ? WHERE id = ?",
            (lasts_s, gap["duration_s"], row),
        )
    return True


def limit(database: sqlite3.Connection, table: str, full: int, most: int) -> None:
    """Thin out and remove old rows of ``windows`` or ``health``, a limited number in each call.

    The latest `full` rows are all kept.  Of older rows the unusual ones and one in sixty are kept.  Rows older than the latest
    `most` are removed.
    """
    (last,) = database.execute(f"SELECT coalesce(max(id), 0) FROM {table}").fetchone()
    (thinned,) = database.execute("SELECT coalesce(max(id), 0) FROM thinned WHERE name = ?", (table,)).fetchone()
    end = min(last - full, thinned + _LIMIT_ROWS)
    if end > thinned:
        where = f"id > ? AND id <= ? AND id % {_ONE_IN} != 0 AND {_NORMAL[table]}"
        database.execute(f"DELETE FROM {table} WHERE {where}", (thinned, end))
        database.execute("INSERT OR REPLACE INTO thinned (name, id) VALUES (?, ?)", (table, end))
    oldest = f"SELECT id FROM {table} WHERE id <= ? ORDER BY id LIMIT {_LIMIT_ROWS}"
    database.execute(f"DELETE FROM {table} WHERE id IN ({oldest})", (last - most,))


def _statement(table: str, names: tuple[str, ...]) -> str:
    """Build the SQL of an insertion; repeating it updates the row in the tables of `_UPDATED` and has no effect in the others."""
    head = f"INSERT INTO {table} ({', '.join(names)}) VALUES ({', '.join('?' * len(names))}) ON CONFLICT"
    if table not in _UPDATED:
        return f"{head} DO NOTHING"
    changes = ", ".join(f"{name} = excluded.{name}" for name in names)
    return f"{head} {_UPDATED[table]} DO UPDATE SET {changes}"


def _text(value: Any) -> str | None:
    return None if value is None else json.dumps(value, separators=(",", ":"))
