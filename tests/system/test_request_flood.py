"""A flood of operators' requests on an open bus: windows go on, and ledger, database and disk grow at the rate of an operator."""

from __future__ import annotations

import json
import sqlite3
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from drivers.zenoh_session import SessionSettings, open_session
from monitor.runs import ledger_chain
from tests.support.live_site import LiveDaemon, save_stream
from tests.support.site import SITE
from tests.support.zenoh_router import free_port

pytestmark = pytest.mark.system

ZENOH = '[output.zenoh]\nmode = "peer"\nlisten = ["{endpoint}"]\n'
SHELVE = {"action": "shelve", "story": 2, "note": "a flood", "seconds": 3600.0}


@pytest.fixture
def running(tmp_path: Path, frame_text: str, record: np.ndarray) -> Iterator[tuple[LiveDaemon, str]]:
    """A daemon on an endless stream that is faster than the clock, and its endpoint."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    site = SITE.replace('dir = "out"\n', f'dir = "out"\n{ZENOH.format(endpoint=endpoint)}', 1)
    (tmp_path / "site.toml").write_text(site + frame_text)
    save_stream(tmp_path, record)
    with LiveDaemon(tmp_path, 0.025) as daemon:
        daemon.wait_for_windows(1)
        yield daemon, endpoint


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


def test_two_askers_that_flood_it_stop_no_window_and_fill_no_ledger(running: tuple[LiveDaemon, str]) -> None:
    daemon, endpoint = running
    ended, before = threading.Event(), len(daemon.windows)
    askers = [Asker(endpoint, who, ended) for who in ("Mallory", "Trudy")]
    begun_s = time.monotonic()
    for asker in askers:
        asker.start()
    try:
        daemon.wait_for_windows(before + 8)
        daemon.until(lambda: all(asker.reasons for asker in askers), "both are refused")
    finally:
        ended.set()
        for asker in askers:
            asker.join(30.0)
    assert daemon.stop()[0] == 0
    ended_s = time.monotonic()
    entries = ledger_chain.verify(daemon.out / "ledger.jsonl")
    most = 2 * (10 + (ended_s - begun_s) / 6.0 + 1)  # ten at once and ten a minute from one name
    assert sum(asker.accepted for asker in askers) <= entries <= most
    assert all(asker.asked > asker.accepted >= 1 for asker in askers)
    assert {reason.partition(" of ")[0] for asker in askers for reason in asker.reasons} == {"too many requests"}
    with closing(sqlite3.connect(daemon.out / "state" / "history.db")) as database:
        assert database.execute("SELECT count(*) FROM requests").fetchone() == (entries,)
    assert all(line["skipped"] is None for line in daemon.windows)
    assert daemon.failed == {}
