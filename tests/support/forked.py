"""Processes forked from one that has imported and compiled everything, so that no start takes a processor for seconds.

What such a process says goes to a file.
"""

from __future__ import annotations

import functools
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing import forkserver
from multiprocessing.context import ForkServerContext
from pathlib import Path
from typing import Self

from tests.support.waiting import until

ROOT = Path(__file__).resolve().parents[2]
PATIENCE_S = 60.0
_TICKS = os.sysconf("SC_CLK_TCK")


@functools.cache
def _server() -> ForkServerContext:
    """The process from which the others are forked; it begins with the first of them."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["tests.support.preloaded"])
    before = os.environ.get("OPENBLAS_NUM_THREADS")
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # before NumPy is loaded there
    try:
        forkserver.ensure_running()
    finally:
        del os.environ["OPENBLAS_NUM_THREADS"]
        os.environ |= {} if before is None else {"OPENBLAS_NUM_THREADS": before}
    return context


def _begin(log: Path, environment: dict[str, str], work: Callable[..., None], arguments: tuple[object, ...]) -> None:
    """Do the work as a new program would: with its own output and environment."""
    descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    for number, stream in ((1, sys.stdout), (2, sys.stderr)):
        os.dup2(descriptor, number)
        stream.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    os.close(descriptor)
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(ROOT)
    work(*arguments)


@dataclass(frozen=True)
class Held:
    """What a process holds."""

    threads: int
    handles: int
    children: int
    memory_mb: float


class Forked:
    """A process of its own that does `work`; what it says is appended to a file."""

    def __init__(self, log: Path, work: Callable[..., None], *arguments: object, **environment: str) -> None:
        self._log = log
        log.touch()
        own = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1", **environment}
        self._process = _server().Process(target=_begin, args=(log, own, work, arguments))
        self._process.start()
        self.pid = self._process.pid or 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()

    @property
    def said(self) -> str:
        """Everything so far."""
        return self._log.read_text(errors="replace")

    @property
    def code(self) -> int | None:
        """Exit code, or minus the signal that ended it; None while it runs."""
        return self._process.exitcode

    def until(self, is_so: Callable[[], object], what: str, patience_s: float = 90.0) -> None:
        """Wait, and fail at once if it ends meanwhile."""
        until(lambda: self.code is not None or is_so(), f"{what}: {self._log}", patience_s)
        assert self.code is None or is_so(), self.said

    def wait_for(self, text: str) -> None:
        """Until it has said that."""
        self.until(lambda: text in self.said, repr(text))

    def wait(self, patience_s: float = PATIENCE_S) -> int:
        """Exit code, once it has ended by itself."""
        self._process.join(patience_s)
        assert self.code is not None, f"does not end within {patience_s:g} s: {self.said}"
        return self.code

    def finish(self, patience_s: float = PATIENCE_S) -> None:
        """Until it ends by itself, with success."""
        assert self.wait(patience_s) == 0, self.said

    def send(self, number: int) -> None:
        """Send a signal."""
        if self.code is None:
            os.kill(self.pid, number)

    def stop(self, number: int = signal.SIGTERM) -> tuple[int, float]:
        """Exit code after a signal, and how long it took, s."""
        begun = time.monotonic()
        self.send(number)
        return self.wait(), time.monotonic() - begun

    def kill(self) -> None:
        """End it at once, if it still runs."""
        if self.code is None:
            self._process.kill()
            self._process.join()

    @property
    def cpu_s(self) -> float:
        """Time of this process alone on any core."""
        fields = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / _TICKS

    @property
    def status(self) -> dict[str, str]:
        """What the kernel says of it, by the names of proc(5)."""
        rows = Path(f"/proc/{self.pid}/status").read_text().splitlines()
        return {name: value.strip() for name, _, value in (row.partition(":") for row in rows)}

    @property
    def holds(self) -> Held:
        """What it holds at present."""
        children = Path(f"/proc/{self.pid}/task").glob("*/children")
        return Held(
            threads=int(self.status["Threads"]),
            handles=len(os.listdir(f"/proc/{self.pid}/fd")),
            children=sum(len(path.read_text().split()) for path in children),
            memory_mb=self.rss_mb,
        )

    @property
    def rss_mb(self) -> float:
        """Memory in use, MiB."""
        return int(self.status["VmRSS"].split()[0]) / 1024
