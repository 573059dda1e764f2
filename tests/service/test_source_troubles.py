"""What goes wrong at a source that is connected, or that does not answer when it is opened, stands in the status."""

from __future__ import annotations

import json
import re
import threading
from pathlib import Path

import pytest

from drivers.base import SampleBlock, SourceError, SourceHealth
from monitor.core import Busy
from monitor.service.daemon_health import Vitals
from monitor.service.lease import FolderLease
from monitor.service.status import look, tell, troubles_of
from monitor.service.threads import Reader
from monitor.service.web.snapshots import Snapshots
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
        (SourceHealth(True, {}, (), "", REFUSED), f"connected, lost 0 times; {re.escape(REFUSED)}; no data", []),
        (SourceHealth(True, {"links_lost": 2}), "connected, lost 2 times; no data", []),
        (
            SourceHealth(False, {"links_lost": 1}, (), "another client came", "another client came (1 times)"),
            "lost since 20[-0-9]+ [0-9:]+ UTC \\(another client came\\); it is tried again; 1 time lost; no data",
            ["source: lost since 20[-0-9]+ [0-9:]+ UTC \\(another client came\\); it is tried again; 1 time lost"],
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
        assert re.search(f"source    {row}", tell(look(tmp_path)))
    finally:
        lease.release()
    said = troubles_of(line)
    assert len(said) == len(troubles)
    assert all(re.fullmatch(pattern, text) for pattern, text in zip(troubles, said, strict=True))


class Refusing(Fixed):
    """A source that cannot be opened."""

    def open(self) -> None:
        raise SourceError("connection refused")


def test_a_source_that_is_lost_is_told_everywhere_with_its_reason_since_when_and_when_it_is_tried_again(
    tmp_path: Path,
) -> None:
    vitals, reader = Vitals(tmp_path), Reader(Refusing(SourceHealth(False, {})))
    reader.start()
    try:
        until(lambda: reader.lost == 2, "it was tried twice")
        line = vitals.line(None, reader, None, ())
        again = vitals.line(None, reader, None, ())
    finally:
        reader.stop(10.0)
    says = line["source"]["says"]
    assert re.fullmatch(
        r"lost since 20[-0-9]+ [0-9:]+ UTC \(connection refused\); tried again in [012] s; 2 times lost", says
    )
    assert again["source"]["away_since_ns"] == line["source"]["away_since_ns"]
    (tmp_path / "state").mkdir()
    (tmp_path / "health.jsonl").write_text(json.dumps(line) + "\n")
    lease = FolderLease(tmp_path)
    lease.acquire()  # as the daemon that runs
    try:
        found = look(tmp_path)
    finally:
        lease.release()
    page = Snapshots("bench")
    page.health(line)
    assert found["troubles"] == [f"source: {says}"] == json.loads(page.answer("status").body)["troubles"]
    assert f"source    {says}; " in tell(found)


def test_a_source_that_is_being_opened_for_the_first_time_is_not_called_lost(tmp_path: Path) -> None:
    line = Vitals(tmp_path).line(None, Reader(Fixed(SourceHealth(False, {}))), None, ())
    assert line["source"]["says"] == line["source"]["error"] == "the monitor is starting"


def test_blocks_that_are_refused_stand_beside_what_is_blocked(tmp_path: Path) -> None:
    vitals = Vitals(tmp_path)
    vitals.refuse("channels b1 are none of the structure's")
    line = vitals.line(None, Reader(Fixed(SourceHealth(True, {}))), None, ())
    (tmp_path / "state").mkdir()
    (tmp_path / "health.jsonl").write_text(json.dumps(line) + "\n")
    lease = FolderLease(tmp_path)
    lease.acquire()  # as the daemon that runs
    try:
        monitor = tell(look(tmp_path)).splitlines()[1]
    finally:
        lease.release()
    assert monitor.endswith("; blocks refused: 1, the latest: channels b1 are none of the structure's")


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
