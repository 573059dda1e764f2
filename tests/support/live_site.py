"""A daemon on a source that outlives it: ``python -m tests.support.live_site SITE STREAM.npy POSITION PACE_S MISSED``.

The source gives blocks of the stream, over and over; the file POSITION says how many it has given, so that the next process
goes on after them, less MISSED blocks that nobody took while it was away.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from drivers.base import EndOfStream, SampleBlock, SourceHealth
from monitor.config import configuration
from monitor.service import logs
from tests.support.forked import Forked
from tests.support.samples import CHANNELS, T0_NS
from tests.support.site import Daemon, lines

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


def daemon(site: Path, stream: Path, position: Path, pace_s: float, missed: int, quiet_s: float | None = None) -> None:
    """Monitor the stream until the process is told to end; without data, health is told every `quiet_s`."""
    settings = configuration.load(site)
    logs.begin(settings.log, settings.site_name)
    source = Live(np.load(stream), position, pace_s, missed)
    with threadpool_limits(limits=1):
        Daemon(site, source, **({} if quiet_s is None else {"quiet_s": quiet_s})).run()


class LiveDaemon(Forked):
    """A daemon of FOLDER/site.toml on the stream of FOLDER/stream.npy; what it says is appended to FOLDER/log."""

    def __init__(self, folder: Path, pace_s: float, missed: int = 0, work: Callable[..., None] = daemon) -> None:
        files = [folder / name for name in ("site.toml", "stream.npy", "position")]
        super().__init__(folder / "log", work, *files, pace_s, missed)
        self.out, self._position = folder / "out", folder / "position"

    @property
    def given(self) -> int:
        """Blocks of the stream so far."""
        return given(self._position)

    @property
    def windows(self) -> list[dict[str, Any]]:
        """Lines of results.jsonl so far."""
        return lines(self.out)

    @property
    def failed(self) -> dict[str, str]:
        """Parts that fail, by the latest line of health."""
        return dict(lines(self.out, "health.jsonl")[-1]["failed"])

    def wait_for_windows(self, count: int) -> None:
        """Until there are so many."""
        self.until(lambda: len(self.windows) >= count, f"{count} windows")


def save_stream(folder: Path, floors: np.ndarray) -> None:
    """Keep what the source of a folder gives."""
    np.save(folder / "stream.npy", floors.astype(np.float32))


def main(arguments: list[str]) -> None:
    site, stream, position, pace_s, missed, *quiet_s = arguments
    daemon(Path(site), Path(stream), Path(position), float(pace_s), int(missed), *map(float, quiet_s))


if __name__ == "__main__":
    main(sys.argv[1:])
