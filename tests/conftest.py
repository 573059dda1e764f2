"""Shared: a small frame with short windows, samples cut into blocks, and the commands."""

from __future__ import annotations

import contextlib
import io
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from drivers.base import ACCELERATION, SampleBlock
from monitor.config import configuration
from monitor.model import simulate
from tests.support.frame_text import THREE_STORIES

FRAME = (
    THREE_STORIES
    + """
[processing]
window_s = 20.0
hop_s = 5.0

[identification]
block_rows = 10
"""
)
T0_NS = 1_767_225_600_000_000_000
CHANNELS = ("a1", "a2", "a3")

Cut = Callable[..., list[SampleBlock]]
Cli = Callable[..., subprocess.CompletedProcess[str]]


def _cut(
    values: np.ndarray,
    rate_hz: float,
    sizes: Sequence[int] = (100,),
    *,
    t0_ns: int = T0_NS,
    first: int = 0,
    channels: tuple[str, ...] = CHANNELS,
) -> list[SampleBlock]:
    """Blocks of `sizes` samples, taken over and over; `first` is the first sample's sequence."""
    blocks, start, count = [], 0, 0
    while start < len(values):
        part = values[start : start + sizes[count % len(sizes)]].astype(np.float32)
        t_ns = t0_ns + round((first + start) / rate_hz * 1e9)
        blocks.append(SampleBlock(ACCELERATION, t_ns, first + start, rate_hz, channels, "m/s^2", part))
        start, count = start + len(part), count + 1
    return blocks


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> Iterator[None]:
    """As in the commands: matrices are small."""
    with threadpool_limits(limits=1):
        yield


@pytest.fixture(scope="session")
def cut() -> Cut:
    """Cuts samples, shape (n, c), into consecutive blocks."""
    return _cut


@pytest.fixture(scope="session")
def frame_text() -> str:
    """A structure file with windows of 20 s every 5 s."""
    return FRAME


@pytest.fixture(scope="session")
def cli() -> Cli:
    """Runs the installed console script."""

    def run(*arguments: object, cwd: Path | None = None, timeout: float = 120.0) -> subprocess.CompletedProcess[str]:
        script = Path(sys.executable).with_name("shm-monitor")
        command = [str(script), *map(str, arguments)]
        return subprocess.run(command, capture_output=True, text=True, cwd=cwd, timeout=timeout, check=False)

    return run


@pytest.fixture(scope="session")
def main() -> Cli:
    """Runs a command within this process: far faster, and an exception that escapes fails the test."""
    from monitor.cli.app import call as entry

    def run(*arguments: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
        out, err, argv = io.StringIO(), io.StringIO(), sys.argv
        sys.argv = ["shm-monitor", *map(str, arguments)]
        code = 0
        try:
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), contextlib.chdir(cwd or "."):
                entry()
        except SystemExit as ended:
            code = int(ended.code or 0)
        finally:
            sys.argv = argv
        return subprocess.CompletedProcess(sys.argv, code, out.getvalue(), err.getvalue())

    return run


@pytest.fixture(scope="session")
def record(frame_text: str, tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    """A minute of the frame at 128 Hz, shape (7680, 3), m/s^2."""
    path = tmp_path_factory.mktemp("s") / "s.toml"
    path.write_text(frame_text)
    return simulate(configuration.load(path).model(), duration_s=60.0, rate_hz=128.0, noise=0.03, seed=6).floors
