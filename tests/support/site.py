"""A site on recordings: its file, its source by script, its daemon and the files that the daemon writes."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from drivers.base import EndOfStream, SampleBlock, Source, SourceHealth
from monitor.config import configuration
from monitor.core import WindowResult
from monitor.publish import closed_files, read_lines
from monitor.runs import Session
from monitor.service import ALONE, Host, outlets
from tests.support.samples import Cli, write_blocks

RATE = 128.0
write = write_blocks

SITE = """
[site]
name = "bench"

[source]
kind = "mcap"
files = ["rec.mcap"]

[output]
dir = "out"

[recorder]
min_free_gb = 0.0

[watch]
diagnose = false
"""

Step = SampleBlock | Exception | None


class Scripted:
    """A source that gives what it was told to: blocks, errors, or nothing in time."""

    def __init__(self, script: Iterable[Step], hold: threading.Event | None = None) -> None:
        self._script: Iterator[Step] = iter(script)
        self._hold = hold
        self.opened = self.closed = self.given = 0

    def open(self) -> None:
        self.opened += 1

    def read(self, timeout_s: float) -> SampleBlock | None:
        item = next(self._script, None if self._hold is not None else EndOfStream())
        if isinstance(item, Exception):
            raise item
        if item is None:
            time.sleep(min(timeout_s, 0.02))
        else:
            self.given += 1
        return item

    def health(self) -> SourceHealth:
        return SourceHealth(self.opened > self.closed, {"blocks": self.given})

    def close(self) -> None:
        self.closed += 1


@pytest.fixture
def site(tmp_path: Path, frame_text: str) -> Path:
    path = tmp_path / "site.toml"
    path.write_text(SITE + frame_text)
    return path


def lines(folder: Path, name: str = "results.jsonl") -> list[dict[str, Any]]:
    """Of a file that grows; half a line is left out."""
    file = folder / name
    whole = file.read_bytes().rpartition(b"\n")[0] if file.exists() else b""
    return [json.loads(line) for line in whole.splitlines()]


def all_lines(folder: Path) -> list[bytes]:
    """Lines of all months, packed ones too."""
    return [line for path in (*closed_files(folder), folder / "results.jsonl") for line in read_lines(path)]


def health(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "health.jsonl").read_text().splitlines()]


def summary(folder: Path) -> dict[str, Any]:
    return dict(json.loads((folder / "summary.json").read_text()))


def replayed(main: Cli, site: Path, recordings: Sequence[Path], out: Path, *options: object) -> bytes:
    done = main("replay", *recordings, "--structure", site, *options, "--out", out)
    assert done.returncode == 0, done.stderr
    return (out / "results.jsonl").read_bytes()


def own(out: Path) -> list[Path]:
    return sorted((out / "recordings").glob("*.mcap"))


class Told(outlets.Outlet):
    """Keeps what the daemon tells: the lines of its windows and of its health."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.health_lines: list[Mapping[str, Any]] = []

    def window(self, result: WindowResult, line: str) -> None:
        self.lines.append(line)

    def health_line(self, line: Mapping[str, Any]) -> None:
        self.health_lines.append(line)

    @property
    def failed_parts(self) -> dict[str, str]:
        """By the latest line of health."""
        return dict(self.health_lines[-1]["failed"]) if self.health_lines else {}


TOKEN = "a-token-of-letters-0123456789"


class Daemon:
    """A host of one site, as `run` is, with a source, outlets and other options of the site in place of those of its file."""

    def __init__(
        self,
        path: Path,
        source: Source | None = None,
        told: Sequence[outlets.Outlet] = (),
        *,
        tick_s: float = 0.2,
        **options: Any,
    ) -> None:
        host = Host([path], ALONE, tick_s=tick_s, source=source, outlets=tuple(told), **options)
        runner = host.places[path].runner
        assert runner is not None
        self.run, self.site = host.run, runner.site
        self.session, self.reader, self.outputs = self.site.session, self.site.reader, self.site.outputs
        self.out = path.parent / self.site.settings.output.dir


class Endless(Scripted):
    """Gives its blocks, then nothing, and asks the daemon to end once they were evaluated."""

    def __init__(self, blocks: list[SampleBlock], windows: int) -> None:
        super().__init__(blocks, hold=threading.Event())
        self._windows, self._asked = windows, False
        self.daemon: Daemon

    def read(self, timeout_s: float) -> SampleBlock | None:
        block = super().read(timeout_s)
        if block is None and self.daemon.session.windows >= self._windows and not self._asked:
            self._asked = True
            os.kill(os.getpid(), signal.SIGTERM)
        return block


def judged_lines(site: Path, blocks: Iterable[SampleBlock]) -> list[dict[str, Any]]:
    """What a session says of blocks, without a daemon."""
    told = Told()
    session = Session(configuration.load(site), None, (told,), None, site.parent / "none")
    for block in blocks:
        session.push(block)
    return [json.loads(line) for line in told.lines]


def run_until(site: Path, blocks: list[SampleBlock], windows: int) -> Daemon:
    """A daemon that is told to end when it has seen so many windows: it keeps its state."""
    source = Endless(blocks, windows)
    source.daemon = daemon = Daemon(site, source)
    daemon.run()
    return daemon
