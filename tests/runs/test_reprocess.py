"""Archives: which recordings make one replay, the same results as a replay's, nothing done twice."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.waiting import until

pytest.importorskip("dask")  # until it stands in the lock

import pyarrow.dataset as ds
import pyarrow.parquet as pq

from monitor.config import configuration
from monitor.model import simulate
from monitor.runs.archive import jobs
from monitor.runs.archive.inventory import Survey, expand_patterns, group_into_runs
from monitor.runs.archive.jobs import WindowsFile
from monitor.runs.archive.reprocess import reprocess
from tests.events.shaken import blocks
from tests.support.quake import shaken
from tests.support.samples import T0_NS, Cli, Cut, write_blocks
from tests.support.short_quake import STRUCTURE

pytestmark = pytest.mark.system

RATE = 128.0
S = 1_000_000_000


def survey(name: str, start_s: float, end_s: float, folder: str = "a", rate_hz: float = RATE) -> Survey:
    return Survey(folder, ("a1",), rate_hz, round(start_s * S), round(end_s * S), Path(folder) / name)


def grouped(*surveys: Survey, gap_s: float = 20.0) -> set[tuple[str, ...]]:
    return {tuple(p.name for p in run.paths) for run in group_into_runs(surveys, gap_s)}


def test_recordings_that_follow_one_another_are_one_replay() -> None:
    parts = survey("1", 0, 100), survey("3", 215, 300), survey("2", 100, 200)
    assert grouped(*parts) == {("1", "2", "3")}
    assert grouped(*parts, gap_s=10.0) == {("1", "2"), ("3",)}


def test_recordings_side_by_side_or_of_other_streams_are_replays_of_their_own() -> None:
    assert grouped(survey("1", 0, 100), survey("2", 0, 100)) == {("1",), ("2",)}
    assert grouped(survey("1", 0, 100), survey("2", 100, 200, folder="b")) == {("1",), ("2",)}
    assert grouped(survey("1", 0, 100), survey("2", 100, 200, rate_hz=64.0)) == {("1",), ("2",)}
    both = grouped(survey("1", 0, 100), survey("2", 0, 90), survey("3", 100, 200), survey("4", 90, 200))
    assert both == {("1", "3"), ("2", "4")}


def test_patterns_and_names(tmp_path: Path) -> None:
    for name in ("b/2.mcap", "b/1.mcap", "c.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    names = expand_patterns([str(tmp_path / "**/*.mcap"), str(tmp_path / "b/1.mcap"), "absent.mcap"])
    assert [p.name for p in names] == ["1.mcap", "2.mcap", "absent.mcap"]


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory, frame_text: str, cut: Cut) -> Path:
    """A stream in three files with a pause before the last, another stream, and a recording that is too short."""
    folder = tmp_path_factory.mktemp("archive")
    (folder / "frame.toml").write_text(frame_text)
    model = configuration.load(folder / "frame.toml").model()
    x = simulate(model, duration_s=120.0, rate_hz=RATE, noise=0.03, seed=1).floors
    edges = {"a/1": (0, 5000), "a/2": (5000, 9000), "a/3": (10000, len(x)), "b/short": (0, 500)}
    for name, (begin, end) in edges.items():
        write_blocks(folder / f"{name}.mcap", cut(x[begin:end], RATE, [128], first=begin))
    y = simulate(model, duration_s=80.0, rate_hz=RATE, noise=0.03, seed=2).floors
    write_blocks(folder / "b/whole.mcap", cut(y, RATE, [77], t0_ns=T0_NS + 500 * S))
    return folder


def lines(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows of the dataset as lines of results.jsonl."""
    told = []
    for row in rows:
        keys = ("level", "stories", "reason", "active", "shelved", "changed")
        row["alarm"] = {key: row.pop(f"alarm_{key}") for key in keys}
        row["alarm"]["active"] = dict(row["alarm"]["active"])
        assert row.pop("t_end").value == row["t_end_ns"]
        for key in ("covariates", "covariate_effect", "frequency_effect"):
            row[key] = None if row[key] is None else dict(row[key])
        told.append({k: v for k, v in row.items() if k != "stream"})
    return told


def dataset(out: Path, stream: Path) -> list[dict[str, Any]]:
    windows = ds.dataset(out / "windows").to_table(filter=ds.field("stream") == str(stream))
    return lines(windows.sort_by("t_end_ns").to_pylist())


def replayed(archive: Path, out: Path, main: Cli, *names: str) -> list[dict[str, Any]]:
    done = main("replay", *[archive / n for n in names], "--structure", archive / "frame.toml", "--out", out)
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in (out / "results.jsonl").read_text().splitlines()]


@pytest.fixture(scope="module")
def done(archive: Path, tmp_path_factory: pytest.TempPathFactory, main: Cli) -> Path:
    out = tmp_path_factory.mktemp("out")
    patterns = [archive / "a/*.mcap", archive / "b/*.mcap"]
    ended = main("reprocess", *patterns, "--structure", archive / "frame.toml", "--out", out, "--workers", 2)
    assert ended.returncode == 65  # of the short one, after all others were done
    assert "short.mcap" in ended.stderr and "20 s" in ended.stderr
    assert "2 done, 0 done before" in ended.stdout
    return out


def test_the_dataset_is_what_replay_says_bit_for_bit(archive: Path, done: Path, main: Cli, tmp_path: Path) -> None:
    whole = replayed(archive, tmp_path / "a", main, "a/1.mcap", "a/2.mcap", "a/3.mcap")
    assert dataset(done, archive / "a") == whole
    assert dataset(done, archive / "b") == replayed(archive, tmp_path / "b", main, "b/whole.mcap")
    skipped = [line["skipped"] for line in whole]
    assert skipped.count(None) >= 10 and "gap in the data" in skipped
    (summary,) = [json.loads(p.read_text()) for p in (done / "runs").glob("a-*/summary.json")]
    there = json.loads((tmp_path / "a" / "summary.json").read_text())
    assert [span["file"] for span in there["recorded"]] == ["1.mcap", "2.mcap", "3.mcap"]
    # No window is due that holds some of the pause before the third.
    assert there["windows_not_due"] == skipped.count("gap in the data")
    assert (there["windows"], there["skipped"]) == (skipped.count(None), 0)
    assert {k: v for k, v in summary.items() if k in there and k != "realtime_factor"} == {
        k: v for k, v in there.items() if k != "realtime_factor"
    }


def test_a_run_is_reported_as_a_replay_is(archive: Path, done: Path, main: Cli, tmp_path: Path) -> None:
    """The folder of a run holds what `replay` leaves, so that the other commands take it."""
    (run,) = (done / "runs").glob("a-*")
    replayed(archive, tmp_path / "a", main, "a/1.mcap", "a/2.mcap", "a/3.mcap")
    for name in ("results.jsonl", "events.jsonl"):
        assert (run / name).read_bytes() == (tmp_path / "a" / name).read_bytes()
    said = []
    for folder in (run, tmp_path / "a"):
        ended = main("report", folder, "--out", tmp_path / "page.html", "--json")
        assert ended.returncode == 0, ended.stderr
        said.append(json.loads(ended.stdout))
    assert said[0] == said[1] and said[0]["judged"] >= 10
    whole = main("report", done, "--out", tmp_path / "page.html")
    assert whole.returncode == 66 and "one by one" in whole.stderr and str(done / "runs") in whole.stderr
    assert not list((done / "runs").glob("b-*/windows.part")) and len(list((done / "runs").iterdir())) == 2


def test_events_of_an_archive_are_told(archive: Path, tmp_path: Path, main: Cli) -> None:
    """A recording of an earthquake, shorter than a window, is a run with an event and without windows."""
    (tmp_path / "site.toml").write_text(STRUCTURE)
    write_blocks(tmp_path / "quake.mcap", blocks(shaken(), n=200))
    options = ("--structure", tmp_path / "site.toml", "--out", tmp_path / "out", "--workers", 1)
    done = main("reprocess", tmp_path / "quake.mcap", *options)
    assert done.returncode == 0, done.stderr
    (run,) = (tmp_path / "out/runs").iterdir()
    told = main("report", run, "--event", "last")
    assert told.returncode == 0 and list((run / "events").glob("*.html")), told.stderr


def test_what_is_done_is_not_done_again_and_what_changed_is(archive: Path, done: Path, tmp_path: Path) -> None:
    recordings = [archive / "a/1.mcap", archive / "a/2.mcap", archive / "b/whole.mcap"]
    structure, out = tmp_path / "frame.toml", tmp_path / "out"
    structure.write_text((archive / "frame.toml").read_text())
    first = reprocess(recordings, structure, None, out, workers=1)
    assert [o.made for o in first] == [True, True] and not any(o.error for o in first)
    before = {p: p.stat().st_mtime_ns for p in (out / "windows").iterdir()}
    again = reprocess(recordings, structure, None, out, workers=1)
    assert [o.made for o in again] == [False, False]
    assert {p: p.stat().st_mtime_ns for p in (out / "windows").iterdir()} == before
    next(iter(before)).unlink()
    assert sorted(o.made for o in reprocess(recordings, structure, None, out, workers=1)) == [False, True]
    # A third file goes on with the first two: one replay of three takes the place of that of two.
    grown = reprocess([*recordings, archive / "a/3.mcap"], structure, None, out, workers=1)
    assert sorted(o.made for o in grown) == [False, True]
    rows = ds.dataset(out / "windows").to_table(columns=["stream", "t_end_ns"]).to_pylist()
    assert len({tuple(row.values()) for row in rows}) == len(rows)
    assert dataset(out, archive / "a") == dataset(done, archive / "a")
    structure.write_text(structure.read_text().replace("hop_s = 5.0", "hop_s = 4.0"))
    other = reprocess(recordings, structure, None, out, workers=1)
    assert all(o.made for o in other) and len(list((out / "windows").iterdir())) == 2


def test_an_interrupted_run_leaves_nothing_in_the_dataset(
    archive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device", "results")

    monkeypatch.setattr(jobs, "pass_through", fails)
    (tmp_path / "windows").mkdir()
    task = jobs.Task("name", "b", (archive / "b/whole.mcap",), archive / "frame.toml", None, tmp_path)
    assert jobs.replay_run(task).error == "results: No space left on device"
    assert not list(tmp_path.rglob("*.parquet")) and not list(tmp_path.rglob("*.part"))
    assert not (tmp_path / "runs/b").exists()


@pytest.mark.parametrize(
    ("arguments", "code", "word"),
    [
        (("absent.mcap", "--structure", "frame.toml"), 65, "absent.mcap"),
        (("a/1.mcap", "--structure", "absent.toml"), 66, "absent.toml"),
        (("a/1.mcap", "--structure", "frame.toml", "--baseline", "absent.json"), 66, "absent.json"),
        (("a/1.mcap", "--structure", "frame.toml", "--scheduler", "nowhere"), 66, "nowhere"),
    ],
)
def test_one_clear_message(
    archive: Path, tmp_path: Path, main: Cli, arguments: tuple[str, ...], code: int, word: str
) -> None:
    ended = main("reprocess", *arguments, "--out", tmp_path / "out", cwd=archive)
    assert ended.returncode == code, ended.stderr
    assert word in ended.stderr and "Traceback" not in ended.stderr


def test_diagnoses_are_those_of_diagnose(archive: Path, tmp_path: Path, main: Cli) -> None:
    recording, structure = archive / "b/whole.mcap", archive / "frame.toml"
    main("reprocess", recording, "--structure", structure, "--out", tmp_path / "many", "--diagnose", "--workers", 1)
    main("diagnose", recording, "--structure", structure, "--out", tmp_path / "one")
    (made,) = (tmp_path / "many/diagnoses").iterdir()
    assert json.loads(made.read_text()) == json.loads((tmp_path / "one/diagnosis.json").read_text())


@pytest.fixture
def scheduler(tmp_path: Path) -> Iterator[str]:
    """A Dask scheduler and a worker as processes of their own."""
    log = (tmp_path / "dask.log").open("w+")
    command = [sys.executable, "-W", "ignore", "-m", "distributed.cli.dask_scheduler"]
    where = tmp_path / "scheduler.json"
    local = ["--host", "127.0.0.1", "--no-dashboard"]
    processes = [subprocess.Popen([*command, *local, "--port", "0", "--scheduler-file", str(where)], stderr=log)]
    try:
        until(
            lambda: where.exists() and where.read_text().strip().endswith("}"), f"a scheduler: {tmp_path / 'dask.log'}"
        )
        address = json.loads(where.read_text())["address"]
        command = [sys.executable, "-W", "ignore", "-m", "distributed.cli.dask_worker", address, "--nthreads", "1"]
        scratch = ["--local-directory", str(tmp_path)]
        processes.append(subprocess.Popen([*command, *local, *scratch], stderr=log, cwd=Path(__file__).parents[2]))
        yield address
    finally:
        for process in processes[::-1]:
            process.terminate()
            process.wait(30.0)
        log.close()


def test_a_cluster_gives_the_same(archive: Path, done: Path, scheduler: str, tmp_path: Path) -> None:
    structure, out = archive / "frame.toml", tmp_path / "out"
    (outcome,) = reprocess([archive / "b/whole.mcap"], structure, None, out, scheduler=scheduler)
    assert outcome.error is None and outcome.made
    assert dataset(out, archive / "b") == dataset(done, archive / "b")


def test_memory_holds_a_few_windows_only(archive: Path, done: Path, tmp_path: Path) -> None:
    """Long runs are written in row groups."""
    rows = WindowsFile(tmp_path / "x.part", tmp_path / "x.parquet", "s", {}, row_group=4)
    row = lines(ds.dataset(done / "windows").head(1).to_pylist())[0]
    for _ in range(9):
        rows.window(None, json.dumps(row))  # type: ignore[arg-type]
    rows.close()
    metadata = pq.ParquetFile(tmp_path / "x.parquet").metadata
    assert [metadata.row_group(k).num_rows for k in range(metadata.num_row_groups)] == [4, 4, 1]
    assert np.array_equal(pq.read_table(tmp_path / "x.parquet")["window"], [row["window"]] * 9)
