"""How a daemon starts and ends as a process: the lock before everything else, and every exit code as promised."""

from __future__ import annotations

import os
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers.base import SampleBlock
from monitor.config import configuration
from monitor.core import BadConfigurationError, InUseError, MissingInputError
from monitor.service import site as site_module
from monitor.service.lease import FolderLease
from monitor.service.outlets import Outlet, make_outlets
from monitor.service.status import running
from tests.support.live_rig import Command
from tests.support.live_site import RATE
from tests.support.samples import Cut
from tests.support.site import SITE, Daemon, Scripted, run_until, write
from tests.support.strangers import as_a_stranger
from tests.support.waiting import until
from tests.support.zenoh_router import free_port

pytestmark = pytest.mark.system

ROOT = Path(__file__).parents[2]


def make_site(folder: Path, frame_text: str, zenoh: str) -> Path:
    path = folder / "site.toml"
    path.write_text(SITE.replace("\n[recorder]", f"\n[output.zenoh]\n{zenoh}\n\n[recorder]") + frame_text)
    return path


@pytest.fixture
def site(tmp_path: Path, frame_text: str) -> Path:
    """A site that publishes as a peer: an outlet that had begun would still be joining when a start fails."""
    return make_site(tmp_path, frame_text, f'mode = "peer"\nlisten = ["tcp/127.0.0.1:{free_port()}"]')


def start(site: Path, **environment: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "monitor", "run", str(site)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=ROOT, env={**os.environ, **environment})


@pytest.fixture
def held(site: Path) -> Iterator[Path]:
    """The output folder, locked by another daemon."""
    out = site.parent / "out"
    lease = FolderLease(out)
    lease.acquire()
    yield out
    lease.release()


def test_a_second_daemon_ends_with_78_and_leaves_no_trace(site: Path, held: Path) -> None:
    before = sorted(held.rglob("*"))
    process = start(site)
    _, said = process.communicate(timeout=60.0)
    assert process.returncode == 78, said
    assert said == f"error: bad configuration\n{held}: another daemon writes here; name another dir under [output]\n"
    assert sorted(held.rglob("*")) == before


@pytest.mark.parametrize("taken", ["out", "out/state", "out/recordings"])
def test_a_folder_that_cannot_be_written_ends_it_with_66(site: Path, taken: str) -> None:
    """A file stands where a folder is to be, first before the lock and then after it."""
    (site.parent / taken).parent.mkdir(exist_ok=True)
    (site.parent / taken).write_text("")
    with Command(site.parent / "log", "run", site) as daemon:
        assert daemon.wait() == 66, daemon.said
    assert daemon.said.count("\n") == 1 and f"{site.parent / 'out'}: cannot be written: " in daemon.said


@pytest.mark.parametrize("fails", ["lock", "recordings"])
def test_a_start_that_fails_has_shown_nothing_outside(
    site: Path, fails: str, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    """No outlet is made, which would take an operator's request that belongs to the daemon that runs."""
    made: list[Outlet] = []

    def make(path: Path, settings: configuration.Configuration, *, dry: bool = False) -> tuple[Outlet, ...]:
        found = make_outlets(path, settings, dry=dry)
        made.extend(found)
        return found

    monkeypatch.setattr(site_module, "make_outlets", make)
    if fails == "lock":
        request.getfixturevalue("held")
    else:
        (site.parent / "out").mkdir()
        (site.parent / "out" / "recordings").write_text("")
    with pytest.raises((BadConfigurationError, MissingInputError)):
        Daemon(site)
    assert not made


def test_a_source_that_is_missing_ends_it_with_66(site: Path) -> None:
    with Command(site.parent / "log", "run", site) as daemon:
        assert daemon.wait() == 66 and "rec.mcap" in daemon.said, daemon.said


def test_sigterm_while_an_outlet_is_joining_ends_it_with_0(
    tmp_path: Path, frame_text: str, record: np.ndarray, cut: Cut
) -> None:
    """The router is away, and the outlet still waits for it when the daemon has ended."""
    client = f'mode = "client"\nconnect = ["tcp/127.0.0.1:{free_port()}"]\nconnect_timeout_s = 6.0'
    site = make_site(tmp_path, frame_text, client)
    write(site.parent / "rec.mcap", cut(record, RATE))
    site.write_text(site.read_text().replace('files = ["rec.mcap"]', 'files = ["rec.mcap"]\nspeed = 1.0'))
    with Command(tmp_path / "log", "run", site) as daemon:
        daemon.wait_for("READY\n")
        code, seconds = daemon.stop()
    assert code == 0, daemon.said
    assert seconds < 7.0  # 5 s are promised


def test_the_lock_can_be_opened_by_its_owner_alone(held: Path) -> None:
    path = held / "state" / "lock"
    path.chmod(0o644)  # as others may have left it
    with pytest.raises(Exception, match="another daemon"):
        FolderLease(held).acquire()
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert running(held)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can be somebody else")
def test_a_stranger_who_may_read_the_folder_cannot_hold_its_lock() -> None:
    """Under the usual mask, in a folder that all may enter."""
    before = os.umask(0o022)
    try:
        with tempfile.TemporaryDirectory() as name:
            out, path = Path(name), Path(name) / "state" / "lock"
            out.chmod(0o755)
            lease = FolderLease(out)
            lease.acquire()
            lease.release()
            with as_a_stranger():
                assert path.exists()
                with pytest.raises(PermissionError):
                    os.open(path, os.O_RDONLY)
    finally:
        os.umask(before)


def remove(out: Path, then: Callable[[], object] = lambda: None) -> None:
    """A folder under the daemon that fills it, once its first checkpoint is written."""
    until((out / "state" / "checkpoint").exists, "the first checkpoint")
    gone = out.rename(out.with_name("gone"))
    then()
    shutil.rmtree(gone, ignore_errors=True)


@pytest.mark.parametrize("is_over", [True, False])
def test_a_folder_that_another_daemon_began_anew_is_left_alone(
    site: Path, record: np.ndarray, cut: Cut, is_over: bool
) -> None:
    """The first daemon ends, while data may still come and where they have ended."""
    out = site.parent / "out"
    other = FolderLease(out)

    def script() -> Iterator[SampleBlock]:
        yield from cut(record[:2600], RATE)
        remove(out, other.acquire)
        (out / "summary.json").write_text("another's")

    source = Scripted(script(), hold=None if is_over else threading.Event())
    with pytest.raises(InUseError, match=f"{out}: was removed and made anew"):
        Daemon(site, source, clock=lambda: 10.0 * time.monotonic()).run()
    other.release()
    assert (out / "summary.json").read_text() == "another's"
    assert not [name for name in ("results.jsonl", "health.jsonl", "state/checkpoint") if (out / name).exists()]


def test_a_daemon_whose_folder_is_removed_ends_and_says_so(site: Path, record: np.ndarray, cut: Cut) -> None:
    out = site.parent / "out"

    def script() -> Iterator[SampleBlock]:
        yield from cut(record[:2600], RATE)
        remove(out)

    with pytest.raises(MissingInputError, match=f"{out}: was removed while a daemon wrote here"):
        Daemon(site, Scripted(script(), threading.Event()), clock=lambda: 10.0 * time.monotonic()).run()
    assert not (out / "summary.json").exists()


def test_a_part_that_cannot_be_closed_keeps_no_other_open(site: Path, record: np.ndarray, cut: Cut) -> None:
    """A host could not start the site again, whose folder would still be locked."""

    class Broken(Outlet):
        def close(self, timeout_s: float) -> None:
            raise ValueError("no such link")

    daemon = Daemon(site, Scripted(cut(record, RATE)), [Broken()])
    with pytest.raises(ValueError, match="no such link"):
        daemon.run()
    assert running(daemon.out) is False


def test_another_site_is_refused_in_a_site_s_folder_unless_it_is_told_to_be_the_same(
    site: Path, record: np.ndarray, cut: Cut
) -> None:
    out, blocks = site.parent / "out", cut(record[:2600], RATE)
    Daemon(site, Scripted(blocks)).run()
    before = {name: (out / name).read_bytes() for name in ("results.jsonl", "health.jsonl")}
    text = site.read_text()
    other = site.with_name("other.toml")
    other.write_text(text.replace('name = "bench"', 'name = "tower"'))
    with pytest.raises(BadConfigurationError, match=f"{out}: the site 'bench' writes here") as raised:
        Daemon(other, Scripted(blocks))
    assert raised.value.exit_code == 78 and 'formerly = "bench"' in str(raised.value)
    assert before == {name: (out / name).read_bytes() for name in before}
    Daemon(site, Scripted([])).run()
    other.write_text(text.replace('name = "bench"', 'name = "tower"\nformerly = "bench"'))
    Daemon(other, Scripted([])).run()
    with pytest.raises(BadConfigurationError, match="the site 'tower' writes here"):
        Daemon(site, Scripted(blocks))


def test_state_and_requests_are_their_owner_s_whatever_the_umask(site: Path, record: np.ndarray, cut: Cut) -> None:
    state, before = site.parent / "out" / "state", os.umask(0)
    try:
        run_until(site, cut(record[:2600], RATE), 1)
    finally:
        os.umask(before)
    modes = {p.relative_to(state.parent).as_posix(): stat.S_IMODE(p.stat().st_mode) for p in (state, *state.rglob("*"))}
    assert modes.pop("state") == modes.pop("state/requests") == 0o700
    assert {
        "state/checkpoint",
        "state/alarms",
        "state/history.db",
        "state/baseline.json",
        "state/site.json",
    } <= modes.keys()
    assert {name: mode for name, mode in modes.items() if mode != 0o600} == {}


def test_a_look_at_the_status_keeps_no_daemon_from_starting(tmp_path: Path) -> None:
    """Who may open the lock, as root, and holds it for a moment, is waited for."""
    path, lease = tmp_path / "state" / "lock", FolderLease(tmp_path)
    lease.acquire()
    lease.release()
    hold = "import fcntl, sys, time; f = open(sys.argv[1]); fcntl.flock(f, fcntl.LOCK_SH); print(flush=True); time.sleep(0.3)"
    with subprocess.Popen([sys.executable, "-c", hold, str(path)], stdout=subprocess.PIPE) as reader:
        reader.stdout.readline()
        lease.acquire()
        lease.release()


@pytest.mark.parametrize("after_s", [0.0, 3.0])
def test_sigterm_while_it_compiles_ends_it_at_once(
    site: Path, record: np.ndarray, cut: Cut, tmp_path: Path, after_s: float
) -> None:
    """With nothing compiled on the disk; `after_s` from the first line of health on, which says that it starts."""
    write(site.parent / "rec.mcap", cut(record, RATE))
    process, health = start(site, NUMBA_CACHE_DIR=str(tmp_path / "cache")), site.parent / "out" / "health.jsonl"
    until(lambda: health.exists() and health.stat().st_size, "it starts")
    time.sleep(after_s)
    begun_s = time.monotonic()
    process.terminate()
    _, said = process.communicate(timeout=60.0)
    assert time.monotonic() - begun_s < 5.0
    assert process.returncode == -signal.SIGTERM and "READY" not in said and "Traceback" not in said
