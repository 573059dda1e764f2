"""Many structures over one network: what is said of each, whoever is missing, and the files that start a hundred."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomlkit

from deploy.compose import composed
from drivers.zenoh_bus import PublisherSettings, ZenohPublisher
from monitor.config import configuration
from monitor.model.simulation import simulate
from monitor.service import fleet
from monitor.service.fleet import ALARM, TROUBLE, WELL, SiteStatus, status
from monitor.service.fleet_view import text
from tests.conftest import T0_NS, Cli, Cut
from tests.support.live_rig import DEPLOY, Command, until
from tests.support.zenoh_router import Router, free_port

pytestmark = pytest.mark.system

NOW_NS = 1_800_000_000_000_000_000
HEALTH = {"wall_ns": NOW_NS - 10**9, "source": {"connected": True}, "failed": {}}
RESULT = {"t_end_ns": 7, "ddi": [0.01, 0.2], "ddi_std": [0.01, 0.02], "frequencies_hz": [5.2, 16.0], "skipped": None}
QUIET = {"level": "normal", "active": {}, "reason": ""}


def told(**answer: Any) -> SiteStatus:
    whole = {"results": RESULT, "alarm": QUIET, "health": HEALTH, "gap": None, **answer}
    return status("a", json.dumps(whole).encode(), True, NOW_NS, 60.0)


def test_a_site_that_is_well_says_its_largest_loss_and_first_mode() -> None:
    assert told() == SiteStatus("a", WELL, "", (), 0.2, 0.02, 5.2, 7, 1.0)


def test_an_alarm_is_said_with_its_stories() -> None:
    found = told(alarm={"level": "alarm", "active": {"2": "alarm"}, "reason": "story 2 lost 20 %"})
    assert (found.state, found.stories, found.says) == (ALARM, (2,), "story 2 lost 20 %")


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        ({"health": {**HEALTH, "wall_ns": NOW_NS - 90 * 10**9}}, "silent for 90 s"),
        ({"health": {**HEALTH, "source": {"connected": False, "detail": "cable out"}}}, "no data: cable out"),
        ({"health": {**HEALTH, "failed": {"recorder": "disk full"}}}, "recorder: disk full"),
        ({"results": {**RESULT, "ddi": None, "ddi_std": None, "skipped": "a gap"}}, "nothing judged: a gap"),
    ],
)
def test_what_cannot_be_relied_on_is_trouble(answer: dict[str, Any], says: str) -> None:
    assert (told(**answer).state, told(**answer).says) == (TROUBLE, says)


def test_trouble_never_hides_an_alarm() -> None:
    alarm = {"level": "warning", "active": {"1": "warning"}, "reason": "story 1"}
    found = told(alarm=alarm, health={**HEALTH, "wall_ns": 0})
    assert found.state == "warning" and "silent" in found.says


@pytest.mark.parametrize(
    "answer", [b"", b"[]", b'"x"', b"{", b'{"results": 3}', b'{"health": {"wall_ns": "x"}}', b"\xff"]
)
def test_an_answer_that_makes_no_sense_is_trouble(answer: bytes) -> None:
    assert status("a", answer, True, NOW_NS, 60.0).says == "its answer cannot be understood"


def test_a_young_monitor_has_said_nothing_yet() -> None:
    assert told(results=None, alarm=None, health=None) == SiteStatus("a", WELL, "")


def test_who_is_missing_is_told_from_who_hangs() -> None:
    assert status("a", None, False, NOW_NS, 60.0).says == "not there"
    assert status("a", None, True, NOW_NS, 60.0).says == "there, but does not answer"


def test_the_table_has_a_line_a_site() -> None:
    lines = text([told(), status("b", None, False, NOW_NS, 60.0)]).splitlines()
    assert lines[1].split() == ["a", "normal", "20.0", "+-", "2.0", "%", "5.2", "Hz", "1970-01-01T00:00:00"]
    assert lines[2].split() == ["b", "trouble", "not", "there"]


def test_a_hundred_services() -> None:
    names = [f"bridge-{i}" for i in range(100)]
    made = composed((DEPLOY / "compose.yaml").read_text(), names)
    assert made.count("<<: *monitor") == 100 and "frame-1" not in made
    assert "  bridge-99:\n    <<: *monitor\n" in made and made.endswith("  bridge-99:\n")
    with pytest.raises(ValueError, match="router"):
        composed("", ["router"])
    with pytest.raises(ValueError, match="x:"):
        composed("", ["x: {privileged: true}"])


def test_the_shipped_fleet_file_is_right_and_errors_are_told(tmp_path: Path, main: Cli) -> None:
    assert fleet.load(DEPLOY / "fleet.toml").sites == ("frame-1", "frame-2")
    wrong = tmp_path / "fleet.toml"
    wrong.write_text("[fleet]\nmode = 'client'\nconnect = ['tcp/127.0.0.1:1']\ncolour = 1\n")
    ended = main("fleet", wrong)
    assert ended.returncode == 78 and "fleet.colour" in ended.stderr
    wrong.write_text("[site]\nname = 'a'\n")
    ended = main("fleet", wrong)
    assert ended.returncode == 78 and "fleet: Field required" in ended.stderr and "site: Extra" in ended.stderr
    wrong.write_text("[fleet]\nconnect = ['tcp/127.0.0.1:1']\nconnect_timeout_s = 0.2\n")
    ended = main("fleet", wrong)
    assert ended.returncode == 66 and "127.0.0.1:1" in ended.stderr and "Traceback" not in ended.stderr
    assert main("fleet", tmp_path / "absent.toml").returncode == 66


def site_file(folder: Path, name: str, number: int, port: int, text: str) -> Path:
    """Each structure a little stiffer than the one before."""
    table: Any = tomlkit.parse(text)
    table["structure"]["stiffness_n_per_m"] = [k * (1.0 + 0.1 * number) for k in (2909.0, 1515.0, 1898.0)]
    endpoint = [f"tcp/127.0.0.1:{port}"]
    table["site"] = {"name": name}
    table["source"] = {"kind": "zenoh", "key": f"shm/{name}/acceleration", "mode": "client", "connect": endpoint}
    table["output"] = {"dir": f"out-{name}", "zenoh": {"mode": "client", "connect": endpoint}}
    table["recorder"] = {"min_free_gb": 0.0}
    path = folder / f"{name}.toml"
    path.write_text(tomlkit.dumps(table))
    return path


@contextmanager
def running(folder: Path, names: list[str], port: int, text: str) -> Iterator[list[Command]]:
    """A daemon a site."""
    daemons: list[Command] = []
    try:
        for number, name in enumerate(names):
            daemons.append(Command(folder / f"{name}.log", "run", site_file(folder, name, number, port, text)))
            daemons[-1].wait_for("READY")  # one by one: ten at once would only wait for each other
        yield daemons
    finally:
        for daemon in daemons:
            daemon.kill()


def feed(folder: Path, names: list[str], port: int, cut: Cut) -> dict[str, float]:
    """40 s of its own structure's motion to every site; their first frequencies."""
    first = {}
    with ExitStack() as stack:
        for number, name in enumerate(names):
            model = configuration.load(folder / f"{name}.toml").model()
            first[name] = float(model.modes().frequencies_hz[0])
            settings = PublisherSettings(key=f"shm/{name}/acceleration", connect=(f"tcp/127.0.0.1:{port}",))
            publisher = ZenohPublisher(settings)
            stack.callback(publisher.close)
            motion = simulate(model, duration_s=40.0, rate_hz=128.0, noise=0.03, seed=number).floors
            for block in cut(motion, 128.0, [128], t0_ns=T0_NS):
                publisher.send(block)
    return first


def overlooked(tmp_path: Path, count: int, frame_text: str, cut: Cut, main: Cli) -> None:
    """Start so many, feed them, look at them, end one, look again."""
    port, names = free_port(), [f"frame-{i}" for i in range(1, count + 1)]
    overview = tmp_path / "fleet.toml"
    overview.write_text(
        f'[fleet]\nconnect = ["tcp/127.0.0.1:{port}"]\nsites = {json.dumps([*names, "frame-0"])}\ntimeout_s = 3.0\n'
    )

    def look(*options: object) -> dict[str, dict[str, Any]]:
        ended = main("fleet", overview, "--json", *options)
        assert ended.returncode == 11, ended.stderr  # frame-0 is not there
        return {s["site"]: s for s in json.loads(ended.stdout.splitlines()[-1])["sites"]}

    router = Router(f"tcp/127.0.0.1:{port}")
    try:
        with running(tmp_path, names, port, frame_text) as daemons:
            first = feed(tmp_path, names, port, cut)
            until(lambda: all(look()[n]["frequency_hz"] for n in names), "a result of every site")
            found = look("--out", tmp_path / "fleet.rrd")
            assert (tmp_path / "fleet.rrd").stat().st_size > 1000
            assert list(found) == ["frame-0", *sorted(names)]
            for name in names:
                assert found[name]["state"] == WELL, found[name]
                np.testing.assert_allclose(found[name]["frequency_hz"], first[name], rtol=0.03)
            assert found["frame-0"]["says"] == "not there"
            print(
                f"{count} daemons: {max(d.rss_mb for d in daemons):.0f} MiB, {max(d.cpu_s for d in daemons):.1f} s each"
            )
            daemons[-1].kill()
            until(lambda: look()[names[-1]]["says"] == "not there", "the one that died is missed")
            assert all(look()[name]["state"] == WELL for name in names[:-1])
    finally:
        router.kill()


@pytest.mark.representative
def test_two_daemons_and_one_that_is_missing(tmp_path: Path, frame_text: str, cut: Cut, main: Cli) -> None:
    overlooked(tmp_path, 2, frame_text, cut, main)


@pytest.mark.slow
def test_ten_daemons(tmp_path: Path, frame_text: str, cut: Cut, main: Cli) -> None:
    overlooked(tmp_path, 10, frame_text, cut, main)
