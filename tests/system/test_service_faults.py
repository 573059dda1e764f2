"""Faults of the machine under a running daemon: disks, clocks, state, whoever it talks to, memory.

What each costs is told in docs/operations.md; kill -9 is tests/system/test_restart.py,
faults of the source tests/system/test_live_faults.py.
"""

from __future__ import annotations

import json
import logging
import os
import signal
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.base import SampleBlock, SourceHealth
from drivers.mcap_file import McapWriter, read_recordings
from monitor.config import configuration
from monitor.core import Level, WindowResult
from monitor.diagnosis import Request
from monitor.publish import Publisher
from monitor.runs import Session
from monitor.service import Daemon, history, serialization
from monitor.service.daemon_health import failures
from monitor.service.restart import KeptAlarms
from tests.support.live_site import RATE
from tests.support.samples import T0_NS, Cli, Cut
from tests.support.site import SITE, Endless, Scripted, lines, own, run_until, summary
from tests.support.waiting import until
from tests.support.zenoh_router import free_port

pytestmark = pytest.mark.system


@pytest.fixture
def site(tmp_path: Path, frame_text: str) -> Path:
    path = tmp_path / "site.toml"
    path.write_text(SITE.replace("min_free_gb = 0.0", "min_free_gb = 0.0\nflush_s = 1.0") + frame_text)
    return path


ROOT = Path(__file__).parents[2]
S = 10**9


def expected(site: Path, blocks: list[SampleBlock]) -> list[dict[str, Any]]:
    """What a replay says."""

    class Kept(Publisher):
        lines: list[dict[str, Any]]

        def window(self, result: WindowResult, line: str) -> None:
            self.lines.append(json.loads(line))

    kept = Kept()
    kept.lines = []
    session = Session(configuration.load(site), None, (kept,), None, site.parent / "none")
    for block in blocks:
        session.push(block)
    return kept.lines


# --- disks -------------------------------------------------------------------------------------------------------------


class SmallDisk:
    """A file system of a few MB in a namespace of its own, and a daemon in it."""

    def __init__(self, site: Path, stream: np.ndarray, size: str) -> None:
        self._folder = folder = site.parent
        np.save(folder / "stream.npy", stream.astype(np.float32))
        (folder / "out").mkdir()
        self.position = folder / "position"
        run = f"{sys.executable} -m tests.support.live_site {site} {folder}/stream.npy {self.position} 0.025 0"
        mount = f"mount -t tmpfs -o size={size} none {folder}/out"
        daemon = f"({run} 2> {folder}/log & echo $!; wait $!; echo $? > {folder}/code)"
        script = f"{mount} && echo mounted && {daemon} & exec sh"
        self._shell = subprocess.Popen(
            ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c", script],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            cwd=ROOT,
        )
        assert self._shell.stdout is not None
        if self._shell.stdout.readline() != "mounted\n":
            self._shell.kill()
            self._shell.wait()
            pytest.skip("no mount namespaces here")
        self._pid = int(self._shell.stdout.readline())
        self.out = Path(f"/proc/{self._shell.pid}/root{folder}/out")

    def sh(self, command: str) -> None:
        """Do something there."""
        assert self._shell.stdin is not None and self._shell.stdout is not None
        self._shell.stdin.write(f"{{ {command}; }} > /dev/null 2>&1; echo done\n")
        self._shell.stdin.flush()
        assert self._shell.stdout.readline() == "done\n"

    @property
    def given(self) -> int:
        return int(self.position.read_text() or 0) if self.position.exists() else 0

    def end(self) -> int:
        """Exit code of the daemon after SIGTERM."""
        os.kill(self._pid, signal.SIGTERM)
        until((self._folder / "code").exists, "it ends")
        return int((self._folder / "code").read_text())

    def close(self) -> None:
        with suppress(ProcessLookupError):
            os.kill(self._pid, signal.SIGKILL)
        self._shell.kill()
        self._shell.communicate()


@contextmanager
def small_disk(site: Path, stream: np.ndarray, size: str) -> Iterator[SmallDisk]:
    disk = SmallDisk(site, stream, size)
    try:
        yield disk
    finally:
        disk.close()


def test_a_full_disk_costs_recordings_and_no_result(site: Path, record: np.ndarray) -> None:
    site.write_text(site.read_text() + "\n[state]\ncheckpoint_s = 10.0\n")
    with small_disk(site, record, "4m") as disk:
        until(lambda: len(lines(disk.out)) >= 2, "windows")
        disk.sh(f"head -c 100m /dev/zero > {site.parent}/out/filler")
        before = disk.given
        until(lambda: disk.given >= before + 120, "a minute of data")  # blocks of half a second
        until(lambda: "no checkpoint" in (site.parent / "log").read_text(), "a checkpoint fails")
        disk.sh(f"rm {site.parent}/out/filler")
        came = len(lines(disk.out))
        until(lambda: len(lines(disk.out)) >= came + 6, "lines go on")
        until(lambda: lines(disk.out, "health.jsonl")[-1]["recorder"]["recording"], "the recorder goes on")
        until(lambda: not lines(disk.out, "health.jsonl")[-1]["failed"], "nothing is blocked")
        assert disk.end() == 0
        found = lines(disk.out)
        assert [line["window"] for line in found] == list(range(len(found)))
        assert all(line["skipped"] is None for line in found)
        assert lines(disk.out, "health.jsonl")[-1]["recorder"]["lost_blocks"] > 0
        assert (disk.out / "state" / "checkpoint").exists() and not list(disk.out.rglob("*.damaged*"))
    said = (site.parent / "log").read_text()
    assert "Traceback" not in said and "no checkpoint" in said


def test_a_read_only_disk_is_one_message_at_start(site: Path, record: np.ndarray) -> None:
    script = "mount -t tmpfs -o ro none $0 && exec $1 -m monitor run $2"
    (site.parent / "out").mkdir()
    write = site.parent / "rec.mcap"
    with McapWriter(write):
        pass
    command = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c", script]
    done = subprocess.run(
        [*command, site.parent / "out", sys.executable, site], capture_output=True, text=True, cwd=ROOT, check=False
    )
    if "mount" in done.stderr or "unshare" in done.stderr:
        pytest.skip("no mount namespaces here")
    assert done.returncode == 66 and done.stderr.count("\n") == 1 and "cannot be written: Read-only" in done.stderr


def test_a_disk_that_turns_read_only_stops_no_result(
    site: Path, record: np.ndarray, cut: Cut, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    daemon = Daemon(site, Scripted(cut(record, RATE)))

    def refuse(*_: object, **__: object) -> None:
        raise OSError(30, os.strerror(30))

    def refuse_sql(*_: object) -> None:
        raise sqlite3.OperationalError("attempt to write a readonly database")

    really = os.write

    def write(handle: int, data: bytes) -> int:
        # Pipes and sockets go on as before.
        return (
            refuse()
            if str(os.readlink(f"/proc/self/fd/{handle}")).startswith(str(site.parent))
            else really(handle, data)
        )  # type: ignore[func-returns-value]

    for place, name, how in (
        (os, "write", write),
        (os, "replace", refuse),
        (os, "fsync", refuse),
        (McapWriter, "__init__", refuse),
        (history.History, "_write", refuse_sql),
    ):
        monkeypatch.setattr(place, name, how)
    told: list[str] = []
    monkeypatch.setattr(daemon._lines, "write", lambda line: told.append(line))
    daemon.run()
    failed = failures(daemon.outputs())
    monkeypatch.undo()
    assert [json.loads(line) for line in told] == expected(site, cut(record, RATE))
    assert {"health.jsonl", "history"} <= failed.keys()
    assert daemon._recording.health().lost_blocks > 0  # type: ignore[union-attr]


def test_a_slow_disk_holds_up_no_evaluation(
    site: Path, record: np.ndarray, cut: Cut, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing that the main thread does while it evaluates waits for a disk, so a slow one cannot delay it."""
    source = Scripted(cut(record, RATE))
    site.write_text(site.read_text() + "\n[state]\ncheckpoint_s = 5.0\n")
    daemon = Daemon(site, source)
    waited: list[str] = []
    fsync = os.fsync

    def slow(handle: int) -> None:
        waited.append(threading.current_thread().name)
        time.sleep(0.2)
        fsync(handle)

    monkeypatch.setattr(os, "fsync", slow)
    daemon.run()
    assert len(waited) >= 4 and "MainThread" not in waited
    assert lines(site.parent / "out") == expected(site, cut(record, RATE))
    assert list(read_recordings(own(site.parent / "out")))


def test_a_disk_that_hangs_does_not_keep_it_from_ending(
    site: Path, record: np.ndarray, cut: Cut, monkeypatch: pytest.MonkeyPatch
) -> None:
    release = threading.Event()
    source = Endless(cut(record, RATE), 9)
    source.daemon = daemon = Daemon(site, source)
    fsync = os.fsync
    monkeypatch.setattr(os, "fsync", lambda handle: release.wait(120.0) and fsync(handle))
    daemon.run()
    assert not release.is_set()
    release.set()
    until(lambda: len(lines(site.parent / "out")) == 9, "results are there")
    monkeypatch.undo()


# --- clocks ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("step_s", [3600.0, -7200.0, 1.0, -1.0, 0.004])
def test_the_datas_clock_jumps(site: Path, record: np.ndarray, cut: Cut, main: Cli, step_s: float) -> None:
    """Forward, backward, a leap second either way, half a sample: gaps at most, and the next run goes on all the same."""
    half = round(30 * RATE)
    # A node that was restarted: its counter begins anew too; else its samples' numbers would tell what the clock got wrong.
    stepped = [replace(b, t_ns=b.t_ns + round((30.0 + step_s) * S)) for b in cut(record[half:], RATE)]
    run_until(site, [*cut(record[:half], RATE), *stepped], 3)
    later = [
        replace(b, t_ns=b.t_ns + round((60.0 + step_s) * S), sequence=b.sequence + half) for b in cut(record, RATE)
    ]
    out = site.parent / "out"
    first = len(lines(out))
    daemon = Daemon(site, Scripted(later))
    daemon.run()
    found = lines(out)
    assert len(found) > first and any(line["skipped"] is None for line in found[first:])
    numbers = [line["window"] for line in found]
    assert numbers == sorted(set(numbers))
    done = main("replay", *own(out), "--structure", site, "--out", site.parent / "again")
    assert done.returncode == 0, done.stderr
    assert (site.parent / "again" / "results.jsonl").read_bytes() == (out / "results.jsonl").read_bytes()


def test_the_machines_clock_jumps(site: Path, record: np.ndarray, cut: Cut, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing but what health says of the wall clock depends on it."""
    hours = iter(np.tile([0, 5, -5, 1000], 10_000).tolist())
    now, now_ns = time.time, time.time_ns
    monkeypatch.setattr(time, "time", lambda: now() + 3600 * next(hours))
    monkeypatch.setattr(time, "time_ns", lambda: now_ns() + 3600 * S * next(hours))
    Daemon(site, Scripted(cut(record, RATE))).run()
    assert lines(site.parent / "out") == expected(site, cut(record, RATE))


# --- state -------------------------------------------------------------------------------------------------------------


def test_a_corrupt_checkpoint_costs_the_state_and_no_alarm(
    site: Path, record: np.ndarray, cut: Cut, caplog: pytest.LogCaptureFixture
) -> None:
    blocks = cut(record, RATE)
    run_until(site, blocks, 9)
    state = site.parent / "out" / "state"
    kept = state / "alarms"
    key = json.loads(kept.read_bytes().partition(b"\n")[0])["key"]
    alarms = serialization.load(kept, key, KeptAlarms)
    assert alarms is not None
    latched = replace(alarms.stories[1], level=Level.ALARM, latched=Level.ALARM)
    serialization.save(kept, key, KeptAlarms((alarms.stories[0], latched, *alarms.stories[2:])))
    for name in ("checkpoint", "checkpoint.previous"):
        if (state / name).exists():
            (state / name).write_bytes(b"\0" * 5000)
    caplog.set_level(logging.WARNING)
    later = [replace(b, t_ns=b.t_ns + 60 * S, sequence=b.sequence + len(record)) for b in blocks]
    Daemon(site, Scripted(later)).run()
    found, standing = lines(site.parent / "out"), summary(site.parent / "out")["alarm"]
    assert "not resumed from: this is no checkpoint" in caplog.text
    assert [line["window"] for line in found] == [*range(9), *range(9)]  # begun anew
    assert standing["level"] == "alarm" and standing["active"] == {"2": "alarm"}


def test_a_corrupt_database_is_set_aside(site: Path, record: np.ndarray, cut: Cut) -> None:
    state = site.parent / "out" / "state"
    state.mkdir(parents=True)
    (state / "history.db").write_bytes(b"\xff" * 10_000)
    Daemon(site, Scripted(cut(record, RATE))).run()
    assert len(lines(site.parent / "out")) == 9
    assert (state / "history.db.damaged-1").exists()
    database = sqlite3.connect(state / "history.db")
    assert database.execute("SELECT count(*) FROM windows").fetchone() == (9,)
    database.close()


# --- others ------------------------------------------------------------------------------------------------------------


def test_a_viewer_and_a_watcher_that_hang_hold_up_nothing(site: Path, record: np.ndarray, cut: Cut) -> None:
    """They connect and never say a word, nor read one; the address that messages go to takes the call and stays silent."""
    ports = [free_port() for _ in range(2)]
    with socket.create_server(("127.0.0.1", 0)) as silent:
        hook = f"http://127.0.0.1:{silent.getsockname()[1]}/"
        outputs = f'dir = "out"\nserve = "127.0.0.1:{ports[0]}"\n[output.metrics]\nlisten = "127.0.0.1:{ports[1]}"\n'
        notify = f'[notify]\nurls = ["json://{hook[7:]}"]\nheartbeat_url = "{hook}"\nheartbeat_s = 1.0\nblind_s = 1.0\n'
        site.write_text(notify + site.read_text().replace('dir = "out"\n', outputs))
        held: list[socket.socket] = []
        source = Scripted(cut(record, RATE))

        def connect() -> None:
            for port in ports:
                until(lambda p=port: _connects(p, held), "it listens")

        class Late(Scripted):
            def open(self) -> None:
                connect()

            def read(self, timeout_s: float) -> SampleBlock | None:
                return source.read(timeout_s)

        try:
            daemon = Daemon(site, Late([]))
            daemon.health(None)  # metrics begin to listen
            daemon.run()
        finally:
            for one in held:
                one.close()
    assert len(held) == 2
    assert lines(site.parent / "out") == expected(site, cut(record, RATE))


def _connects(port: int, held: list[socket.socket]) -> bool:
    try:
        held.append(socket.create_connection(("127.0.0.1", port), 5.0))
    except OSError:
        return False
    held[-1].sendall(b"GET /metrics HTTP/1.1\r\n")
    return True


@pytest.mark.parametrize("how", ["hangs", "killed"])
def test_a_diagnosis_that_hangs_or_is_killed_is_a_finding_and_ends_with_the_daemon(
    site: Path, record: np.ndarray, cut: Cut, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    text = site.read_text().replace(
        "diagnose = false", f"diagnose = true\ntime_limit_s = {1.0 if how == 'hangs' else 60.0}"
    )
    site.write_text(text)
    program = "import os, time; " + ("time.sleep(600)" if how == "hangs" else "os.kill(os.getpid(), 9)")
    started: list[subprocess.Popen[bytes]] = []

    class Bad(subprocess.Popen):  # type: ignore[type-arg]
        def __init__(self, command: list[str], **options: Any) -> None:
            super().__init__([sys.executable, "-c", program], **options)
            started.append(self)

    monkeypatch.setattr("monitor.runs.diagnosis_process.subprocess.Popen", Bad)
    daemon = Daemon(site, Scripted(cut(record, RATE)))
    daemon.session.online_diagnosis._submit(Request(T0_NS, T0_NS + S, "by hand"))
    daemon.run()
    (finding,) = summary(site.parent / "out")["findings"]
    assert finding["verdict"] is None
    assert len(lines(site.parent / "out")) == 9
    # The one that still runs when the daemon ends is ended with it.
    monkeypatch.setattr("monitor.runs.diagnosis_process.subprocess.Popen", Bad)
    daemon = Daemon(site, Endless(cut(record, RATE), 9))
    daemon.reader.source.daemon = daemon  # type: ignore[attr-defined]
    daemon.session.online_diagnosis._submit(Request(T0_NS, T0_NS + S, "by hand"))
    daemon.run()
    assert started and all(process.poll() is not None for process in started)


# --- memory ------------------------------------------------------------------------------------------------------------


def test_a_flood_fits_the_memory_that_the_unit_allows(site: Path, record: np.ndarray) -> None:
    """A stream as fast as it can be taken, in less than the MemoryHigh of deploy/shm-monitor.service."""
    folder = site.parent
    np.save(folder / "stream.npy", record.astype(np.float32))
    arguments = [site, folder / "stream.npy", folder / "position", 0, 0]
    with (folder / "log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "tests.support.live_site", *map(str, arguments)], stdout=log, stderr=log, cwd=ROOT
        )
    try:
        until(lambda: process.poll() is not None or len(lines(folder / "out")) >= 60, "windows")
        assert process.poll() is None, (folder / "log").read_text()
        status = Path(f"/proc/{process.pid}/status").read_text()
        assert int(status.partition("VmHWM:")[2].split()[0]) < 700 * 1024
        process.terminate()
        assert process.wait(60.0) == 0
    finally:
        process.kill()
        process.wait()


def test_memory_that_is_refused_ends_the_process_for_the_platform_to_start_again(
    site: Path, record: np.ndarray, cut: Cut
) -> None:
    """Rather than to go on half dead: a restart resumes."""

    class Greedy(Scripted):
        def read(self, timeout_s: float) -> SampleBlock | None:
            block = super().read(timeout_s)
            if self.given >= 50:
                raise MemoryError
            return block

        def health(self) -> SourceHealth:
            return SourceHealth(True, {})

    with pytest.raises(MemoryError):
        Daemon(site, Greedy(cut(record, RATE))).run()
    assert (site.parent / "out" / "state" / "checkpoint").exists()
    Daemon(site, Scripted(cut(record, RATE)[49:])).run()
    assert lines(site.parent / "out") == expected(site, cut(record, RATE))
