"""Many sites in one process: each is filled as `run` fills it, whatever becomes of the others."""

from __future__ import annotations

import json
import os
import shutil
import signal
from pathlib import Path

import pyarrow.compute
import pyarrow.dataset
import pytest

from monitor.service import is_of_share
from tests.support.host_sites import Frames, alarms, results, site
from tests.support.http import fetch
from tests.support.live_rig import Command
from tests.support.samples import Cli, Cut
from tests.support.waiting import until
from tests.support.zenoh_router import free_port

pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory, frame_text: str, cut: Cut, main: Cli) -> Path:
    """A baseline, recordings in some of which story 2 softens, and what `run` makes of each."""
    folder = tmp_path_factory.mktemp("bench")
    frames = Frames(folder, frame_text, cut, main)
    for k in range(3):
        frames.write(f"r{k}", frames.sound(30.0, 10 + k), frames.weak(45.0, 20 + k))
    frames.write("flood", *[frames.sound(100.0, 30)] * 15)
    (folder / "garbage.mcap").write_bytes(bytes(range(256)) * 100)
    for k in range(3):
        path = site(folder / "run", frame_text, f"s{k}", f"r{k}")
        assert main("run", path).returncode == 0
    return folder


def equal(bench: Path, folder: Path, name: str) -> bool:
    """Whether the windows and alarms are those of `run`, bit for bit."""
    lines = results(folder, name)
    assert results(bench / "run", name).startswith(lines), name
    return lines == results(bench / "run", name)


def test_each_site_is_filled_as_run_fills_it(bench: Path, frame_text: str, main: Cli) -> None:
    paths = [site(bench / "files", frame_text, f"s{k}", f"r{k}") for k in range(3)]
    done = main("host", *paths)
    assert done.returncode == 0 and "READY" in done.stderr.splitlines(), done.stderr
    for k in range(3):
        assert equal(bench, bench / "files", f"s{k}")
        assert alarms(bench / "files", f"s{k}") == alarms(bench / "run", f"s{k}") != []


def test_a_folder_is_watched_and_faults_stay_with_their_site(bench: Path, frame_text: str) -> None:
    folder, port = bench / "watched", free_port()
    for k in range(2):
        site(folder, frame_text, f"s{k}", f"r{k}", "speed = 25.0")
    site(folder, frame_text, "flood", "flood")
    site(folder, frame_text, "garbage", "garbage")
    twin = site(folder, frame_text, "twin", "r0")
    twin.write_text(twin.read_text().replace('name = "twin"', 'name = "s1"'))
    (folder / "bad.toml").write_text("[site\n")
    with Command(folder / "host.log", "host", folder, "--metrics", f"127.0.0.1:{port}") as host:
        host.wait_for("READY")
        for name in ("bad", "garbage", "twin"):  # told by name
            host.wait_for(f"{name} is started again")
        metrics = fetch(port).decode()
        assert 'shm_host_site{is="waiting",site="bad"} 1.0' in metrics
        site(folder, frame_text, "s2", "r2")
        shutil.copy(site(folder, frame_text, "late", "r0", "speed = 6.0"), folder / "late.kept")
        until(lambda: results(folder, "late"), "a site that came later")
        (folder / "late.toml").unlink()
        host.wait_for("late ends")
        until(lambda: all(equal(bench, folder, f"s{k}") for k in range(3)), "all windows of the others")
        text, before = (folder / "s2.toml").read_text(), len(results(folder, "s2"))
        (folder / "s2.toml").unlink()
        host.wait_for("s2 ends")
        (folder / "s2.toml").write_text(text)
        until(lambda: len(results(folder, "s2")) > before, "a site that had ended, was removed and put back")
        metrics = fetch(port).decode()
        assert 'shm_windows_total{site="s0"}' in metrics or 'shm_host_site{is="over",site="s0"} 1.0' in metrics
        code, seconds = host.stop()
        assert code == 0 and seconds < 30.0, host.said
    for k in range(2):
        assert alarms(folder, f"s{k}") == alarms(bench / "run", f"s{k}")


def test_sites_go_on_from_their_checkpoints(bench: Path, frame_text: str) -> None:
    folder = bench / "restarted"
    paths = [site(folder, frame_text, f"s{k}", f"r{k}", "speed = 15.0") for k in range(3)]
    for number in (signal.SIGTERM, signal.SIGKILL, None):
        with Command(folder / "host.log", "host", *paths) as host:
            if number is None:
                host.finish(60.0)
            else:
                before = sum(len(results(folder, f"s{k}")) for k in range(3))
                until(lambda before=before: sum(len(results(folder, f"s{k}")) for k in range(3)) > before, "a window")
                assert host.stop(number)[0] == (0 if number is signal.SIGTERM else -number)
    for k in range(3):
        assert equal(bench, folder, f"s{k}")
        assert alarms(folder, f"s{k}") == alarms(bench / "run", f"s{k}")
    assert os.listdir(folder / "out-s0" / "recordings")


def test_the_results_of_all_sites_are_one_dataset(bench: Path, main: Cli) -> None:
    folder, out = bench / "run", bench / "dataset"
    done = main("dataset", folder, "--out", out, "--json")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)["windows"]
    table = pyarrow.dataset.dataset(out, partitioning="hive").to_table()
    for name in ("s0", "s1", "s2"):
        lines = [json.loads(line) for line in results(folder, name).splitlines()]
        rows = table.filter(pyarrow.compute.field("site") == name)
        assert told[name] == len(lines) == rows.num_rows
        assert rows["ddi"].to_pylist() == [line["ddi"] for line in lines]
        assert rows["alarm_level"].to_pylist() == [line["alarm"]["level"] for line in lines]
    assert set(table["month"].to_pylist()) == {"2026-01"}


def children(host: Command) -> list[int]:
    pid = host.pid
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def test_a_worker_that_is_killed_is_started_again_and_its_sites_go_on(bench: Path, frame_text: str) -> None:
    folder, port = bench / "workers", free_port()
    paths = [site(folder, frame_text, f"s{k}", f"r{k}", "speed = 15.0") for k in range(3)]
    with Command(folder / "host.log", "host", *paths, "--workers", 2, "--metrics", f"127.0.0.1:{port}") as host:
        host.wait_for("READY")
        first = children(host)
        assert len(first) == 2
        until(lambda: all(results(folder, f"s{k}") for k in range(3)), "a window of each")
        metrics = fetch(port).decode()
        assert all(f'shm_windows_total{{site="s{k}"}}' in metrics for k in range(3))
        os.kill(first[0], signal.SIGKILL)
        until(lambda: len(children(host)) == 2 and children(host) != first, "another process")
        host.finish(60.0)
    for k in range(3):
        assert equal(bench, folder, f"s{k}")
        assert alarms(folder, f"s{k}") == alarms(bench / "run", f"s{k}")


def test_workers_end_in_order_on_sigterm_and_with_their_parent(bench: Path, frame_text: str) -> None:
    folder = bench / "ended"
    site(folder, frame_text, "s0", "r0", "speed = 1.0")
    site(folder, frame_text, "s1", "r1", "speed = 1.0")
    for number in (signal.SIGTERM, signal.SIGKILL):
        with Command(folder / "host.log", "host", folder, "--workers", 2) as host:
            host.wait_for("READY")
            workers = children(host)
            code, seconds = host.stop(number)
            assert code == (0 if number is signal.SIGTERM else -number) and seconds < 75.0
            until(lambda workers=workers: not any(map(lives, workers)), "no process is left")
        assert (folder / "out-s0" / "state" / "checkpoint").exists()


def test_another_host_takes_over_the_sites_of_one_that_dies(bench: Path, frame_text: str) -> None:
    folder = bench / "shared"
    for k in range(3):
        site(folder, frame_text, f"s{k}", f"r{k}", "speed = 8.0")
    owned = {n: [f"s{k}" for k in range(3) if is_of_share(Path(f"s{k}.toml"), n, 2)] for n in (1, 2)}
    assert owned[1] and owned[2]
    hosts = {n: Command(folder / f"host{n}.log", "host", folder, "--standby", "--share", f"{n}/2") for n in (1, 2)}
    try:
        until(lambda: all(results(folder, f"s{k}") for k in range(3)), "a window of each")
        for n, host in hosts.items():
            host.wait_for("READY")
            host.wait_for(f"{owned[3 - n][0]} stands by")
        assert hosts[1].stop(signal.SIGKILL)[0] == -signal.SIGKILL
        until(lambda: all(equal(bench, folder, f"s{k}") for k in range(3)), "all windows")
        assert hosts[2].stop()[0] == 0, hosts[2].said
    finally:
        for host in hosts.values():
            host.kill()
    for k in range(3):
        assert alarms(folder, f"s{k}") == alarms(bench / "run", f"s{k}") != []


def test_a_share_without_a_standby_is_refused(main: Cli, tmp_path: Path) -> None:
    for options in (["--share", "1/2"], ["--standby", "--share", "3/2"], ["--standby", "--share", "half"]):
        done = main("host", tmp_path, *options)
        assert done.returncode == 2 and options[-1] in done.stderr, done.stderr


def lives(pid: int) -> bool:
    """Whether a process runs: one whose parent was killed may stay as a zombie where nobody waits for it."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
