"""A disk of which every call waits, reads and writes, or that is full, under a running daemon: a file system in user space.

Only root may mount one; elsewhere `test_hanging_parts` stands for it, in which calls of the disk wait within the process, and
`test_service_faults`, which fills a small one.
"""

from __future__ import annotations

import json
import signal
import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from monitor.runs import ledger_chain
from monitor.service import ZenohOutSettings, ask
from tests.support.faulty_disk import Disk, faulty_disk, is_possible
from tests.support.http import fetch
from tests.support.live_site import LiveDaemon, save_stream
from tests.support.site import SITE
from tests.support.waiting import until
from tests.support.zenoh_router import free_port

pytestmark = [pytest.mark.system, pytest.mark.skipif(not is_possible(), reason="only root may mount a disk")]

PACE_S = 0.025
"""Between two blocks of half a second: four windows a second."""
TABLES = """
[output.metrics]
listen = "127.0.0.1:{port}"
[output.zenoh]
mode = "peer"
listen = ["tcp/127.0.0.1:{bus}"]
"""
WISH = {"who": "Ada", "note": "while the disk is full", "seconds": 2_592_000.0}


@dataclass
class Site:
    """A daemon on a disk that can hang."""

    file: Path
    port: int
    bus: int
    disk: Disk
    daemon: LiveDaemon

    def metrics(self) -> dict[str, float]:
        text = fetch(self.port).decode()
        rows = (row.rpartition(" ") for row in text.splitlines() if row and not row.startswith("#"))
        return {name: float(value) for name, _, value in rows}

    def ask(self, action: str, story: int) -> dict[str, Any] | None:
        """Ask over Zenoh for (or an end of) 30 days without an announcement of a story; None if there is no answer."""
        settings = ZenohOutSettings(mode="peer", listen=(f"tcp/127.0.0.1:{self.bus}",))
        return ask(settings, Path(), "shm/bench", json.dumps({**WISH, "action": action, "story": story}), 10.0)

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
    save_stream(tmp_path, record)
    with faulty_disk(backing, out) as disk, LiveDaemon(tmp_path, PACE_S) as daemon:
        try:
            daemon.wait_for_windows(5)
            yield Site(site, port, bus, disk, daemon)
        finally:
            disk.answer()


def test_windows_go_on_what_does_not_answer_is_told_and_all_is_there_when_the_disk_answers(running: Site) -> None:
    """A reload while the disk hangs, and a request that was left in the folder before, wait for it and hold up nothing."""
    out, daemon = running.daemon.out, running.daemon
    requests = out / "state" / "requests"
    (requests / "1.json").write_text('{"action": "acknowledge", "story": 1, "who": "ann"}')
    running.disk.hang()
    begun_s, before = time.monotonic(), running.windows()
    running.file.write_text(running.file.read_text() + "\n[alarm]\nfalse_announcements_per_year = 0.2\n")
    daemon.send(signal.SIGHUP)
    until(lambda: {"recorder", "results.jsonl"} <= running.failed(), "told")
    assert time.monotonic() - begun_s < 10.0
    until(lambda: running.windows() >= before + 15, "windows go on")
    running.disk.answer()
    until(lambda: not running.failed(), "all answers")
    until(lambda: not list(requests.glob("*.json")), "the request is dealt with")
    until(lambda: (out / "ledger.jsonl").exists(), "the reload is in the ledger")
    code, seconds = daemon.stop()
    assert code == 0 and seconds < 10.0
    found = daemon.windows
    assert [line["window"] for line in found] == list(range(len(found))) and len(found) >= before + 15


def test_it_ends_in_time_while_the_disk_hangs(running: Site) -> None:
    """What is left then is no program: the kernel waits for the disk to take the database's page that was mapped."""
    running.disk.hang()
    until(lambda: running.failed(), "told")
    begun_s = time.monotonic()
    running.daemon.send(signal.SIGTERM)
    until(lambda: running.daemon.code is not None or running.daemon.status["State"].startswith("Z"), "ended")
    assert time.monotonic() - begun_s < 6.0  # 5 s are promised; the machine is busy
    running.disk.answer()
    assert running.daemon.wait(10.0) == 0


def test_on_a_full_disk_a_request_is_refused_and_changes_nothing(running: Site) -> None:
    """Story 2 is to be shelved while the disk is full, story 1 when there is room: only that one ever is, and is kept."""
    out, daemon = running.daemon.out, running.daemon
    running.disk.fill()
    until(lambda: "results.jsonl" in running.failed(), "the disk is full")
    begun = running.windows()
    refused = running.ask("shelve", 2)
    assert refused is not None and not refused["accepted"]
    assert "ledger.jsonl: cannot be written: No space left on device" in refused["reason"]
    until(lambda: "ledger.jsonl" in running.failed(), "told")
    until(lambda: running.windows() >= begun + 4, "windows go on")
    running.disk.make_room()
    until(lambda: (running.ask("shelve", 1) or {}).get("accepted"), "accepted")
    assert daemon.stop()[0] == 0
    (row,) = (out / "ledger.jsonl").read_text().splitlines()
    assert "shelve alarm of story 1" in row and "Ada" in row and ledger_chain.verify(out / "ledger.jsonl") == 1
    with closing(sqlite3.connect(out / "state" / "history.db")) as database:
        assert database.execute("SELECT story FROM requests").fetchall() == [(1,)]
    before = len(daemon.windows)
    with LiveDaemon(running.file.parent, PACE_S) as again:
        again.until(lambda: len(again.windows) > before, "a window after the restart")
        for story in (2, 1):
            until(lambda story=story: (running.ask("unshelve", story) or {}).get("accepted"), "accepted")
        assert again.stop()[0] == 0
    rows = (out / "ledger.jsonl").read_text().splitlines()
    assert len(rows) == 2 and "story 1" in rows[1], "only what changes something is noted: story 2 was not shelved"
