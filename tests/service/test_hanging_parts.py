"""Parts of a running daemon that do not answer: a disk that hangs for longer than its queue lasts, an outlet that is stuck."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.base import SampleBlock, SourceError
from drivers.mcap_file import read_recordings
from drivers.recorder import Recorder
from monitor.core import Busy, WindowResult
from monitor.service.outlets.base import Outlet
from monitor.service.outlets.metrics import Metrics, MetricsSettings
from monitor.service.status import look
from tests.support.live_site import RATE
from tests.support.samples import Cut
from tests.support.site import SITE, Daemon, Scripted, Told, lines, own
from tests.support.waiting import until

pytestmark = pytest.mark.system

WINDOWS = 69
"""Of six minutes of data."""


@pytest.fixture
def site(tmp_path: Path, frame_text: str) -> Path:
    path = tmp_path / "site.toml"
    path.write_text(SITE.replace("min_free_gb = 0.0", "min_free_gb = 0.0\nflush_s = 1.0") + frame_text)
    return path


class ToldFirst(Told):
    """Calls `first` at the first window."""

    def __init__(self, first: Callable[[], None]) -> None:
        super().__init__()
        self._first = first

    def window(self, result: WindowResult, line: str) -> None:
        super().window(result, line)
        if len(self.lines) == 1:
            self._first()


class Ending(Scripted):
    """Gives its blocks, then nothing; once `enough` is true it asks the daemon to end."""

    def __init__(self, blocks: list[SampleBlock], enough: Callable[[], object]) -> None:
        super().__init__(blocks, hold=threading.Event())
        self._enough = enough
        self.asked_s: float | None = None

    def read(self, timeout_s: float) -> SampleBlock | None:
        block = super().read(timeout_s)
        if block is None and self.asked_s is None and self._enough():
            self.asked_s = time.monotonic()
            os.kill(os.getpid(), signal.SIGTERM)
        return block


def failed_outputs(metrics: Metrics) -> set[str]:
    """Names in `shm_output_failed`."""
    samples = [s for family in metrics.collect() for s in family.samples]
    return {s.labels["output"] for s in samples if s.name == "shm_output_failed"}


@contextmanager
def hanging(monkeypatch: pytest.MonkeyPatch, folder: Path, names: tuple[str, ...]) -> Iterator[threading.Event]:
    """Let calls of the disk below `folder` wait while the event that is given is clear; at the end it is set.

    It is set after a minute besides, so that a monitor that waits for the disk fails its test and does not hang in it.
    """
    answers = threading.Event()
    answers.set()

    def behind(call: Callable[..., Any]) -> Callable[..., Any]:
        def wait(handle: int, *arguments: Any) -> Any:
            if not answers.is_set() and os.readlink(f"/proc/self/fd/{handle}").startswith(str(folder)):
                answers.wait()
            return call(handle, *arguments)

        return wait

    for name in names:
        monkeypatch.setattr(os, name, behind(getattr(os, name)))
    last = threading.Timer(60.0, answers.set)
    last.start()
    try:
        yield answers
    finally:
        last.cancel()
        answers.set()


@pytest.mark.parametrize("names", [("fsync",), ("fsync", "write")], ids=["fsync", "fsync and write"])
def test_a_disk_that_hangs_longer_than_the_queue_lasts_stops_nothing_and_is_told(
    site: Path, record: np.ndarray, cut: Cut, monkeypatch: pytest.MonkeyPatch, names: tuple[str, ...]
) -> None:
    """The disk hangs from the first window on; 5400 blocks follow, and the recorder's queue holds 4096."""
    out = site.parent / "out"
    blocks = cut(np.tile(record, (6, 1)), RATE, [8])
    with hanging(monkeypatch, out, names) as answers:
        told, metrics = ToldFirst(answers.clear), Metrics("bench", MetricsSettings(listen="127.0.0.1:0"))

        def is_told() -> bool:
            """In health and metrics, and in the status as far as the disk takes what it reads."""
            said = "write" in names or any(
                trouble.startswith("recorder: does not answer") for trouble in look(out)["troubles"]
            )
            return said and "recorder" in told.failed_parts and "recorder" in failed_outputs(metrics)

        source = Ending(blocks, lambda: len(told.lines) == WINDOWS and is_told())
        Daemon(site, source, [told, metrics]).run()
        ended_s = time.monotonic()
        assert not answers.is_set() and len(blocks) == 5760 and len(told.lines) == WINDOWS
        assert source.asked_s is not None and ended_s - source.asked_s < 7.0  # 5 s are promised
        assert told.failed_parts["recorder"].startswith("does not answer for ")
        recorder = told.health_lines[-1]["recorder"]
        assert not recorder["recording"] and recorder["lost_blocks"] > 0
    until(lambda: len(lines(out)) == WINDOWS, "results are there")


def test_an_outlet_that_does_not_answer_is_told_once_and_so_is_its_return(site: Path) -> None:
    """A line of health comes when the outlet stops to answer and when it answers again, however long the usual interval."""
    seconds = [0.0]
    busy = Busy(lambda: seconds[0])

    class Stuck(Outlet):
        @property
        def failed(self) -> str | None:
            return busy.overdue

    told = Told()

    def script() -> Iterator[None]:
        busy.begin()
        for k in range(40):
            if k == 20:
                busy.end()
            seconds[0] += 1.0
            until(lambda: looked[0] > seconds[0], "the main loop looks")
            yield None

    looked = [0.0]

    def clock() -> float:
        looked[0] = seconds[0] + 0.5
        return seconds[0]

    Daemon(site, Scripted(script()), [Stuck(), told], clock=clock, tick_s=0.001, quiet_s=1e6).run()
    ready, failed, again, last = (line["failed"] for line in told.health_lines)
    assert ready == again == last == {} and failed.keys() == {"Stuck"}
    assert failed["Stuck"] in {f"does not answer for {k} s" for k in (5, 6, 7)}


def test_an_error_that_nobody_expected_of_a_recorder_costs_its_block_and_is_told(
    site: Path, record: np.ndarray, cut: Cut, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Until the main loop has told of it, every block fails; then blocks are recorded again."""
    told, blocks, write = Told(), cut(record, RATE), Recorder.write

    def is_told() -> bool:
        return any("recorder" in line["failed"] for line in told.health_lines)

    def failing(recorder: Recorder, block: SampleBlock) -> None:
        if block.sequence > 3000 and not is_told():
            raise RuntimeError("a bug")
        write(recorder, block)

    def script() -> Iterator[SampleBlock]:
        for k, block in enumerate(blocks):
            if k == len(blocks) - 10:
                until(is_told, "told")
            yield block

    monkeypatch.setattr(Recorder, "write", failing)
    Daemon(site, Scripted(script()), [told]).run()
    assert {"recorder": "RuntimeError: a bug"} in [line["failed"] for line in told.health_lines]
    assert told.failed_parts == {}
    assert len(lines(site.parent / "out")) == 9
    assert 0 < told.health_lines[-1]["recorder"]["lost_blocks"] < len(blocks)
    recorded = [block.sequence for block in read_recordings(own(site.parent / "out"))]
    assert recorded[0] == 0 and recorded[-1] == blocks[-1].sequence


@pytest.mark.parametrize("call", ["read", "close"])
def test_a_driver_that_does_not_answer_is_told_and_so_is_its_return(
    site: Path, record: np.ndarray, cut: Cut, call: str
) -> None:
    """It hangs after its last block: while it reads, or while it closes a bus that it has lost."""
    answers = threading.Event()
    told: list[str | None] = []

    def hang() -> None:
        if not answers.wait(60.0):  # it is not told: the test ends, and fails
            answers.set()
            os.kill(os.getpid(), signal.SIGTERM)

    class Hanging(Scripted):
        def read(self, timeout_s: float) -> SampleBlock | None:
            block = super().read(timeout_s)
            if block is None and call == "read":
                hang()
            elif block is None and not answers.is_set():
                raise SourceError("the bus is off")
            return block

        def close(self) -> None:
            if call == "close":
                hang()
            super().close()

    class Lines(Outlet):
        def health_line(self, line: Mapping[str, Any]) -> None:
            told.append(line["failed"].get("source"))
            if told[-1] is not None:
                answers.set()
            elif answers.is_set() and told[-2:-1] != [None]:
                os.kill(os.getpid(), signal.SIGTERM)

    Daemon(site, Hanging(cut(record, RATE)[:10], hold=answers), [Lines()]).run()
    said = [text for text in told if text is not None]
    assert len(said) == 1 and said[0].startswith("does not answer for ")
