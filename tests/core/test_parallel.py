"""Work on all cores comes back as if it had been done by one."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
import threading
import time
import warnings
from pathlib import Path

import numpy as np
import pytest

from monitor.core.errors import NoResourcesError
from monitor.core.parallel import parallel_map
from tests.support.commands import ended
from tests.support.waiting import until

CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
ENDLESS = """
import os, signal, sys, time
from pathlib import Path
from monitor.core import parallel_map

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it

def work(i):
    (Path(sys.argv[1]) / str(os.getpid())).touch()
    time.sleep(600)

parallel_map(work, range(2))
"""


def test_results_stand_in_the_order_of_the_items() -> None:
    def slow(n: int) -> int:
        time.sleep(0.01 * (5 - n))
        return n * n

    assert parallel_map(slow, range(5)) == [0, 1, 4, 9, 16]
    assert parallel_map(slow, []) == []


def test_the_callers_handling_of_errors_holds() -> None:
    def overflow(x: float) -> float:
        return float(np.float64(x) * 1e308)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with np.errstate(over="ignore"):
            assert parallel_map(overflow, [10.0, 1.0]) == [np.inf, 1e308]
        with np.errstate(over="raise"), pytest.raises(FloatingPointError):
            parallel_map(overflow, [10.0])


def test_what_an_item_raises_reaches_the_caller_and_nothing_else_is_told(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ZeroDivisionError):
        parallel_map(lambda n: 1 / n, [1, 0, *range(2, 40)])
    assert capfd.readouterr().err == ""


def _worked_in(n: int) -> set[int]:
    return set(parallel_map(lambda _: os.getpid(), range(n)))


@pytest.mark.skipif(CORES < 2, reason="one core")
def test_work_is_done_beside_the_caller() -> None:
    if threading.active_count() > 1:
        pytest.skip("another test's thread still runs")
    assert os.getpid() not in _worked_in(20)


def test_one_after_the_other_within_a_share_of_the_work_and_beside_threads() -> None:
    assert all(len(pids) == 1 for pids in parallel_map(lambda _: _worked_in(4), range(2)))
    over = threading.Event()
    other = threading.Thread(target=over.wait)
    other.start()
    try:
        assert _worked_in(4) == {os.getpid()}
    finally:
        over.set()
        other.join()


@pytest.mark.skipif(CORES < 2, reason="one core")
def test_nothing_outlives_a_caller_that_is_killed(tmp_path: Path) -> None:
    caller = subprocess.Popen([sys.executable, "-c", ENDLESS, str(tmp_path)])
    try:
        until(lambda: len(list(tmp_path.iterdir())) == 2, "both work")
    finally:
        caller.send_signal(signal.SIGKILL)
        caller.wait()
    until(lambda: not any(_runs(int(pid.name)) for pid in tmp_path.iterdir()), "both have ended")


@pytest.mark.skipif(CORES < 2, reason="one core")
def test_an_interrupt_ends_the_work_at_once(tmp_path: Path) -> None:
    caller = subprocess.Popen(
        [sys.executable, "-c", ENDLESS, str(tmp_path)], stderr=subprocess.PIPE, start_new_session=True
    )
    until(lambda: len(list(tmp_path.iterdir())) == 2, "both work")
    os.killpg(caller.pid, signal.SIGINT)  # as a terminal does
    told = caller.communicate(timeout=30)[1]
    assert b"KeyboardInterrupt" in told
    assert b"Process ForkProcess" not in told
    until(lambda: not any(_runs(int(pid.name)) for pid in tmp_path.iterdir()), "both have ended")


@pytest.mark.skipif(CORES < 2, reason="one core")
def test_work_that_is_killed_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threading, "active_count", lambda: 1)
    with pytest.raises(NoResourcesError, match="killed"):
        parallel_map(lambda _: os.kill(os.getpid(), signal.SIGKILL), range(2))


@pytest.mark.skipif(CORES < 2, reason="one core")
def test_no_child_collects_what_its_parent_left(monkeypatch: pytest.MonkeyPatch) -> None:
    """As a closed session of Zenoh, whose end waits for threads of the parent."""

    class Left:
        def __init__(self) -> None:
            self.itself, self.pid = self, os.getpid()

        def __del__(self) -> None:
            if os.getpid() != self.pid:
                os._exit(1)

    monkeypatch.setattr(threading, "active_count", lambda: 1)
    gc.disable()
    try:
        Left()
        assert parallel_map(lambda _: gc.collect() < 0, range(2)) == [False, False]
    finally:
        gc.enable()


@pytest.mark.skipif(CORES < 2, reason="one core")
def test_a_process_that_cannot_be_made_is_told(tmp_path: Path) -> None:
    """As under a limit of processes: the second of two."""
    refusing = """
import os
fork, made = os.fork, []
def refuse():
    if made:
        raise BlockingIOError(11, "Resource temporarily unavailable")
    made.append(1)
    return fork()
os.fork = refuse
"""
    done = ended(sys.executable, "-c", refusing + ENDLESS, tmp_path, timeout_s=60.0)
    assert "NoResourcesError: a process of the computation could not be made" in done.stderr


def _runs(pid: int) -> bool:
    """Also false of one that ended and that nobody has asked about yet."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False
