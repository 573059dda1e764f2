"""A daemon on a source that outlives it: ``python -m tests.support.live_site SITE STREAM.npy POSITION PACE_S MISSED [QUIET_S]``.

The source gives blocks of the stream, over and over; the file POSITION says how many it has given, so that the next process
goes on after them, less MISSED blocks that nobody took while it was away.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
import time
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from drivers.base import EndOfStream, SampleBlock, SourceHealth
from monitor.config import configuration
from monitor.service import Daemon, logs
from tests.support.samples import CHANNELS, T0_NS

RATE, SIZE = 128.0, 64


def given(position: Path) -> int:
    """Blocks so far."""
    return int(position.read_text() or 0) if position.exists() else 0


class Live:
    """Never ends, but with the test that wants it."""

    def __init__(self, stream: np.ndarray, position: Path, pace_s: float, missed: int) -> None:
        self._stream, self._pace_s = stream, pace_s
        self._next = given(position) + (missed if position.exists() else 0)
        self._place = os.open(position, os.O_RDWR | os.O_CREAT, 0o644)
        self._parent = multiprocessing.parent_process()
        self._parent_id = os.getppid()

    def open(self) -> None: ...

    def read(self, timeout_s: float) -> SampleBlock | None:
        if os.getppid() != self._parent_id or (self._parent is not None and not self._parent.is_alive()):
            raise EndOfStream
        time.sleep(self._pace_s)
        os.pwrite(self._place, b"%020d" % (self._next + 1), 0)
        first = self._next * SIZE
        self._next += 1
        rows = np.arange(first, first + SIZE) % len(self._stream)
        t_ns = T0_NS + round(first / RATE * 1e9)
        return SampleBlock("/acceleration", t_ns, first, RATE, CHANNELS, "m/s^2", self._stream[rows])

    def health(self) -> SourceHealth:
        return SourceHealth(True, {})

    def close(self) -> None: ...


def forked(log: Path, arguments: list[str]) -> None:
    """In a process that has imported everything already."""
    descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    main(arguments)


def main(arguments: list[str]) -> None:
    site, stream, position, pace_s, missed, *quiet_s = arguments
    settings = configuration.load(Path(site))
    logs.begin(settings.log, settings.site_name)
    source = Live(np.load(stream), Path(position), float(pace_s), int(missed))
    with threadpool_limits(limits=1):
        Daemon(Path(site), source, **({"quiet_s": float(quiet_s[0])} if quiet_s else {})).run()


if __name__ == "__main__":
    main(sys.argv[1:])
