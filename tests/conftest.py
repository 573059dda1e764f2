"""Shared: a small frame with short windows, samples cut into blocks, and the commands."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from monitor.model import simulate
from tests.cli.within import call
from tests.support.can_group import group as group
from tests.support.frames import settings_of
from tests.support.samples import FRAME, Cli, Cut, _cut
from tests.support.site import site as site


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
    """Runs a command within this process."""
    return call


@pytest.fixture(scope="session")
def record(frame_text: str) -> np.ndarray:
    """A minute of the frame at 128 Hz, shape (7680, 3), m/s^2."""
    return simulate(settings_of(frame_text).model(), duration_s=60.0, rate_hz=128.0, noise=0.03, seed=6).floors
