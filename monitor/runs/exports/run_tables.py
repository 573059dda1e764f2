"""Tables of any run: the history of a daemon, or the same made from the files that every run writes."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from monitor.core import BadInputError, MissingInputError, WrongUsageError, parse_json
from monitor.publish import TABLES, alarm_row, closed_files, insert, make_tables, read_line, read_lines, window_row

MODES = "modes"
"""Table with a row for each mode of each window; it is always made from results.jsonl."""
RUN_TABLES = (*TABLES, MODES)
_FROM_FILES = ("windows", "alarms", MODES)
"""Tables that can be made from results.jsonl and summary.json."""
_MODES_SCHEMA = """
CREATE TABLE modes (
    id INTEGER PRIMARY KEY, t_end_ns INTEGER NOT NULL, window INTEGER, mode INTEGER, other INTEGER, track INTEGER,
    frequency_hz REAL, frequency_std_hz REAL, damping_ratio REAL, damping_std REAL, shape_re TEXT, shape_im TEXT);
"""


@contextmanager
def open_table(folder: Path, table: str) -> Iterator[sqlite3.Connection]:
    """Open the database that holds a table of a run, in the folder that `run` or `replay` wrote; its daemon is not disturbed.

    WrongUsageError tells that the table is unknown, or that only a daemon's history has it; MissingInputError that there is
    neither a history nor results.jsonl; BadInputError that the history, or a line of the results, cannot be read.
    """
    if table not in RUN_TABLES:
        raise WrongUsageError(f"--table {table}: known: {', '.join(RUN_TABLES)}")
    stored = folder / "state" / "history.db"
    kept = stored.is_file() and table != MODES
    if not kept and table not in _FROM_FILES:
        raise WrongUsageError(
            f"--table {table}: only a daemon keeps it, in {stored}; {folder} has {', '.join(_FROM_FILES)}"
        )
    source = stored if kept else folder / "results.jsonl"
    try:
        address = f"{stored.resolve().as_uri()}?mode=ro"
        database = sqlite3.connect(address, uri=True, timeout=10.0) if kept else _made(folder)
    except sqlite3.Error as error:
        raise BadInputError(f"{source}: cannot be read: {error}") from error
    try:
        yield database
    except sqlite3.Error as error:
        raise BadInputError(f"{source}: cannot be read: {error}") from error
    finally:
        database.close()


def _made(folder: Path) -> sqlite3.Connection:
    """Make the tables from a run's files, in a database that disappears when it is closed."""
    results = folder / "results.jsonl"
    files = [*closed_files(folder), *([results] if results.is_file() else [])]
    if not files:
        raise MissingInputError(
            f"{folder}: no history here and no results.jsonl; give a site file, the dir of its [output], or that of replay --out"
        )
    database = sqlite3.connect("")
    try:
        make_tables(database)
        database.executescript(_MODES_SCHEMA)
        with database:
            for file in files:
                _add_lines(database, file)
            for episode in _alarms(folder / "summary.json"):
                insert(database, "alarms", alarm_row(episode))
    except BaseException:
        database.close()
        raise
    return database


def _add_lines(database: sqlite3.Connection, file: Path) -> None:
    """Add the windows of a file of results and their modes, without half a line at the end, as a running daemon leaves it."""
    try:
        for number, text in enumerate(read_lines(file), start=1):
            if not text.endswith(b"\n"):
                break
            try:
                line = read_line(text)
                insert(database, "windows", window_row(line))
                for row in _mode_rows(line):
                    insert(database, MODES, row)
            except (ValueError, TypeError, KeyError, OverflowError) as error:
                raise BadInputError(f"{file}: line {number} is no line of results: {error}") from error
    except OSError as error:
        raise MissingInputError(f"{file}: cannot be read: {error.strerror}") from error


def _mode_rows(line: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the rows of a line's modes: those of the model with their number, then the others."""
    shared = {"t_end_ns": line["t_end_ns"], "window": line.get("window")}
    shapes, tracks = line.get("mode_shapes") or [], line.get("mode_tracks") or []
    for k, shape in enumerate(shapes):
        named = {"mode": "model_modes", "frequency_hz": "frequencies_hz", "frequency_std_hz": "frequencies_std_hz",
                 "damping_ratio": "damping_ratio", "damping_std": "damping_std"}  # fmt: skip
        given = {name: (line.get(key) or [])[k : k + 1] for name, key in named.items()} | {"track": tracks[k : k + 1]}
        yield shared | {name: value[0] if value else None for name, value in given.items()} | _parts(shape)
    for number, other in enumerate(line.get("other_modes") or [], start=1):
        given = {name: other.get(name) for name in ("frequency_hz", "frequency_std_hz", "damping_ratio", "track")}
        yield shared | {"other": number} | given | _parts(other.get("mode_shape") or [])


def _parts(shape: list[list[float] | None]) -> dict[str, str]:
    """Return real and imaginary parts of a shape as JSON; null for a channel that is left out."""
    pairs = [pair or (None, None) for pair in shape]
    return {"shape_re": json.dumps([re for re, _ in pairs]), "shape_im": json.dumps([im for _, im in pairs])}


def _alarms(file: Path) -> list[dict[str, Any]]:
    """Return the episodes of a summary.json; none without the file, as while a replay runs."""
    names = ("level", "story", "t_first_ns", "t_last_ns", "ddi", "ddi_std", "loss_n_per_m")
    try:
        return [
            {name: episode[name] for name in names}
            | {name: episode[name] for name in ("part", "change", "change_std") if name in episode}
            for episode in parse_json(file.read_bytes())["alarms"]
        ]
    except FileNotFoundError:
        return []
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise BadInputError(f"{file}: cannot be read as the summary of a run: {error}") from error
