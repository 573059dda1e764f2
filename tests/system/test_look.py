"""The commands look and compare as a newcomer uses them, up to a calibration on the proposed structure."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.support.samples import Cli

pytestmark = pytest.mark.system


def test_from_a_recording_to_a_structure_that_calibrates(main: Cli, frame_text: str, tmp_path: Path) -> None:
    def done(*arguments: object) -> str:
        result = main(*arguments, cwd=tmp_path)
        assert result.returncode == 0, result.stderr
        return str(result.stdout)

    (tmp_path / "true.toml").write_text(frame_text)
    for name, seed in (("a", 1), ("b", 2)):
        size = ("--duration", 400, "--rate", 200, "--seed", seed)
        done("simulate", "--structure", "true.toml", "--out", f"{name}.mcap", *size)
    text = done("look", "a.mcap", "--out", "out", "--write-structure", "frame.toml", "--mass-kg", 1.0)
    assert text.startswith("mode")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"look.html", "look.json", "modes.csv"}
    found = json.loads(done("look", "a.mcap", "--json"), parse_constant=pytest.fail)
    assert found["modes"] == json.loads((tmp_path / "out/look.json").read_text())["modes"]
    assert "3 stories" in done("check", "frame.toml")
    healthy = json.loads(done("calibrate", "a.mcap", "--structure", "frame.toml", "--out", "b.json", "--json"))
    drawn = json.loads(done("check", "true.toml", "--json"))
    assert drawn["channels"] == ["a1", "a2", "a3"]
    assert len(healthy["stiffness_n_per_m"]) == 3
    compared = json.loads(done("compare", "a.mcap", "b.mcap", "--json"))
    assert {test["kind"] for test in compared["tests"]} == {"frequency", "damping", "shape", "level"}
    assert not [t["what"] for t in compared["tests"] if t["significant"] and t["kind"] != "level"]
    for name in ("a", "b"):
        done("replay", f"{name}.mcap", "--structure", "frame.toml", "--baseline", "b.json", "--out", f"{name}-out")
    folders = json.loads(done("compare", "a-out", "b-out", "--json"))
    assert "index" in {test["kind"] for test in folders["tests"]}
    mixed = main("compare", "a.mcap", "a-out", cwd=tmp_path)
    assert mixed.returncode == 65
    assert "two recordings, or two folders" in mixed.stderr
