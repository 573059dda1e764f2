"""What goes wrong at a source that is connected, or that does not answer when it is opened, stands in the status."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import pytest

from drivers.base import SampleBlock, SourceHealth
from monitor.core import Busy
from monitor.service.daemon_health import Vitals
from monitor.service.lease import FolderLease
from monitor.service.status import look, tell, troubles_of
from monitor.service.threads import Reader
from tests.support.site import Scripted
from tests.support.waiting import until

REFUSED = "a block of /acceleration is refused, 7 so far: unknown unit 'g'"


class Fixed:
    """A source that says of itself what it is told to, and answers `open` once `answers` is set."""

    def __init__(self, health: SourceHealth, answers: threading.Event | None = None) -> None:
        self._health, self._answers, self.asked = health, answers, threading.Event()

    def open(self) -> None:
        self.asked.set()
        if self._answers is not None:
            self._answers.wait(60.0)

    def read(self, timeout_s: float) -> SampleBlock | None:
        return None

    def health(self) -> SourceHealth:
        return self._health

    def close(self) -> None: ...


@pytest.mark.parametrize(
    ("health", "row", "troubles"),
    [
        (SourceHealth(True, {}, (), "", REFUSED), f"connected, lost 0 times; {REFUSED}; no data", []),
        (SourceHealth(True, {"links_lost": 2}), "connected, lost 2 times; no data", []),
        (
            SourceHealth(False, {"links_lost": 1}, (), "another client came", "another client came (1 times)"),
            "NOT connected another client came, lost 1 times; no data",
            ["source: another client came"],
        ),
    ],
)
def test_the_status_tells_what_the_source_says(
    health: SourceHealth, row: str, troubles: list[str], tmp_path: Path
) -> None:
    line = Vitals(tmp_path).line(None, Reader(Fixed(health)), None, ())
    (tmp_path / "state").mkdir()
    (tmp_path / "health.jsonl").write_text(json.dumps(line) + "\n")
    lease = FolderLease(tmp_path)
    lease.acquire()  # as the daemon that runs
    try:
        assert f"source    {row}" in tell(look(tmp_path))
    finally:
        lease.release()
    assert troubles_of(line) == troubles


def test_a_block_that_the_monitor_refuses_is_told_with_its_reason(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    vitals = Vitals(tmp_path)
    for _ in range(3):
        vitals.refuse("channels b1 are none of the structure's")
    line = vitals.line(None, Reader(Fixed(SourceHealth(True, {}))), None, ())
    assert caplog.messages == ["a block is refused, 1 so far: channels b1 are none of the structure's"]
    assert line["source"]["trouble"] == "a block is refused, 3 so far: channels b1 are none of the structure's"


def test_a_source_that_cannot_be_closed_ends_reading_all_the_same(caplog: pytest.LogCaptureFixture) -> None:
    class Stuck(Scripted):
        def close(self) -> None:
            raise RuntimeError("the bus is gone")

    reader = Reader(Stuck([]))
    reader.start()
    until(lambda: reader.queue.over, "it has ended")
    assert reader.ended and reader.failure is None
    until(lambda: "source: not closed" in caplog.messages, "it is logged")


def test_a_source_that_does_not_answer_when_it_is_opened_is_told() -> None:
    seconds, answers = [0.0], threading.Event()
    source = Fixed(SourceHealth(True, {}), answers)
    reader = Reader(source, busy=Busy(lambda: seconds[0]))
    reader.start()
    try:
        until(source.asked.is_set, "it is opened")
        assert reader.failed is None
        seconds[0] = 7.0
        assert reader.failed == "does not answer for 7 s"
        answers.set()
        until(lambda: reader.opened and reader.failed is None, "it answered")
    finally:
        answers.set()
        reader.stop(10.0)
