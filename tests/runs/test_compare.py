"""The command compare: one answer, by the scatter within two records or between healthy ones, and what it lists under it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from monitor.core import BadInputError
from monitor.identification import least_chance
from monitor.runs import compare
from tests.statistics.compared import RATE_HZ, motion, recorded, seconds_of
from tests.support.period_lines import json_lines, line_of
from tests.support.samples import Cli

SECONDS = seconds_of("frame")


def record(path: Path, seed: int, *, seconds: float = SECONDS, kind: str = "frame", **changes: float) -> Path:
    return recorded(path, motion(kind, seconds, np.random.default_rng(seed), **changes))


@pytest.fixture(scope="module")
def healthy(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Six days of one structure, each with frequencies of its own."""
    folder = tmp_path_factory.mktemp("days")
    return [
        record(folder / f"{k}.mcap", k, faster=faster)
        for k, faster in enumerate((0.006, -0.006, 0.002, -0.003, 0.004, -0.001))
    ]


def named(content: dict[str, Any]) -> set[str]:
    return {test["what"] for test in content["tests"] if test["significant"] and test["kind"] != "level"}


@pytest.mark.engine
def test_what_differs_within_the_records_may_be_one_of_healthy_days(healthy: list[Path], tmp_path: Path) -> None:
    alone = compare.compare(healthy[0], healthy[1])
    assert alone["differs"] is True
    assert alone["chance"] <= alone["rate"] == 0.05
    assert "mode 1: frequency" in named(alone)
    assert "beyond the scatter within the records" in alone["answer"]
    beside = compare.compare(healthy[0], healthy[1], healthy=healthy[2:])
    assert beside["differs"] is False
    assert named(beside) == set()
    assert "no difference beyond the scatter between the healthy records" in beside["answer"]
    softer = compare.compare(healthy[0], record(tmp_path / "s.mcap", 9, loss=0.15), healthy=healthy[1:])
    assert softer["differs"] is True
    few = compare.compare(healthy[0], healthy[1], healthy=healthy[2:4])
    assert few["differs"] is None
    assert "2 healthy records show no scatter; give 3 or more" in few["answer"]


def test_records_too_short_for_the_rate_are_no_equals(tmp_path: Path) -> None:
    a, b = (record(tmp_path / f"{k}.mcap", k, seconds=45.0, loss=0.3 * k) for k in range(2))
    content = compare.compare(a, b)
    assert content["differs"] is None
    assert content["chance"] is None
    assert not named(content)
    assert "cannot say whether they differ" in compare.in_words(content).splitlines()[-1]
    assert not [test for test in content["tests"] if test["kind"] == "level"], "a block is longer than a record"
    needed = float(content["answer"].split("record ")[1].split(" s")[0])
    assert needed == pytest.approx(4.0 * content["blocks"]["length_s"], rel=0.01)


def test_records_of_eight_seconds_state_no_modes_and_are_compared_by_their_spectra(tmp_path: Path) -> None:
    def short(name: str, seed: int, weight: float) -> Path:
        noise = np.random.default_rng(seed).standard_normal((8 * 400 + 1, 1))
        return recorded(tmp_path / f"{name}.mcap", noise[1:] + weight * noise[:-1], rate_hz=400.0)

    a, b, c = short("a", 1, 0.3), short("b", 2, 0.3), short("c", 3, 0.6)
    equal, other = compare.compare(a, b), compare.compare(a, c)
    assert (equal["differs"], other["differs"]) == (False, True)
    assert other["chance"] == pytest.approx(least_chance(4, 4))
    assert not [test for test in other["tests"] if test["kind"] != "level"]
    assert "the spectrum's shape changed; no mode's change tells how" in other["answer"]
    assert all("record at least 20 s" in reason for reason in other["without_modes"])


def test_the_command_takes_healthy_records_after_the_two_and_answers_last(main: Cli, tmp_path: Path) -> None:
    for k in range(5):
        recorded(tmp_path / f"{k}.mcap", np.random.default_rng(k).standard_normal((8 * 400, 1)), rate_hz=400.0)
    names = [f"{k}.mcap" for k in range(5)]
    done = main("compare", *names[:2], "--healthy", *names[2:], cwd=tmp_path)
    assert done.stdout.splitlines()[-1].startswith("no difference beyond the scatter between the healthy records")
    told = json.loads(main("compare", *names[:2], "--healthy", *names[2:], "--json", cwd=tmp_path).stdout)
    assert (told["differs"], [Path(name).name for name in told["healthy"]]) == (False, names[2:])
    lost = main("compare", *names, cwd=tmp_path)
    assert lost.returncode == 2
    assert "2.mcap: compare takes two; name healthy records of other days after --healthy" in lost.stderr


def run(folder: Path, seed: int, *, moved: float = 0.0, day: float = 0.0, windows: int = 160) -> Path:
    """A folder of results: two modes that scatter by 0.1 % in windows of 20 s, one each 5 s, and an index."""
    rng = np.random.default_rng(seed)
    folder.mkdir()
    noise = np.apply_along_axis(np.convolve, 0, rng.standard_normal((windows + 3, 3)), np.ones(4) / 2.0, "valid")
    rows = []
    for k, row in enumerate(noise):
        hz = np.array([2.0 * (1.0 - moved), 5.0]) * (1.0 + 0.001 * row[:2] + day)
        modes = {
            "frequencies_hz": hz.tolist(),
            "damping_ratio": [0.01, 0.012],
            "mode_tracks": [0, 1],
            "ddi": [0.01 * row[2]],
        }
        shapes = [[[0.5, 0.0], [1.0, 0.0]], [[1.0, 0.0], [-0.5, 0.0]]]
        rows.append(line_of(k) | modes | {"t_end_ns": (20 + 5 * k) * 10**9, "window_s": 20.0, "mode_shapes": shapes})
    json_lines(folder / "results.jsonl", rows)
    return folder


def test_folders_of_results_are_compared_by_their_modes_and_with_healthy_ones(tmp_path: Path) -> None:
    a, b = run(tmp_path / "a", 1), run(tmp_path / "b", 2)
    equal = compare.compare(a, b)
    assert (equal["differs"], equal["blocks"]["a"]) == (False, 4)
    moved = compare.compare(a, run(tmp_path / "c", 3, moved=0.004))
    assert moved["differs"] is True
    assert named(moved) == {"mode 1: frequency"}
    days = [run(tmp_path / f"d{k}", 10 + k, day=day) for k, day in enumerate((0.004, -0.003, 0.001, -0.004, 0.002))]
    assert compare.compare(a, days[0])["differs"] is True
    assert compare.compare(a, days[0], healthy=days[1:])["differs"] is False
    short = compare.compare(run(tmp_path / "s", 4, windows=10), b)
    assert (short["differs"], "record" in short["cannot_say"]) == (None, True)


def test_a_level_alone_is_listed_and_is_no_difference(tmp_path: Path) -> None:
    a = record(tmp_path / "a.mcap", 1)
    louder = recorded(tmp_path / "b.mcap", 10.0 * motion("frame", SECONDS, np.random.default_rng(2)))
    content = compare.compare(a, louder)
    assert content["differs"] is False
    levels = [test for test in content["tests"] if test["kind"] == "level"]
    assert all(test["significant"] for test in levels)
    assert np.median([test["change"] for test in levels]) == pytest.approx(20.0, abs=1.0)


def test_stretches_around_gaps_are_cut_each_for_itself(tmp_path: Path) -> None:
    samples = motion("single", 6.0 * SECONDS, np.random.default_rng(3))
    a = recorded(tmp_path / "a.mcap", samples, gaps=(0.37, 0.62))
    content = compare.compare(a, record(tmp_path / "b.mcap", 4, kind="single", seconds=2.0 * SECONDS))
    assert content["differs"] is False
    assert content["blocks"]["b"] == 4
    assert content["blocks"]["a"] > 8


def test_a_faster_record_is_compared_up_to_half_the_slower_ones_rate(tmp_path: Path) -> None:
    def record_at(name: str, rate_hz: float, seed: int) -> Path:
        samples: NDArray[np.float64] = np.random.default_rng(seed).standard_normal((int(30.0 * rate_hz), 1))
        return recorded(tmp_path / f"{name}.mcap", samples, rate_hz=rate_hz)

    content = compare.compare(record_at("slow", 2.0 * RATE_HZ, 1), record_at("fast", 4.0 * RATE_HZ, 2))
    assert content["differs"] is False


def test_one_of_the_healthy_records_by_other_sensors_is_named(healthy: list[Path], tmp_path: Path) -> None:
    other = record(tmp_path / "one.mcap", 1, kind="single")
    with pytest.raises(BadInputError, match=r"one\.mcap has a1: compare what"):
        compare.compare(healthy[0], healthy[1], healthy=[other])
