"""A flood of operators' requests on an open bus: windows go on, and ledger, database and disk grow at the rate of an operator."""

from __future__ import annotations

import json
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from drivers.zenoh_session import SessionSettings, open_session
from monitor.runs.ledger_chain import verify
from tests.support.site import SITE, lines
from tests.support.waiting import until
from tests.support.zenoh_router import free_port

pytestmark = pytest.mark.system

ROOT = Path(__file__).parents[2]
ZENOH = '[output.zenoh]\nmode = "peer"\nlisten = ["{endpoint}"]\n'
SHELVE = {"action": "shelve", "story": 2, "note": "a flood", "seconds": 3600.0}


@dataclass
class Running:
    """A daemon of its own process, on an endless stream that is faster than the clock."""

    endpoint: str
    out: Path
    process: subprocess.Popen[bytes]


@pytest.fixture
def running(tmp_path: Path, frame_text: str, record: np.ndarray) -> Iterator[Running]:
    endpoint, site = f"tcp/127.0.0.1:{free_port()}", tmp_path / "site.toml"
    table = ZENOH.format(endpoint=endpoint)
    site.write_text(SITE.replace('dir = "out"\n', f'dir = "out"\n{table}', 1) + frame_text)
    np.save(tmp_path / "stream.npy", record.astype(np.float32))
    arguments = [site, tmp_path / "stream.npy", tmp_path / "position", 0.05, 0]
    with (tmp_path / "log").open("wb") as log:
        command = [sys.executable, "-m", "tests.support.live_site", *map(str, arguments)]
        process = subprocess.Popen(command, stdout=log, stderr=log, cwd=ROOT)
    try:
        until(lambda: process.poll() is not None or lines(tmp_path / "out"), "a window")
        assert process.poll() is None, (tmp_path / "log").read_text()
        yield Running(endpoint, tmp_path / "out", process)
    finally:
        process.kill()
        process.wait()


class Asker(threading.Thread):
    """Asks again as soon as it has an answer; every request would change something."""

    def __init__(self, endpoint: str, who: str, ended: threading.Event) -> None:
        super().__init__(name=who)
        self._endpoint, self._ended = endpoint, ended
        self.asked = self.accepted = 0
        self.reasons: set[str] = set()

    def run(self) -> None:
        with open_session(SessionSettings(connect=(self._endpoint,)), Path()) as session:
            while not self._ended.is_set():
                action = "shelve" if self.accepted % 2 == 0 else "unshelve"
                text = json.dumps({**SHELVE, "action": action, "who": self.name, "story": 1 + (self.name == "Trudy")})
                self.asked += 1
                for reply in session.get("shm/bench/ack", payload=text, timeout=5.0):
                    if reply.ok is not None:
                        answer = json.loads(reply.ok.payload.to_bytes())
                        self.accepted += answer["accepted"]
                        self.reasons |= {answer["reason"]} - {None}


def test_two_askers_that_flood_it_stop_no_window_and_fill_no_ledger(running: Running) -> None:
    ended, before = threading.Event(), len(lines(running.out))
    askers = [Asker(running.endpoint, who, ended) for who in ("Mallory", "Trudy")]
    begun_s = time.monotonic()
    for asker in askers:
        asker.start()
    try:
        until(lambda: len(lines(running.out)) >= before + 8, "windows go on")
        until(lambda: all(asker.reasons for asker in askers), "both are refused")
    finally:
        ended.set()
        for asker in askers:
            asker.join(30.0)
    running.process.terminate()
    assert running.process.wait(30.0) == 0
    ended_s = time.monotonic()
    entries = verify(running.out / "ledger.jsonl")
    most = 2 * (10 + (ended_s - begun_s) / 6.0 + 1)  # ten at once and ten a minute from one name
    assert sum(asker.accepted for asker in askers) <= entries <= most
    assert all(asker.asked > asker.accepted >= 1 for asker in askers)
    assert {reason.partition(" of ")[0] for asker in askers for reason in asker.reasons} == {"too many requests"}
    with closing(sqlite3.connect(running.out / "state" / "history.db")) as database:
        assert database.execute("SELECT count(*) FROM requests").fetchone() == (entries,)
    assert all(line["skipped"] is None for line in lines(running.out))
    assert lines(running.out, "health.jsonl")[-1]["failed"] == {}
