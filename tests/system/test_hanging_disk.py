"""A disk of which every call waits, reads and writes, or that is full, under a running daemon: a file system in user space.

Only root may mount one; elsewhere `test_hanging_parts` stands for it, in which calls of the disk wait within the process, and
`test_service_faults`, which fills a small one.
"""

from __future__ import annotations

import json
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from monitor.runs.ledger_chain import verify
from monitor.service import ZenohOutSettings, ask, serialization
from monitor.service.restart import KeptAlarms
from tests.support.faulty_disk import Disk, faulty_disk, is_possible
from tests.support.http import fetch
from tests.support.site import SITE, lines
from tests.support.waiting import until
from tests.support.zenoh_router import free_port

pytestmark = [pytest.mark.system, pytest.mark.skipif(not is_possible(), reason="only root may mount a disk")]

ROOT = Path(__file__).parents[2]
TABLES = """
[output.metrics]
listen = "127.0.0.1:{port}"
[output.zenoh]
mode = "peer"
listen = ["tcp/127.0.0.1:{bus}"]
"""


@dataclass
class Site:
    """A daemon on a disk that can hang."""

    file: Path
    out: Path
    port: int
    bus: int
    disk: Disk
    process: subprocess.Popen[bytes]

    def metrics(self) -> dict[str, float]:
        text = fetch(self.port).decode()
        rows = (row.rpartition(" ") for row in text.splitlines() if row and not row.startswith("#"))
        return {name: float(value) for name, _, value in rows}

    def shelve(self, story: int) -> dict[str, Any] | None:
        """Ask over Zenoh for 30 days without an announcement of a story; the answer, or None where there is none."""
        wish = {
            "action": "shelve",
            "story": story,
            "who": "Ada",
            "note": "while the disk is full",
            "seconds": 2_592_000.0,
        }
        settings = ZenohOutSettings(mode="peer", listen=(f"tcp/127.0.0.1:{self.bus}",))
        return ask(settings, Path(), "shm/bench", json.dumps(wish), 10.0)

    def windows(self) -> float:
        return self.metrics()["shm_windows_total"]

    def failed(self) -> set[str]:
        names = (name.partition('output="')[2] for name in self.metrics() if name.startswith("shm_output_failed"))
        return {name.partition('"')[0] for name in names}


@pytest.fixture
def running(tmp_path: Path, frame_text: str, record: np.ndarray) -> Iterator[Site]:
    """Five windows old."""
    backing, out, port, bus = tmp_path / "backing", tmp_path / "out", free_port(), free_port()
    backing.mkdir()
    out.mkdir()
    site = tmp_path / "site.toml"
    text = SITE.replace('dir = "out"\n', f'dir = "out"{TABLES.format(port=port, bus=bus)}', 1)
    site.write_text(text.replace("min_free_gb = 0.0", "min_free_gb = 0.0\nflush_s = 1.0") + frame_text)
    np.save(tmp_path / "stream.npy", record.astype(np.float32))
    arguments = [site, tmp_path / "stream.npy", tmp_path / "position", 0.05, 0]
    with faulty_disk(backing, out) as disk, (tmp_path / "log").open("wb") as log:
        command = [sys.executable, "-m", "tests.support.live_site", *map(str, arguments)]
        process = subprocess.Popen(command, stdout=log, stderr=log, cwd=ROOT)
        try:
            until(lambda: process.poll() is not None or len(lines(out)) >= 5, "windows")
            assert process.poll() is None, (tmp_path / "log").read_text()
            yield Site(site, out, port, bus, disk, process)
        finally:
            process.kill()
            disk.answer()
            process.wait()


def test_windows_go_on_what_does_not_answer_is_told_and_all_is_there_when_the_disk_answers(running: Site) -> None:
    """A reload while the disk hangs, and a request that was left in the folder before, wait for it and hold up nothing."""
    requests = running.out / "state" / "requests"
    (requests / "1.json").write_text('{"action": "acknowledge", "story": 1, "who": "ann"}')
    running.disk.hang()
    begun_s, before = time.monotonic(), running.windows()
    running.file.write_text(running.file.read_text() + "\n[alarm]\nconfirm_s = 40.0\n")
    running.process.send_signal(signal.SIGHUP)
    until(lambda: {"recorder", "results.jsonl"} <= running.failed(), "told")
    assert time.monotonic() - begun_s < 10.0
    until(lambda: running.windows() >= before + 15, "windows go on")
    running.disk.answer()
    until(lambda: not running.failed(), "all answers")
    until(lambda: not list(requests.glob("*.json")), "the request is dealt with")
    until(lambda: (running.out / "ledger.jsonl").exists(), "the reload is in the ledger")
    running.process.terminate()
    assert running.process.wait(10.0) == 0
    found = lines(running.out)
    assert [line["window"] for line in found] == list(range(len(found))) and len(found) >= before + 15


def test_it_ends_in_time_while_the_disk_hangs(running: Site) -> None:
    """What is left then is no program: the kernel waits for the disk to take the database's page that was mapped."""
    running.disk.hang()
    until(lambda: running.failed(), "told")
    begun_s = time.monotonic()
    running.process.terminate()
    until(lambda: state(running.process.pid) == "Z", "ended")
    assert time.monotonic() - begun_s < 6.0  # 5 s are promised; the machine is busy
    running.disk.answer()
    assert running.process.wait(10.0) == 0


def test_on_a_full_disk_a_request_is_refused_and_changes_nothing(running: Site) -> None:
    """Story 2 is to be shelved while the disk is full, story 1 when there is room: only that one ever is, and is kept."""
    running.disk.fill()
    until(lambda: "results.jsonl" in running.failed(), "the disk is full")
    begun = running.windows()
    refused = running.shelve(2)
    assert refused is not None and not refused["accepted"]
    assert "ledger.jsonl: cannot be written: No space left on device" in refused["reason"]
    until(lambda: "ledger.jsonl" in running.failed(), "told")
    until(lambda: running.windows() >= begun + 4, "windows go on")
    running.disk.make_room()
    until(lambda: (running.shelve(1) or {}).get("accepted"), "accepted")
    running.process.terminate()
    assert running.process.wait(30.0) == 0
    (row,) = (running.out / "ledger.jsonl").read_text().splitlines()
    assert "shelve alarm of story 1" in row and "Ada" in row and verify(running.out / "ledger.jsonl") == 1
    with closing(sqlite3.connect(running.out / "state" / "history.db")) as database:
        assert database.execute("SELECT story FROM requests").fetchall() == [(1,)]
    kept = running.out / "state" / "alarms"
    alarms = serialization.load(kept, json.loads(kept.read_bytes().partition(b"\n")[0])["key"], KeptAlarms)
    assert alarms is not None
    assert [story.shelved is not None for story in alarms.stories[:3]] == [True, False, False]


def state(process_id: int) -> str:
    """One letter of the kernel: Z for a process whose program has ended."""
    return Path(f"/proc/{process_id}/stat").read_text().rpartition(")")[2].split()[0]
