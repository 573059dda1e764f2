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
from monitor.damage import State
from monitor.model import simulate
from monitor.service import fleet
from monitor.service.fleet import SiteStatus, code, status
from monitor.service.fleet_view import text
from tests.support.live_rig import DEPLOY, Command
from tests.support.samples import T0_NS, Cli, Cut
from tests.support.waiting import until
from tests.support.zenoh_router import Router, free_port

pytestmark = pytest.mark.system

NOW_NS = 1_800_000_000_000_000_000
HEALTH = {"wall_ns": NOW_NS - 10**9, "source": {"connected": True}, "failed": {}}
RESULT = {"t_end_ns": 7, "ddi": [0.01, 0.2], "ddi_std": [0.01, 0.02], "frequencies_hz": [5.2, 16.0], "skipped": None}
QUIET = {"level": "normal", "active": {}, "reason": ""}
WELL: dict[str, Any] = {"state": "normal", "headline": "No loss above 2.3 % in any story.", "doubts": []}
LOST: dict[str, Any] = {
    "state": "warning",
    "headline": "Story 2 lost 20.0 ± 4.0 % of its stiffness.",
    "doubts": ["A doubt."],
}


def told(**answer: Any) -> SiteStatus:
    whole: dict[str, Any] = {**WELL, "results": RESULT, "alarm": QUIET, "health": HEALTH, "gap": None, **answer}
    return status("a", json.dumps(whole).encode(), True, NOW_NS, 60.0)


def test_a_site_says_its_state_its_largest_loss_first_mode_and_last_event() -> None:
    wanted = SiteStatus("a", State.NORMAL, WELL["headline"], (), (), (), 0.2, 0.02, 5.2, 7, 1.0)
    assert told() == wanted and wanted.content["says"] == WELL["headline"] and code([wanted]) == 0
    found = told(event={"id": "20260101T000319.97Z", "verdict": "inspect it", "drift_peak_m": [None, 0.0048]})
    assert found.event == "20260101T000319.97Z: inspect it; largest drift 4.8 mm in story 2"
    assert found.event in text([found]) and told(event=None).event == ""
    found = told(**LOST, alarm={"level": "warning", "active": {"2": "warning"}, "reason": "story 2 lost 20 %"})
    assert (found.state, found.stories, found.says) == (State.WARNING, (2,), LOST["headline"])
    assert found.doubts == ("A doubt.",) and code([found, told()]) == 10


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        ({"source": {"connected": False, "says": "lost (cable out)"}}, " source: lost (cable out)."),
        ({"failed": {"recorder": "disk full"}}, " recorder: disk full."),
        ({"source": {"connected": False, "error": "", "ended": True}}, ""),
    ],
)
def test_what_does_not_work_of_a_monitor_is_no_all_clear_and_the_end_of_a_source_is_no_fault(
    answer: dict[str, Any], says: str
) -> None:
    found = told(health={**HEALTH, **answer})
    assert (found.state, found.says) == (State.NORMAL, WELL["headline"] + says)
    assert code([found]) == (11 if says else 0)


@pytest.mark.parametrize("wall_ns", [NOW_NS - 86_400 * 10**9, NOW_NS + 86_400 * 10**9])
def test_a_wrong_clock_hides_no_silence_and_makes_none(wall_ns: int) -> None:
    """The monitor's clock or this machine's is a day off; how long it has been silent the monitor counts itself."""
    health = {**HEALTH, "wall_ns": wall_ns}
    well, hung = told(health=health, silent_s=3.0), told(health=health, silent_s=90.0)
    assert (well.state, well.silent_s) == (State.NORMAL, 3.0)
    assert hung.state is State.NOT_JUDGED and hung.says.startswith("The monitor is silent for 90 s; before: ")
    assert told(health=health, silent_s=float("nan")).state is State.NOT_JUDGED


def test_a_silent_monitor_judges_nothing_and_an_alarm_stands_with_its_time() -> None:
    found = told(health={**HEALTH, "wall_ns": NOW_NS - 90 * 10**9})
    before = "before: no loss above 2.3 % in any story, as of 1970-01-01 00:00 UTC."
    assert (found.state, found.says) == (State.NOT_JUDGED, f"The monitor is silent for 90 s; {before}")
    found = told(**LOST, health={**HEALTH, "wall_ns": NOW_NS - 90 * 10**9})
    assert found.state is State.WARNING and found.says.endswith("stiffness, as of 1970-01-01 00:00 UTC.")
    assert found.doubts[0] == "The monitor is silent for 90 s."


@pytest.mark.parametrize("state", ["doubtful", "not_judged"])
def test_what_is_not_judged_is_not_normal(state: str) -> None:
    found = told(state=state, headline="No window could be judged.")
    assert (found.state.value, code([told(), found])) == (state, 11)


def test_an_older_monitor_that_says_no_state_is_not_judged_but_its_alarm_stands() -> None:
    older: dict[str, Any] = {"results": RESULT, "health": HEALTH, "alarm": QUIET}
    assert status("a", json.dumps(older).encode(), True, NOW_NS, 60.0).state is State.NOT_JUDGED
    older["alarm"] = {"level": "alarm", "active": {"1": "alarm"}, "reason": "story 1 lost 12 %"}
    found = status("a", json.dumps(older).encode(), True, NOW_NS, 60.0)
    assert (found.state, found.says) == (State.ALARM, "story 1 lost 12 %")


def test_an_answer_that_makes_no_sense_is_not_judged_and_no_site_at_all_is_no_all_clear() -> None:
    for answer in (b"", b"[]", b'"x"', b"{", b'{"results": 3}', b'{"health": {"wall_ns": "x"}}', b"\xff"):
        found = status("a", answer, True, NOW_NS, 60.0)
        assert (found.state, found.says) == (State.NOT_JUDGED, "The monitor's answer cannot be understood."), answer
    assert code([]) == 11


def test_who_is_young_missing_or_hangs_is_told_apart_with_a_line_a_site() -> None:
    young = {"state": "not_judged", "headline": "No window of data yet.", "doubts": []}
    found = told(**young, results=None, alarm=None, health=None)
    assert found == SiteStatus("a", State.NOT_JUDGED, "No window of data yet.")
    missing = status("b", None, False, NOW_NS, 60.0)
    assert missing.says == "The monitor is not there."
    assert status("a", None, True, NOW_NS, 60.0).says == "The monitor is there, but does not answer."
    lines = text([told(), missing]).splitlines()
    assert lines[1].split()[:9] == ["a", "normal", "20.0", "+-", "2.0", "%", "5.2", "Hz", "1970-01-01T00:00:00"]
    assert lines[1].endswith(WELL["headline"])
    assert lines[2].split() == ["b", "not", "judged", "The", "monitor", "is", "not", "there."]


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
                assert found[name]["state"] == "not_judged", found[name]
                assert (
                    found[name]["headline"].startswith(("No baseline", "No data since")) and not found[name]["troubles"]
                )
                np.testing.assert_allclose(found[name]["frequency_hz"], first[name], rtol=0.03)
            assert found["frame-0"]["says"] == "The monitor is not there."
            print(
                f"{count} daemons: {max(d.rss_mb for d in daemons):.0f} MiB, {max(d.cpu_s for d in daemons):.1f} s each"
            )
            daemons[-1].kill()
            until(lambda: look()[names[-1]]["says"] == "The monitor is not there.", "the one that died is missed")
            assert all(look()[name]["frequency_hz"] for name in names[:-1])
    finally:
        router.kill()


@pytest.mark.representative
def test_two_daemons_and_one_that_is_missing(tmp_path: Path, frame_text: str, cut: Cut, main: Cli) -> None:
    overlooked(tmp_path, 2, frame_text, cut, main)


@pytest.mark.slow
def test_ten_daemons(tmp_path: Path, frame_text: str, cut: Cut, main: Cli) -> None:
    overlooked(tmp_path, 10, frame_text, cut, main)
