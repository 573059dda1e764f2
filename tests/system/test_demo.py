"""`make demo` and the viewer's picture."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from monitor.runs import demo
from tests.support.debian import demand
from tests.support.samples import Cli

pytestmark = pytest.mark.system

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    out = tmp_path_factory.mktemp("demo")
    said: list[str] = []
    demo.run(ROOT / "recordings", out, say=said.append, on_warning=pytest.fail)
    return out, "\n".join(said)


def test_the_demo_finds_the_damage_and_only_there(results: tuple[Path, str]) -> None:
    out, said = results
    alarms = json.loads((out / "summary.json").read_text())["alarms"]
    assert [(a["level"], a["story"]) for a in alarms] == [("alarm", 2)]
    assert alarms[0]["ddi"] == pytest.approx(0.12, abs=0.01)
    assert "Story 2 from the top lost 11" in said  # the columns' 12 %, as a model without joints sees it


def test_a_file_in_the_place_of_its_folder_is_refused_at_once(tmp_path: Path, main: Cli) -> None:
    (tmp_path / "out").write_text("mine")
    done = main("demo", "--out", tmp_path / "out", cwd=ROOT)
    assert (done.returncode, done.stdout) == (66, "")
    assert done.stderr.startswith("error: ") and str(tmp_path / "out") in done.stderr


def test_the_demo_says_how_far_a_shear_frame_misses_the_measured_one(results: tuple[Path, str]) -> None:
    out, said = results
    summary = json.loads((out / "measured-frame" / "summary.json").read_text())
    np.testing.assert_allclose(summary["frequencies_hz"], [3.69, 11.13, 16.67], rtol=0.005)
    assert summary["frequency_misfit"][2] > 0.1
    assert "11.11 Hz measured, 10.24 Hz by the structure file" in said
    assert summary["alarms"] == []


def test_the_demo_leaves_what_the_readme_names(results: tuple[Path, str]) -> None:
    out, _ = results
    for name in ("baseline.json", "results.jsonl", "results.mcap", "live.rrd", "summary.json"):
        assert (out / name).stat().st_size > 0
    assert not list(out.rglob("*.part"))


def test_the_viewer_draws_the_demo(results: tuple[Path, str], tmp_path: Path) -> None:
    """Red for the lost story, green for the others, and hardly an empty panel."""
    demand("mesa-vulkan-drivers")
    shot = tmp_path / "viewer.png"
    subprocess.run(["bash", ROOT / "docs/shot.sh", results[0] / "live.rrd", shot], check=True, timeout=200)
    picture = np.asarray(Image.open(shot).convert("RGB"))
    red = (picture[:, :, 0] > 180) & (picture[:, :, 1] < 90) & (picture[:, :, 2] < 90)
    green = (picture[:, :, 1] > 140) & (picture[:, :, 0] < 120) & (picture[:, :, 2] < 160)
    assert red.sum() > 500, "the story that lost stiffness and the alarm are red"
    assert green.sum() > 500, "the sound stories are green"
    height, width = red.shape
    lamp = np.s_[: height // 10, : width * 2 // 5]  # the bar in the colour of the state
    assert red[lamp].sum() > 5000 and green[lamp].sum() < 50, "the state is alarm"
    frame = np.s_[height * 3 // 10 : height * 2 // 3, : width * 2 // 5]  # the panel with the structure
    assert red[frame].sum() > 500, "the story that lost stiffness is red where the frame stands"
    assert green[frame].sum() > 1000, "the sound stories are green there"
    # Twelve tiles of the window: each shows something, text or lines, on its dark ground.
    tiles = [t for band in np.array_split(picture[60:-60], 3) for t in np.array_split(band, 4, axis=1)]
    assert min(float((t.max(axis=2) > 100).mean()) for t in tiles) > 0.001
