"""Damaged files in the output folder: each is set aside or left out with a message, and nothing fails to start or to answer."""

from __future__ import annotations

import json
import logging
import os
import shutil
import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.base import SampleBlock
from monitor.core import MissingInputError
from monitor.publish import read_line, read_period
from monitor.service import status
from monitor.service.lease import FolderLease
from monitor.service.status import DOWN, HEALTHY, TROUBLE, look, tell
from tests.support.damages import DAMAGES, DEEP
from tests.support.live_site import RATE
from tests.support.samples import Cli, Cut
from tests.support.site import SITE, Daemon, Scripted, all_lines, lines, run_until, summary

S = 10**9


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, frame_text: str, record: np.ndarray, cut: Cut) -> Path:
    """The folder of a daemon that was told to end after nine windows; tests use copies."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "site.toml").write_text(SITE + frame_text)
    run_until(folder / "site.toml", cut(record, RATE), 9)
    return folder


@pytest.fixture
def site(tmp_path: Path, made: Path) -> Path:
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    return tmp_path / "site.toml"


@pytest.fixture
def stopped(site: Path) -> Path:
    return site.parent / "out"


def following(blocks: list[SampleBlock], record: np.ndarray) -> list[SampleBlock]:
    return [replace(b, t_ns=b.t_ns + 60 * S, sequence=b.sequence + len(record)) for b in blocks]


@pytest.mark.parametrize("text", [DEEP, '{"baseline_sha256": ', "\xff", "NaN"])
def test_a_damaged_note_of_the_baseline_is_set_aside(
    site: Path, stopped: Path, text: str, caplog: pytest.LogCaptureFixture
) -> None:
    place = stopped / "state" / "baseline.json"
    place.write_bytes(text.encode("latin-1"))
    Daemon(site, Scripted([])).run()
    assert json.loads(place.read_text()) == {"baseline_sha256": None}
    assert (stopped / "state" / "baseline.json.damaged-1").read_bytes() == text.encode("latin-1")
    assert "baseline.json.damaged-1" in caplog.text


WRONG_VALUES: list[dict[str, Any]] = [
    {"window": [1]},
    {"window": 1e300},
    {"window": 1 << 70},
    {"t_end_ns": "today"},
    {"misfit": {"a": 1}},
    {"alarm": None},
    {"alarm": {}},
    {"alarm": {"level": 3}},
    {"ddi": [{}]},
]


def test_damaged_lines_after_the_checkpoint_are_left_out(
    site: Path, stopped: Path, record: np.ndarray, cut: Cut, caplog: pytest.LogCaptureFixture
) -> None:
    file, good = stopped / "results.jsonl", lines(stopped)[-1]
    damaged = [DEEP, '{"window": ' + DEEP, "[1, 2]", *(json.dumps(good | wrong) for wrong in WRONG_VALUES)]
    with file.open("a") as out:
        out.writelines(text + "\n" for text in damaged)
    caplog.set_level(logging.WARNING)
    Daemon(site, Scripted(following(cut(record, RATE), record))).run()
    assert f"results.jsonl: {len(damaged)} damaged lines are left out" in caplog.text
    assert "not resumed" not in caplog.text and "Traceback" not in caplog.text
    found = [json.loads(row) for row in file.read_text().splitlines() if row not in damaged]
    assert [line["window"] for line in found] == list(range(21))
    assert summary(stopped)["windows"] == 21


@pytest.mark.parametrize("digits", ["9" * 30, "9" * 300_000, "253402300800000000000", "1"], ids=len)
def test_a_damaged_time_at_the_end_of_the_results_ends_no_start_where_months_are_packed(
    site: Path, stopped: Path, record: np.ndarray, cut: Cut, digits: str, caplog: pytest.LogCaptureFixture
) -> None:
    """It would be that of a month beyond the calendar, or of 1970, whose file the good lines then are in."""
    site.write_text(site.read_text().replace('dir = "out"', 'dir = "out"\npack_months = true'))
    text = f'{{"t_end_ns": {digits}}}\n'.encode()
    with (stopped / "results.jsonl").open("ab") as out:
        out.write(text)
    Daemon(site, Scripted(following(cut(record, RATE), record))).run()
    found = [json.loads(row)["window"] for row in all_lines(stopped) if row != text]
    assert found == list(range(21)) and "not resumed" not in caplog.text


def test_a_recording_whose_name_is_no_time_is_set_aside(
    site: Path, stopped: Path, record: np.ndarray, cut: Cut, caplog: pytest.LogCaptureFixture
) -> None:
    place = stopped / "recordings" / "20231314T000000.000000Z-0001.mcap"
    place.write_bytes(next((stopped / "recordings").glob("*.mcap")).read_bytes())
    Daemon(site, Scripted(following(cut(record, RATE), record))).run()
    assert [line["window"] for line in lines(stopped)] == list(range(21))
    assert not place.exists() and place.with_suffix(".damaged").exists()
    assert "its name is no time" in caplog.text and "not resumed" not in caplog.text


def test_a_last_line_without_end_is_removed_however_long(
    site: Path, stopped: Path, record: np.ndarray, cut: Cut, caplog: pytest.LogCaptureFixture
) -> None:
    with (stopped / "results.jsonl").open("a") as out:
        out.write("x" * 3_000_000)
    Daemon(site, Scripted(following(cut(record, RATE), record))).run()
    assert [line["window"] for line in lines(stopped)] == list(range(21))
    assert "incomplete last line of 3000000 bytes" in caplog.text


def test_a_report_reads_the_good_lines_and_counts_the_others(stopped: Path, main: Cli) -> None:
    with (stopped / "results.jsonl").open("a") as out:
        out.writelines(f"{text}\n" for text in (DEEP * 3, '{"t_end_ns": ' + "9" * 300_000, "x" * 300_000, DEEP))
    period = read_period(stopped, None, None)
    assert sum(period.results.judged) == 9 and period.results.damaged == 4
    done = main("report", stopped, "--out", stopped.parent / "report.html")
    assert done.returncode == 0 and "unreadable lines left out: 4" in done.stderr


# --- every file in turn ------------------------------------------------------------------------------------------------


@pytest.fixture
def kept(stopped: Path) -> Path:
    """A copy of the folder of a stopped daemon, with files that only some sites have, and a database that was not closed."""
    copy = stopped.parent / "kept"
    with closing(sqlite3.connect(stopped / "state" / "history.db")) as database:
        database.execute("UPDATE windows SET level = 'normal'")
        database.commit()
        shutil.copytree(stopped, copy)
    for name, text in (("ledger.jsonl", '{"what": "old"}\n'), ("events.jsonl", '{"id": "a", "revision": 0}\n')):
        (copy / name).write_text(text)
    (copy / "state" / "outbox.jsonl").write_text('{"version": 1}\n')
    (copy / "results-2025-12.jsonl.zst").write_bytes(b"a closed month")
    return copy


@pytest.mark.parametrize("damage", DAMAGES)
def test_whichever_file_is_damaged_it_starts_or_names_what_it_cannot_write(
    site: Path, kept: Path, record: np.ndarray, cut: Cut, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    """What is no file at all is named and ends the start with 66, where a file is written there; nothing else ends it."""
    site.write_text(site.read_text().replace('dir = "out"', 'dir = "out"\npack_months = true\nkeep_gb = 1.0'))
    out, later = site.parent / "out", following(cut(record, RATE)[:20], record)
    names = sorted(path.relative_to(kept) for path in kept.rglob("*") if path.is_file() and path.name != "lock")
    assert {"checkpoint", "history.db", "history.db-wal", "alarms"} <= {name.name for name in names}
    no_file, refused = damage in {"a folder", "a dangling link"}, set()
    # Each file is damaged while those that stand in for it are whole: the other checkpoint and alarms, recordings and results.
    may = {"results.jsonl", "health.jsonl", "events.jsonl", "baseline.json"} if no_file else set()
    others = [name for name in names if name.name not in may]
    groups = [[name] for name in names if name.name in may] + [others[k::5] for k in range(5)]
    for group in groups:
        shutil.rmtree(out)
        shutil.copytree(kept, out)
        for name in group:
            DAMAGES[damage](out / name)
        try:
            daemon = Daemon(site, Scripted(later))
        except MissingInputError as error:
            assert str(error).startswith(f"{out}: cannot be written: {out / group[0]}: "), error
            refused.add(group[0].name)
        else:
            daemon.run()
            summary = daemon.out / "summary.json"
            assert summary.exists() or summary.is_symlink()  # a link to nowhere stays
    assert refused <= may
    assert "Traceback" not in caplog.text and "not resumed from; monitoring begins anew" not in caplog.text


WRONG = [DEEP, "[1]", '{"a": 1e999}', "\xff\xfe"]
WRONG_PARTS = [[1], "text", 3, None, {"a": {}}, [{}], 1 << 80]


@pytest.mark.parametrize("name", ["health.jsonl", "results.jsonl", "summary.json"])
def test_the_status_of_damaged_files_is_an_answer(stopped: Path, name: str, main: Cli) -> None:
    for text in WRONG:
        (stopped / name).write_bytes((text + "\n").encode("latin-1") * 3)
        for options in ([], ["--json"]):
            done = main("status", stopped, *options)
            assert done.returncode == DOWN and done.stderr == "", done.stderr


@pytest.mark.parametrize("name", ["health.jsonl", "results.jsonl", "summary.json"])
def test_the_status_of_files_with_wrong_types_is_an_answer(stopped: Path, name: str) -> None:
    """Every key in turn has every wrong type."""
    whole = (stopped / name).read_text()
    content = json.loads(whole if name == "summary.json" else whole.splitlines()[-1])
    for key in content:
        for wrong in WRONG_PARTS:
            (stopped / name).write_text(json.dumps(content | {key: wrong}) + "\n")
            found = look(stopped)
            assert found["exit_code"] == DOWN and len(tell(found).splitlines()) >= 10
            json.dumps(found, allow_nan=False)


# --- the clock of the status ------------------------------------------------------------------------------------------


@pytest.fixture
def locked(stopped: Path) -> Iterator[Path]:
    """The folder of a daemon that holds its lock and says nothing more."""
    lease = FolderLease(stopped)
    lease.acquire()
    yield stopped
    lease.release()


def put_last(out: Path, **values: Any) -> None:
    line = json.loads((out / "health.jsonl").read_text().splitlines()[-1])
    line |= {"source": {"connected": True}, "failed": {}, **values}
    (out / "health.jsonl").write_text(json.dumps({k: v for k, v in line.items() if v is not None}) + "\n")


DAY_NS = 86_400 * S


@pytest.mark.parametrize("ahead_ns", [0, DAY_NS, -DAY_NS])
def test_the_wall_clock_alone_makes_no_daemon_silent(locked: Path, ahead_ns: int) -> None:
    put_last(locked, wall_ns=time.time_ns() + ahead_ns)
    found = look(locked)
    assert found["monitor"] == "running" and found["exit_code"] in {HEALTHY, TROUBLE}
    assert 0.0 <= found["silent_s"] < 60.0


def later(monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
    """Let the machine have run for so much longer."""
    boot_id, boot_s = status.boot_time()
    monkeypatch.setattr(status, "boot_time", lambda: (boot_id, boot_s + seconds))


@pytest.mark.parametrize("ahead_ns", [0, DAY_NS, -DAY_NS])
def test_the_wall_clock_alone_makes_no_hung_daemon_healthy(
    locked: Path, ahead_ns: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    put_last(locked, wall_ns=time.time_ns() + ahead_ns)
    later(monkeypatch, 90.0)
    found = look(locked)
    assert (found["monitor"], found["exit_code"]) == ("silent", DOWN) and found["silent_s"] >= 90.0
    assert "is silent since" in found["headline"]


def test_of_a_hung_daemon_no_part_is_said_to_work(locked: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its latest line said that all was well; what became of its parts since then nobody knows."""
    source = {"connected": True, "says": "connected, lost 0 times"}
    recorder = {"recording": True, "detail": "", "lost_blocks": 0}
    put_last(locked, source=source, recorder=recorder, wall_ns=time.time_ns())
    well = dict(row.split(maxsplit=1) for row in tell(look(locked)).splitlines())
    assert well["monitor"].endswith("; all parts work") and well["source"].startswith("connected, ")
    assert well["recorder"].startswith("recording, ")
    later(monkeypatch, 90.0)
    hung = dict(row.split(maxsplit=1) for row in tell(look(locked)).splitlines())
    assert hung["monitor"].startswith("silent, ") and "all parts work" not in hung["monitor"]
    for name in ("source", "recorder"):
        assert hung[name].startswith("not heard of since "), hung[name]


def test_a_line_from_before_the_machine_was_started_is_old(locked: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    put_last(locked, wall_ns=time.time_ns() + DAY_NS)
    monkeypatch.setattr(status, "boot_time", lambda: ("another start", 300.0))
    found = look(locked)
    assert found["exit_code"] == DOWN and found["silent_s"] == 300.0


def test_a_line_of_an_earlier_version_that_lies_ahead_has_no_known_age(locked: Path) -> None:
    put_last(locked, wall_ns=time.time_ns() + DAY_NS, boot_s=None, boot_id=None)
    found = look(locked)
    assert found["exit_code"] == DOWN and found["silent_s"] is None and "not heard of" in tell(found)
    put_last(locked, wall_ns=time.time_ns() - S, boot_s=None, boot_id=None)
    assert look(locked)["monitor"] == "running"


def test_who_may_not_open_the_lock_goes_by_the_age_of_the_latest_line(
    stopped: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tests may run as root, who may open everything: the refusal is the test's."""
    really = os.open

    def refuse(path: Any, *arguments: Any) -> int:
        if Path(path).name == "lock":
            raise PermissionError(13, os.strerror(13))
        return really(path, *arguments)

    monkeypatch.setattr(os, "open", refuse)
    put_last(stopped)
    assert look(stopped)["monitor"] == "running"
    later(monkeypatch, 90.0)
    assert look(stopped)["monitor"] == "not running"


def test_a_daemon_that_starts_after_a_long_pause_is_not_silent(
    site: Path, stopped: Path, record: np.ndarray, cut: Cut
) -> None:
    """Its first line stands in the file before it begins to resume, and says that it starts."""
    put_last(stopped, boot_id="an earlier start", wall_ns=1)
    seen: list[dict[str, Any]] = []

    class Looking(Scripted):
        def open(self) -> None:
            seen.append(look(stopped))
            super().open()

    Daemon(site, Looking(following(cut(record, RATE), record))).run()
    assert seen[0]["monitor"] == "running" and seen[0]["exit_code"] == TROUBLE
    assert "source: the monitor is starting" in seen[0]["troubles"]


def test_a_damaged_line_is_refused_and_a_good_one_is_read(stopped: Path) -> None:
    row = (stopped / "results.jsonl").read_text().splitlines()[0]
    assert read_line(row) == json.loads(row)
    for key in ("t_end_ns", "alarm", "skipped"):
        with pytest.raises(ValueError, match="LINE_SCHEMA"):
            read_line(json.dumps({k: v for k, v in json.loads(row).items() if k != key}))
