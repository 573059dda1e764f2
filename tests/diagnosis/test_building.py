"""A building in both directions: a loss is announced and explained in its storey and direction, and nowhere else."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.support.samples import Cli

pytestmark = [pytest.mark.engine, pytest.mark.timeout(1200)]

STOREY = "[[storeys]]\nmass_kg = 1e5\nplan_m = [20.0, 12.0]\nstiffness_x_n_per_m = {}\nstiffness_y_n_per_m = {}\n"
BOX = '[[sensors]]\nchannel = "{0}{1}"\nfloor = {1}\naxis = "{2}"\nposition_m = [{3}, {4}]\n'


@pytest.fixture(scope="module")
def building(tmp_path_factory: pytest.TempPathFactory) -> Path:
    text = '[structure]\nkind = "building"\n' + STOREY.format("3e7", "2e7") + STOREY.format("2.5e7", "1.7e7")
    for floor in (1, 2):
        text += (
            BOX.format("a", floor, "x", 9, 5) + BOX.format("b", floor, "y", 9, 5) + BOX.format("c", floor, "y", -9, -5)
        )
    path = tmp_path_factory.mktemp("building") / "building.toml"
    path.write_text(text + "[processing]\nrate_hz = 20.0\ncutoff_hz = 8.0\nwindow_s = 400.0\nhop_s = 50.0\n")
    return path


def test_a_loss_along_y_is_announced_and_named_there_and_nowhere_else(
    main: Cli, tmp_path: Path, building: Path
) -> None:
    healthy, lost, baseline = tmp_path / "h.mcap", tmp_path / "d.mcap", tmp_path / "b.json"
    own = ("--structure", building)
    for out, seed, more in ((healthy, 73100901, ()), (lost, 73100902, ("--damage", "storey2y=0.1"))):
        at = ("--out", out, "--seed", seed, "--duration", 2400, "--rate", 50)
        assert main("simulate", *own, *at, *more).returncode == 0
    done = main("calibrate", healthy, *own, "--out", baseline)
    assert done.returncode == 0, done.stderr
    assert "storey 2 (1st to 2nd floor), along y" in done.stdout and "N m/rad" in done.stdout
    done = main("replay", lost, *own, "--baseline", baseline, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    lines = [json.loads(line) for line in (tmp_path / "out" / "results.jsonl").read_text().splitlines()]
    judged = [line for line in lines if line["skipped"] is None]
    assert len(judged) > 30 and all(len(line["ddi"]) == len(line["stiffness_n_per_m"]) == 6 for line in judged)
    places = {
        (s, d) for line in lines for s, d in zip(line["alarm"]["stories"], line["alarm"]["directions"], strict=True)
    }
    assert places == {(2, "y")}
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    (alarm,) = summary["alarms"]
    assert (alarm["story"], alarm["direction"]) == (2, "y") and abs(alarm["ddi"] - 0.1) < 0.01
    assert summary["headline"].startswith("Storey 2 (1st to 2nd floor), along y lost")
    done = main("diagnose", lost, *own, "--baseline", baseline, "--out", tmp_path / "found")
    assert done.returncode == 0, done.stderr
    (cause,) = json.loads((tmp_path / "found" / "diagnosis.json").read_text())["causes"]
    assert (cause["effect"], cause["location"]) == ("stiffness_change", "storey 2 y")
    assert abs(cause["parameters"]["relative"]["value"] + 0.1) < 0.01
    done = main("check", tmp_path / "found" / "structure.extended.toml")
    assert done.returncode == 0, done.stderr
