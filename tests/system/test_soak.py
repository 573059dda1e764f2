"""A daemon in narrow limits, with everything that may hang or flood at once: it goes on judging, stays as it is, and ends.

Handles are limited everywhere; tasks
and memory, as the units limit them, where a control group can be made, and processes where root may start an unprivileged user's.
"""

from __future__ import annotations

import contextlib
import os
import resource
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from tests.support import live_site
from tests.support.hooks import Drip, Hook
from tests.support.http import fetch
from tests.support.live_site import LiveDaemon
from tests.support.repeating import Repeating
from tests.support.site import SITE
from tests.support.waiting import until
from tests.support.zenoh_router import free_port

pytestmark = pytest.mark.system

USER = 64123
"""Unprivileged user id, where the test runs as root: root has no limit of processes."""
PACE_S = 0.05
"""Pause between two blocks of half a second of data."""
TABLES = """
serve = "127.0.0.1:{viewer}"
[output.metrics]
listen = "127.0.0.1:{metrics}"
[notify]
urls = ["json://{drip}/a", "{hook}", "json://{drip}/b"]
heartbeat_url = "http://{drip}/beat"
heartbeat_s = 1.0
blind_s = 1.0
"""


def _user() -> int | None:
    """The unprivileged user, where this is root and the interpreter is one that the user may run."""
    if os.getuid() != 0:
        return None
    with contextlib.suppress(PermissionError):
        return USER if subprocess.run([sys.executable, "-c", ""], user=USER, check=False).returncode == 0 else None
    return None


@pytest.fixture
def folder() -> Iterator[Path]:
    """A folder that the unprivileged user can reach and owns."""
    made = Path(tempfile.mkdtemp(prefix="shm-soak-"))
    made.chmod(0o755)
    yield made
    shutil.rmtree(made)


@pytest.fixture
def groups() -> Iterator[list[Path]]:
    """Control groups (version 1) with limits as in deploy/shm-monitor.service; none where they cannot be made."""
    made = []
    for controller, file, most in (("pids", "pids.max", 256), ("memory", "memory.limit_in_bytes", 1536 << 20)):
        group = Path(f"/sys/fs/cgroup/{controller}/shm-soak-{os.getpid()}")
        with contextlib.suppress(OSError):
            group.mkdir()
            made.append(group)
            (group / file).write_text(str(most))
    yield made
    for group in made:
        until(lambda g=group: not (g / "cgroup.procs").read_text(), "all have left")
        group.rmdir()


def limited(groups: list[Path], user: int | None, *arguments: Any) -> None:
    """Enter the control groups, take the limits of systemd's defaults, and monitor."""
    for group in groups:
        (group / "cgroup.procs").write_text("0")
    resource.setrlimit(resource.RLIMIT_NOFILE, (1024, 1024))
    if user is not None:
        resource.setrlimit(resource.RLIMIT_NPROC, (256, 256))
        os.setgroups([])
        os.setgid(user)
        os.setuid(user)
    os.environ["HOME"] = str(Path(arguments[0]).parent)
    live_site.daemon(*arguments)


def hold(port: int, count: int, text: bytes, held: list[socket.socket]) -> None:
    """Connect so many times and say no more than `text`."""
    for _ in range(count):
        one = socket.socket()
        one.setblocking(False)
        held.append(one)
        one.connect_ex(("127.0.0.1", port))
    time.sleep(0.2)
    for one in held[-count:]:
        with contextlib.suppress(OSError):
            one.sendall(text)


def read_slowly(port: int) -> None:
    """Take a byte of the answer now and then, for longer than the server waits."""
    with socket.create_connection(("127.0.0.1", port), 10.0) as one:
        one.sendall(b"GET /metrics HTTP/1.1\r\nHost: x\r\n\r\n")
        for _ in range(100):
            one.recv(1)
            time.sleep(0.1)


class Ports(NamedTuple):
    metrics: int
    viewer: int


def soak(
    daemon: LiveDaemon, seconds: float, ports: Ports, hook: Hook, attack: Repeating, held: list[socket.socket]
) -> None:
    """Attack the daemon, look at it for a while, and end it."""
    daemon.wait_for_windows(5)
    hold(ports.metrics, 200, b"GET /metrics HTTP/1.1\r\n", held)
    hold(ports.viewer, 100, b"PRI * HTTP/2.0\r\n", held)
    for _ in range(2):
        attack.start(lambda: read_slowly(ports.metrics), 0.0)
        attack.start(lambda: fetch(ports.metrics) and None, 0.0)
    daemon.until(lambda: hook.got, "the address that is well has its message")
    daemon.until(lambda: "Notifier" in daemon.failed, "the address that drips is told")
    time.sleep(seconds / 5.0)  # until all that is made once has been made
    seen, windows = [daemon.holds], [len(daemon.windows)]
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        time.sleep(3.0)
        seen.append(daemon.holds)
        windows.append(len(daemon.windows))
    assert daemon.code is None, daemon.said
    assert np.diff(windows).min() > 0, windows
    assert max(s.children for s in seen) <= 4, seen
    assert np.ptp([s.threads for s in seen]) <= 4, seen
    assert np.ptp([s.handles for s in seen]) <= 40, seen
    assert seen[-1].memory_mb - seen[0].memory_mb < 64.0, seen
    assert attack.done > seconds  # readers are served beside those that hang
    assert daemon.failed.keys() == {"Notifier"}, daemon.failed
    assert "address 1 (json) " in daemon.failed["Notifier"], daemon.failed
    assert seconds < 30.0 or "has taken" in daemon.failed["Notifier"], daemon.failed
    code, took_s = daemon.stop()
    assert code == 0 and took_s < 5.0


@pytest.mark.parametrize("seconds", [12.0, pytest.param(45.0, marks=pytest.mark.slow)])
def test_it_goes_on_judging_stays_as_it_is_and_ends(
    folder: Path, groups: list[Path], frame_text: str, record: np.ndarray, seconds: float
) -> None:
    user = _user()
    if user is not None:
        os.chown(folder, user, user)
    ports = Ports(free_port(), free_port())
    drip, hook, attack, held = Drip(0.2), Hook(), Repeating(), list[socket.socket]()
    tables = TABLES.format(viewer=ports.viewer, metrics=ports.metrics, drip=drip.address, hook=hook.url)
    (folder / "site.toml").write_text(SITE.replace('dir = "out"\n', f'dir = "out"{tables}', 1) + frame_text)
    live_site.save_stream(folder, record)
    with LiveDaemon(folder, PACE_S, work=partial(limited, groups, user)) as daemon:
        try:
            soak(daemon, seconds, ports, hook, attack, held)
        finally:
            attack.end()
            for one in held:
                one.close()
            drip.close()
            hook.shutdown()
            hook.server_close()
    found = daemon.windows
    assert [line["window"] for line in found] == list(range(len(found)))
    assert all(line["skipped"] is None for line in found)
    said = daemon.said.splitlines()
    assert all(row.startswith("time=") for row in said if row != "READY"), said
