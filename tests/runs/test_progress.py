"""Every long job tells what it does, and how much of it is done where that is known."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from monitor.config import Configuration, configuration
from monitor.core import OnProgress, Step, utc
from monitor.runs import (
    Options,
    calibrate,
    compare,
    diagnose,
    features,
    import_files,
    look,
    paper_tables,
    replay,
    synthetic_recording,
)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory, frame_text: str) -> Path:
    folder = tmp_path_factory.mktemp("progress")
    (folder / "s.toml").write_text(frame_text)
    return folder


@pytest.fixture(scope="module")
def config(site: Path) -> Configuration:
    return configuration.load_with_model(site / "s.toml")


@pytest.fixture(scope="module")
def simulated(site: Path, config: Configuration) -> tuple[Path, list[Step]]:
    """Make a recording of three minutes, and collect what was told."""
    told: list[Step] = []
    synthetic_recording.write_simulated_recording(
        site / "r.mcap",
        config,
        duration_s=180.0,
        excitation="ambient",
        noise=0.02,
        damage=[],
        effects=[],
        rate_hz=100.0,
        level_spread=0.0,
        t0_ns=0,
        seed=1,
        on_progress=told.append,
    )
    return site / "r.mcap", told


class Enough(Exception):
    """Ends a job."""


def told_by(job: Callable[[OnProgress], object], until: str | None = None) -> list[Step]:
    """Return the steps that a job tells, to its end or `until` one, in order; of those with the same words the last."""
    told: list[Step] = []

    def tell(step: Step) -> None:
        told.append(step)
        if step.does == until:
            raise Enough

    with suppress(Enough):
        job(tell)
    return [
        step for step, after in zip(told, [*told[1:], None], strict=True) if after is None or after.does != step.does
    ]


def test_a_simulation_tells_how_much_of_it_is_written(simulated: tuple[Path, list[Step]]) -> None:
    first, last = simulated[1][0], simulated[1][-1]
    assert (first.does, first.total, first.then) == ("computes the motion", 0.0, "writes the recording")
    assert (last.does, round(last.done, 1), last.total, last.unit) == ("writes the recording", 3.0, 3.0, "min of data")


def test_what_passes_over_recordings_tells_their_length(
    simulated: tuple[Path, list[Step]], config: Configuration, site: Path
) -> None:
    path = [simulated[0]]
    (replayed,) = told_by(lambda tell: replay.replay(path, config, None, site / "out", on_progress=tell))
    assert (replayed.does, round(replayed.done, 1), replayed.total) == ("", 3.0, 3.0)
    searches = "fits the model without causes"
    evaluated, updated, _ = told_by(lambda tell: calibrate.calibrate(path, config, on_progress=tell), until=searches)
    assert (evaluated.does, evaluated.total, evaluated.then) == ("evaluates the windows", 3.0, updated.does)
    assert (updated.does, updated.then) == ("updates the model to the modes", "looks for what is so from the start")
    read, *_ = told_by(lambda tell: diagnose.evaluate(path, config, lambda _: None, tell))
    assert (read.does, read.total) == ("reads the recordings", 3.0)


def test_a_diagnosis_tells_each_step_and_what_comes_then(
    simulated: tuple[Path, list[Step]], config: Configuration
) -> None:
    steps = told_by(lambda tell: diagnose.diagnose([simulated[0]], config, None, lambda _: None, tell))
    assert [step.does for step in steps] == [
        "reads the recordings",
        "fits the model without causes",
        "looks for cause 1",
        "tests each cause beside the others",
        "tests the causes on held-out data",
        "puts the finding into words",
    ]
    assert [step.then for step in steps[:-1]] == [
        "fits the model without causes",
        "looks for causes",
        "tests each cause beside the others",
        "",
        "puts the finding into words",
    ]


def test_looks_tell_the_length_of_the_recordings_and_which_one_they_are_at(simulated: tuple[Path, list[Step]]) -> None:
    path = simulated[0]
    read, identified = told_by(lambda tell: look.look([path], on_progress=tell))
    assert (read.does, read.total, read.then, identified.does) == (
        "reads the recordings",
        3.0,
        "identifies the modes",
        "identifies the modes",
    )
    sides = told_by(lambda tell: compare.compare(path, path, on_progress=tell))
    assert [step.does for step in sides][:2] == ["r.mcap: reads the recordings", "r.mcap: identifies the modes"]


def test_tables_and_tests_tell_their_number(tmp_path: Path) -> None:
    rows = [f"{utc(hour * 3_600_000_000_000)},{4.0 + 0.001 * (hour % 7)}" for hour in range(120)]
    table = tmp_path / "f.csv"
    table.write_text("t,f1\n" + "\n".join(rows))
    until_ns = 100 * 3_600_000_000_000
    *_, judged = told_by(
        lambda tell: features.features(
            table, Options(time="t"), ["f1"], [], until_ns, tmp_path / "out", on_progress=tell
        )
    )
    assert (judged.does, judged.done, judged.total, judged.unit) == ("judges the rows", 119, 120, "rows")

    (tmp_path / "a.csv").write_text("a1 [g];a2 [g]\n" + "0.1;0.2\n" * 300)
    read, written = told_by(
        lambda tell: import_files([tmp_path / "a.csv"], tmp_path / "a.mcap", Options(rate_hz=100.0), on_progress=tell)
    )
    assert (read.does, read.total, read.unit, written.does) == ("reads a.csv", 1, "files", "writes the recording")

    *_, last = told_by(lambda tell: paper_tables.run_simulated_tests(1, tell))
    assert last.done == last.total > 0.0
