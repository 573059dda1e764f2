"""The history: what is put in comes out, old rows go by their age, and no state of the database holds up the monitor."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pyarrow.parquet
import pytest

from monitor.config import StateSettings
from monitor.core import MissingInputError
from monitor.publish import TABLES_VERSION
from monitor.runs import export
from monitor.service.history import History, Pace, limit, open_database
from tests.support.samples import T0_NS, Cli
from tests.support.waiting import until

HOP_NS = 10 * 10**9
ALL = (0, (1 << 63) - 1)


def line(number: int, **changes: Any) -> dict[str, Any]:
    """A line of results.jsonl, as far as the history looks at it."""
    values = {"frequencies_hz": [4.0 + number, 12.5, 17.25], "ddi": [0.001 * number, 0.2, -0.1], "misfit": 1.5}
    times = {"window": number, "t_end_ns": T0_NS + number * HOP_NS, "window_s": 400.0, "skipped": None}
    return {**times, **values, "alarm": {"level": "normal"}, **changes}


@pytest.fixture
def place(tmp_path: Path) -> Path:
    (tmp_path / "state").mkdir()
    return tmp_path / "state" / "history.db"


@pytest.fixture
def begin(place: Path) -> Iterator[Callable[..., History]]:
    """Histories that try again soon."""
    made: list[History] = []

    def new(**pace: int) -> History:
        made.append(History(place, StateSettings(), 10.0, 10.0, Pace(commit_s=0.01, retry_s=0.05, lock_s=0.05, **pace)))
        return made[-1]

    yield new
    for one in made:
        one.close(5.0)


def rows(place: Path, what: str) -> list[tuple[Any, ...]]:
    with closing(sqlite3.connect(place)) as database:
        try:
            return database.execute(what).fetchall()
        except sqlite3.OperationalError:
            return []  # it is being made


def test_what_is_put_in_comes_out_once(begin: Callable[..., History], place: Path) -> None:
    for _ in range(2):  # a restart tells the same again
        one = begin()
        for number in range(3):
            one.window(line(number, state="doubtful"))
        one.gap(T0_NS, 3.0, "lost")
        one.finding(
            {"t_ns": T0_NS, "from_ns": 0, "reason": "r", "verdict": "named", "says": "s", "causes": ["x"], "id": "1"}
        )
        one.close(10.0)
    assert rows(place, "SELECT count(*), max(t_end_ns), state FROM windows") == [(3, T0_NS + 2 * HOP_NS, "doubtful")]
    assert json.loads(rows(place, "SELECT ddi FROM windows WHERE window = 2")[0][0]) == [0.002, 0.2, -0.1]
    assert rows(place, "SELECT reason FROM gaps") == [("lost",)]
    assert rows(place, "SELECT verdict, causes FROM findings") == [("named", '["x"]')]


def test_neighbouring_gaps_are_one_row_and_a_restart_tells_none_twice(
    begin: Callable[..., History], place: Path
) -> None:
    """A sender of scraps with gaps between them gives one row, not one a scrap; far gaps stay rows of their own."""
    for _ in range(2):
        one = begin()
        for k in range(5000):
            one.gap(T0_NS + k * 50_000_000, 0.04, "8 samples missing")
        one.gap(T0_NS + 5000 * 50_000_000 + HOP_NS + 1, 1.0, "another")
        one.gap(T0_NS - 10**12, 2.0, "the clock was set back")
        one.close(10.0)
    found = rows(place, "SELECT t_ns, duration_s, reason, number, lost_s FROM gaps ORDER BY t_ns")
    assert found == [
        (T0_NS - 10**12, 2.0, "the clock was set back", 1, 2.0),
        (T0_NS, pytest.approx(249.99), "8 samples missing", 5000, pytest.approx(200.0)),
        (T0_NS + 5000 * 50_000_000 + HOP_NS + 1, 1.0, "another", 1, 1.0),
    ]


def test_the_number_of_gaps_is_bounded(begin: Callable[..., History], place: Path) -> None:
    one = begin(most_gaps=100)
    for k in range(2000):
        one.gap(T0_NS + k * 2 * HOP_NS, 1.0, "gap")
    one.close(10.0)
    found = rows(place, "SELECT t_ns FROM gaps ORDER BY t_ns")
    assert 100 <= len(found) <= 1100 and found[-1] == (T0_NS + 1999 * 2 * HOP_NS,)


def test_without_a_history_there_is_no_database(place: Path, tmp_path: Path) -> None:
    none = History(place, StateSettings(history=False), 10.0, 10.0)
    none.window(line(0))
    none.close(10.0)
    assert not place.exists()
    with pytest.raises(MissingInputError, match="no history here"):
        export(tmp_path, "windows", tmp_path / "w.csv", ALL)


def test_an_alarm_is_one_row_that_follows_it(begin: Callable[..., History], place: Path) -> None:
    one = begin()
    alarm = {"story": 2, "t_first_ns": T0_NS, "t_last_ns": None, "level": "advisory"}
    whole = {"story": None, "t_first_ns": T0_NS, "t_last_ns": None, "level": "warning"}
    numbers = {"ddi": 0.1, "ddi_std": 0.01, "loss_n_per_m": 5.0}
    one.episodes([alarm | numbers, whole | numbers])
    one.episodes([alarm | numbers | {"level": "alarm"}, whole | numbers])
    one.episodes([alarm | numbers | {"level": "alarm", "t_last_ns": T0_NS + 1}, whole | numbers])
    one.close(10.0)
    told = rows(place, "SELECT story, level, t_last_ns FROM alarms ORDER BY story")
    assert told == [(0, "warning", None), (2, "alarm", T0_NS + 1)]


def test_a_locked_database_is_waited_for_and_nothing_is_lost(begin: Callable[..., History], place: Path) -> None:
    one = begin()
    one.window(line(0))
    until(lambda: place.exists() and rows(place, "SELECT * FROM windows"), "a first row")
    with closing(sqlite3.connect(place, isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        one.window(line(1))
        until(lambda: one.failed is not None, "it is told")
        other.execute("ROLLBACK")
    until(lambda: len(rows(place, "SELECT * FROM windows")) == 2, "the second row")
    until(lambda: one.failed is None, "all is well again")


@pytest.mark.parametrize("damage", [b"no database at all" * 100, "newer", "torn"])
def test_a_damaged_or_newer_database_is_set_aside(
    begin: Callable[..., History], place: Path, damage: bytes | str
) -> None:
    if isinstance(damage, bytes):
        place.write_bytes(damage)
    else:
        with closing(open_database(place)) as database:
            database.executemany(
                "INSERT INTO windows (t_end_ns, window, reason) VALUES (?, ?, ?)".replace("reason", "skipped"),
                [(k, k, "x" * 200) for k in range(500)],
            )
            database.commit()
            if damage == "newer":
                database.execute(f"PRAGMA user_version = {TABLES_VERSION + 1}")
        if damage == "torn":
            data = bytearray(place.read_bytes())
            data[4096:] = bytes(len(data) - 4096)
            place.write_bytes(data)
    one = begin()
    one.window(line(7))
    until(lambda: list(place.parent.glob("*.damaged-1")), "the old one is set aside")
    until(lambda: place.exists() and rows(place, "SELECT window FROM windows") == [(7,)], "a new one is begun")


def test_an_older_database_is_upgraded_step_by_step(place: Path) -> None:
    open_database(place).close()
    first = {TABLES_VERSION: "ALTER TABLE gaps ADD COLUMN place TEXT;"}
    with pytest.raises(sqlite3.DatabaseError, match="cannot be upgraded"):
        open_database(place, TABLES_VERSION + 2, first)
    second = {TABLES_VERSION + 1: "UPDATE gaps SET place = 'here'; ALTER TABLE gaps ADD COLUMN floor INTEGER;"}
    with closing(open_database(place, TABLES_VERSION + 2, first | second)) as database:
        assert database.execute("PRAGMA user_version").fetchone() == (TABLES_VERSION + 2,)
        database.execute("SELECT place, floor FROM gaps")


def test_old_rows_thin_out_and_go(place: Path) -> None:
    with closing(open_database(place)) as database:
        values = [(k, k, "warning" if k == 50 else "normal") for k in range(1, 1001)]
        database.executemany("INSERT INTO windows (t_end_ns, window, level) VALUES (?, ?, ?)", values)
        for _ in range(3):
            limit(database, "windows", full=400, most=1000)
        kept = [row[0] for row in database.execute("SELECT id FROM windows ORDER BY id")]
        assert kept == sorted({50, *range(60, 601, 60), *range(601, 1001)})
        limit(database, "windows", full=400, most=500)
        assert database.execute("SELECT min(id) FROM windows").fetchone() == (540,)


def test_a_row_that_no_database_holds_is_left_out_and_counted(begin: Callable[..., History], place: Path) -> None:
    """As a damaged line of results.jsonl can give them, which is read again after a restart."""
    one = begin()
    for bad in ({"skipped": "\ud800"}, {"window": 1 << 70}):
        one.window(line(0) | bad)
    one.window(line(1))
    until(lambda: rows(place, "SELECT window FROM windows") == [(1,)], "the good one")
    one.close(10.0)
    assert one.dropped == 2 and one.failed is None


def test_a_queue_that_is_full_counts_what_it_refuses(
    begin: Callable[..., History], place: Path, caplog: pytest.LogCaptureFixture
) -> None:
    open_database(place).close()
    with closing(sqlite3.connect(place, isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        one = begin(most_queued=5)
        for number in range(20):
            one.window(line(number))
        assert one.dropped == 15
        other.execute("ROLLBACK")
    one.close(10.0)
    assert rows(place, "SELECT window FROM windows ORDER BY window") == [(number,) for number in range(5)]
    assert len([r for r in caplog.records if "rows are lost" in r.getMessage()]) == 1


def _folder(place: Path) -> Path:
    """The run's folder."""
    return place.parents[1]


def filled(place: Path) -> Path:
    with closing(open_database(place)) as database:
        for number in range(5):
            row = line(number, skipped="gap" if number == 3 else None)
            row |= {"ddi": None if number == 3 else json.dumps(row["ddi"]), "level": row.pop("alarm")["level"]}
            row["frequencies_hz"] = json.dumps(row["frequencies_hz"])
            names = ", ".join(row)
            database.execute(f"INSERT INTO windows ({names}) VALUES ({', '.join('?' * len(row))})", [*row.values()])
        database.commit()
    return place


def test_export_gives_a_column_a_number(place: Path, tmp_path: Path) -> None:
    assert export(_folder(filled(place)), "windows", tmp_path / "w.parquet", (T0_NS + HOP_NS, T0_NS + 4 * HOP_NS)) == 3
    table = pyarrow.parquet.read_table(tmp_path / "w.parquet").to_pydict()
    assert table["window"] == [1, 2, 3] and table["ddi_1"] == [0.001, 0.002, None]
    assert table["frequencies_hz_3"] == [17.25] * 3 and table["skipped"] == [None, None, "gap"]
    assert export(tmp_path, "windows", tmp_path / "w.csv", ALL) == 5
    head, *body = (tmp_path / "w.csv").read_text().splitlines()
    assert '"t_end_ns"' in head and '"ddi_3"' in head and len(body) == 5
    assert export(tmp_path, "gaps", tmp_path / "g.csv", ALL) == 0
    assert not list(tmp_path.glob("*.part"))


def test_the_command(tmp_path: Path, main: Cli) -> None:
    (tmp_path / "state").mkdir()
    filled(tmp_path / "state" / "history.db")
    done = main("export", tmp_path, "--out", tmp_path / "w.csv", "--from", "2026-01-01T00:00:10")
    assert done.returncode == 0 and done.stdout.startswith("4 rows"), done.stderr
    for arguments, code, says in (
        (("--out", tmp_path / "w.txt"), 2, ".parquet"),
        (("--out", tmp_path / "w.csv", "--table", "secrets"), 2, "known"),
        (("--out", tmp_path / "w.csv", "--from", "yesterday"), 2, "2026-12-31"),
    ):
        done = main("export", tmp_path, *arguments)
        assert done.returncode == code and says in done.stderr, done.stderr
    (tmp_path / "state" / "history.db").write_bytes(b"x" * 5000)
    done = main("export", tmp_path, "--out", tmp_path / "x.csv")
    assert done.returncode == 65 and "cannot be read" in done.stderr and not (tmp_path / "x.csv").exists()
    done = main("export", tmp_path / "state", "--out", tmp_path / "x.csv")
    assert done.returncode == 66 and "no history" in done.stderr
