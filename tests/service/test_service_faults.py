"""Faults of the machine under a running daemon: disks, clocks, state, whoever it talks to, memory.

What each costs is told in docs/operations.md; kill -9 is tests/service/test_restart.py,
faults of the source tests/system/test_live_faults.py.
"""

from __future__ import annotations

import ctypes
import json
import logging
import os
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.base import SampleBlock, SourceHealth
from drivers.mcap_file import McapWriter, read_recordings
from monitor.core import Level
from monitor.diagnosis import Request
from monitor.service import history, serialization
from monitor.service.restart import KeptAlarms
from tests.support import live_site
from tests.support.commands import ended
from tests.support.live_site import RATE, LiveDaemon
from tests.support.samples import T0_NS, Cli, Cut
from tests.support.site import (
    SITE,
    Daemon,
    Endless,
    Scripted,
    Told,
    judged_lines,
    lines,
    own,
    run_until,
    summary,
    write,
)
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


# --- disks -------------------------------------------------------------------------------------------------------------


def on_a_small_disk(size: str, site: Path, *arguments: Any) -> None:
    """Monitor in a namespace of one's own, where the output folder is a file system of this size."""
    user, group = os.getuid(), os.getgid()
    if ctypes.CDLL(None).unshare(0x1000_0000 | 0x0002_0000):  # for users and mounts
        print("no namespaces here")
        return
    for name, text in (("setgroups", "deny"), ("uid_map", f"0 {user} 1"), ("gid_map", f"0 {group} 1")):
        Path(f"/proc/self/{name}").write_text(text)
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "none", site.parent / "out"], check=True)
    print("mounted")
    live_site.daemon(site, *arguments)


def test_a_full_disk_costs_recordings_and_no_result(site: Path, record: np.ndarray) -> None:
    site.write_text(site.read_text() + "\n[state]\ncheckpoint_s = 10.0\n")
    folder = site.parent
    (folder / "out").mkdir()
    live_site.save_stream(folder, record)
    with LiveDaemon(folder, 0.025, work=partial(on_a_small_disk, "4m")) as daemon, ExitStack() as undo:
        until(lambda: daemon.code is not None or "mounted" in daemon.said, "a small disk")
        if "no namespaces" in daemon.said:
            pytest.skip("no mount namespaces here")
        seen = os.open(f"/proc/{daemon.pid}/root{folder}/out", os.O_RDONLY)  # after the daemon's end, too
        undo.callback(os.close, seen)
        out = daemon.out = Path(f"/proc/self/fd/{seen}")
        daemon.wait_for_windows(2)
        with suppress(OSError):
            (out / "filler").write_bytes(bytes(8 << 20))
        before = daemon.given
        daemon.until(lambda: daemon.given >= before + 120, "a minute of data")  # blocks of half a second
        daemon.wait_for("no checkpoint")
        (out / "filler").unlink()
        daemon.wait_for_windows(len(daemon.windows) + 6)
        daemon.until(lambda: lines(out, "health.jsonl")[-1]["recorder"]["recording"], "the recorder goes on")
        daemon.until(lambda: not daemon.failed, "nothing is blocked")
        assert daemon.stop()[0] == 0
        found = daemon.windows
        assert [line["window"] for line in found] == list(range(len(found)))
        assert all(line["skipped"] is None for line in found)
        assert lines(out, "health.jsonl")[-1]["recorder"]["lost_blocks"] > 0
        assert (out / "state" / "checkpoint").exists() and not list(out.rglob("*.damaged*"))
    assert "Traceback" not in daemon.said


def test_a_read_only_disk_is_one_message_at_start(site: Path) -> None:
    script = "mount -t tmpfs -o ro none $0 && exec $1 -m monitor run $2"
    (site.parent / "out").mkdir()
    write(site.parent / "rec.mcap", [])
    command = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c", script]
    done = ended(*command, site.parent / "out", sys.executable, site, cwd=ROOT)
    if "mount" in done.stderr or "unshare" in done.stderr:
        pytest.skip("no mount namespaces here")
    assert done.returncode == 66 and done.stderr.count("\n") == 1 and "cannot be written: Read-only" in done.stderr


def test_a_disk_that_turns_read_only_stops_no_result(
    site: Path, record: np.ndarray, cut: Cut, monkeypatch: pytest.MonkeyPatch
) -> None:
    told, blocks = Told(), cut(record, RATE)

    def script() -> Iterator[SampleBlock]:
        yield from blocks[:-1]
        until(lambda: {"health.jsonl", "history"} <= told.failed_parts.keys(), "told")
        yield blocks[-1]

    daemon = Daemon(site, Scripted(script()), [told])
    really = os.write

    def refuse(*_: object, **__: object) -> None:
        raise OSError(30, os.strerror(30))

    def refuse_sql(*_: object) -> None:
        raise sqlite3.OperationalError("attempt to write a readonly database")

    def write(handle: int, data: bytes) -> int:
        if os.readlink(f"/proc/self/fd/{handle}").startswith(str(site.parent)):
            refuse()
        return really(handle, data)  # pipes and sockets go on as before

    for place, name, how in (
        (os, "write", write),
        (os, "replace", refuse),
        (os, "fsync", refuse),
        (McapWriter, "__init__", refuse),
        (history.History, "_write", refuse_sql),
    ):
        monkeypatch.setattr(place, name, how)
    daemon.run()
    monkeypatch.undo()
    assert [json.loads(line) for line in told.lines] == judged_lines(site, blocks)
    assert told.health_lines[-1]["recorder"]["lost_blocks"] > 0


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
    assert lines(site.parent / "out") == judged_lines(site, cut(record, RATE))
    assert list(read_recordings(own(site.parent / "out")))


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
    assert lines(site.parent / "out") == judged_lines(site, cut(record, RATE))


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
            daemon.site.health(None)  # metrics begin to listen
            daemon.run()
        finally:
            for one in held:
                one.close()
    assert len(held) == 2
    assert lines(site.parent / "out") == judged_lines(site, cut(record, RATE))


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
    limit_s = 1.0 if how == "hangs" else 60.0
    site.write_text(site.read_text().replace("diagnose = false", f"diagnose = true\ntime_limit_s = {limit_s}"))
    program = "import os, time; " + ("time.sleep(600)" if how == "hangs" else "os.kill(os.getpid(), 9)")
    started: list[subprocess.Popen[bytes]] = []

    class Bad(subprocess.Popen):  # type: ignore[type-arg]
        def __init__(self, command: list[str], **options: Any) -> None:
            super().__init__([sys.executable, "-c", program], **options)
            started.append(self)

    def ask_for_a_diagnosis(daemon: Daemon) -> None:
        """As a run does that goes on from a checkpoint with one pending."""
        diagnosis = daemon.session.online_diagnosis
        request = Request(T0_NS, T0_NS + S, "by hand")
        diagnosis.restore(replace(diagnosis.state, pending=(request,), asked=1))

    monkeypatch.setattr(subprocess, "Popen", Bad)
    daemon = Daemon(site, Scripted(cut(record, RATE)))
    ask_for_a_diagnosis(daemon)
    daemon.run()
    (finding,) = summary(site.parent / "out")["findings"]
    assert finding["verdict"] is None
    assert len(lines(site.parent / "out")) == 9
    # The one that still runs when the daemon ends is ended with it.
    source = Endless(cut(record, RATE), 9)
    source.daemon = daemon = Daemon(site, source)
    ask_for_a_diagnosis(daemon)
    daemon.run()
    assert len(started) == 2 and all(process.poll() is not None for process in started)


# --- memory ------------------------------------------------------------------------------------------------------------


def test_a_flood_fits_the_memory_that_the_unit_allows(site: Path, record: np.ndarray) -> None:
    """A stream as fast as it can be taken, in less than the MemoryHigh of deploy/shm-monitor.service."""
    live_site.save_stream(site.parent, record)
    with LiveDaemon(site.parent, 0.0) as daemon:
        daemon.wait_for_windows(60)
        assert int(daemon.status["VmHWM"].split()[0]) < 700 * 1024
        assert daemon.stop()[0] == 0


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
    assert lines(site.parent / "out") == judged_lines(site, cut(record, RATE))
