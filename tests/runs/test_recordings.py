"""Replay goldens: every shipped recording is what index.toml says, and gives what it says."""

from __future__ import annotations

import shlex
import tomllib
from pathlib import Path

import numpy as np
import pytest

from drivers.mcap_file import read_recordings, recording_info
from monitor.config import configuration
from monitor.core import WindowResult, sha256
from monitor.damage import Baseline
from monitor.inference import gather
from monitor.pipeline import Pipeline
from monitor.runs import calibrate, diagnose
from tests.support.brisk import brisk
from tests.support.samples import Cli

FOLDER = Path(__file__).parents[2] / "recordings"
INDEX = tomllib.loads((FOLDER / "index.toml").read_text())
RECORDINGS = {entry["file"]: entry for entry in INDEX["recording"]}
REPLAYS = {entry["name"]: entry for entry in INDEX["replay"]}


def test_the_index_lists_every_recording() -> None:
    assert {p.name for p in FOLDER.glob("*.mcap")} == set(RECORDINGS)


@pytest.mark.parametrize("name", RECORDINGS)
def test_a_recording_is_what_the_index_says(name: str) -> None:
    entry, info = RECORDINGS[name], recording_info(FOLDER / name)
    assert sha256(FOLDER / name) == entry["sha256"]
    assert info.sample_rate_hz == entry["rate_hz"]
    assert list(info.channels["/acceleration"]) == entry["channels"]
    assert info.n_samples == entry["samples"]


def simulations() -> dict[str, list[str]]:
    """Options of every simulation of make_simulated.sh, by the file that it makes."""
    lines = (FOLDER / "make_simulated.sh").read_text().splitlines()
    common = next(line for line in lines if line.startswith("simulate()"))
    common = common.partition("simulate --")[2].partition('"$@"')[0]
    calls = [shlex.split(line) for line in lines if line.startswith("simulate --out")]
    return {Path(words[2]).name: [*shlex.split("--" + common), *words[3:]] for words in calls}


@pytest.mark.parametrize("name", simulations())
def test_a_simulated_recording_is_what_its_script_makes(name: str, tmp_path: Path, main: Cli) -> None:
    done = main("simulate", "--out", tmp_path / name, *simulations()[name], cwd=FOLDER.parent)
    assert done.returncode == 0, done.stderr
    made, shipped = (
        np.concatenate([b.samples for b in read_recordings([folder / name])]) for folder in (tmp_path, FOLDER)
    )
    np.testing.assert_allclose(made, shipped, atol=1e-5 * float(np.abs(shipped).max()))


@pytest.mark.engine
@pytest.mark.parametrize("name", REPLAYS)
def test_a_replay_gives_what_the_index_says(name: str) -> None:
    entry = REPLAYS[name]
    settings = configuration.load(FOLDER / entry["structure"])
    healthy: Baseline | None = None
    if entry.get("calibrate"):
        healthy, _ = calibrate.calibrate([FOLDER / f for f in entry["calibrate"]], settings)
    pipeline = Pipeline(settings, healthy)
    results = [r for b in read_recordings([FOLDER / f for f in entry["files"]]) for r in pipeline.push(b)]
    windows = [r for r in results if isinstance(r, WindowResult)]
    assert len(windows) == entry["windows"]
    assert [r.skipped for r in windows if r.skipped is not None] == []
    for r in windows:  # three modes in every window, none of them spurious
        np.testing.assert_allclose(r.modes.frequencies_hz, entry["frequencies_hz"], rtol=entry["frequency_rtol"])
    last = windows[-1]
    if healthy is not None:
        np.testing.assert_allclose(last.damage.ddi, entry["ddi"], atol=entry["ddi_atol"])
    assert last.alarm.level.value == entry["level"]
    assert list(last.alarm.stories) == entry["stories"]


@pytest.mark.engine
def test_the_damaged_recording_is_diagnosed_as_what_it_was_made_with() -> None:
    config = brisk(configuration.load(FOLDER / "frame.toml"))
    healthy, changed = (
        gather(read_recordings([FOLDER / f"frame-{name}.mcap"]), config.front_end()) for name in ("healthy", "after")
    )
    found, _ = diagnose.diagnose_segments(changed, diagnose.learn_healthy_prior(healthy, config), config)
    assert found.verdict == "named"
    (cause,) = found.causes
    assert (cause.effect.name, cause.effect.location) == ("stiffness_change", "story 2")
    assert abs(cause.effect.values()["relative"] + 0.12) < 1.96 * cause.std["relative"]
    assert cause.std["relative"] < 0.005
