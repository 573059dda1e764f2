"""Archives in object storage: the same results as of files, by a server that speaks S3."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pyarrow.dataset as ds
import pytest

from monitor.model import simulate
from tests.support.frames import settings_of
from tests.support.object_storage import object_storage
from tests.support.samples import Cli, Cut, write_blocks
from tests.support.zenoh_router import free_port

s3fs = pytest.importorskip("s3fs")
pytestmark = pytest.mark.system

RATE = 128.0


@pytest.fixture(scope="module")
def storage() -> Iterator[s3fs.S3FileSystem]:
    with object_storage("archive"):
        yield s3fs.S3FileSystem(skip_instance_cache=True, use_listings_cache=False)


@pytest.fixture
def archive(tmp_path: Path, frame_text: str, cut: Cut, storage: s3fs.S3FileSystem) -> Path:
    """Two recordings that follow one another, as files and as objects."""
    (tmp_path / "frame.toml").write_text(frame_text)
    floors = simulate(settings_of(frame_text).model(), duration_s=80.0, rate_hz=RATE, noise=0.03, seed=6).floors
    (tmp_path / "a").mkdir()
    for name, (begin, end) in {"1": (0, 5000), "2": (5000, len(floors))}.items():
        path = tmp_path / "a" / f"{name}.mcap"
        write_blocks(path, cut(floors[begin:end], RATE, [128], first=begin))
        storage.put_file(str(path), f"archive/a/{name}.mcap")
    return tmp_path


def test_objects_are_replayed_as_files_are(archive: Path, main: Cli, storage: s3fs.S3FileSystem) -> None:
    rows, said = [], []
    for name, pattern in (("files", archive / "a/*.mcap"), ("objects", "s3://archive/a/*.mcap")):
        options = ("--structure", archive / "frame.toml", "--out", archive / name, "--workers", 1, "--json")
        done = main("reprocess", pattern, *options)
        assert done.returncode == 0, done.stderr
        said.append(json.loads(done.stdout)["done"])
        table = ds.dataset(archive / name / "windows").to_table().sort_by("t_end_ns")
        rows.append(table.drop_columns(["stream"]).to_pylist())
        if name == "objects":
            assert set(table["stream"].to_pylist()) == {"s3://archive/a"}
            again = main("reprocess", pattern, *options)
            assert json.loads(again.stdout)["done_before"] == 1
    assert said == [1, 1] and len(rows[0]) >= 10 and str(rows[0]) == str(rows[1])
    (summary,) = (archive / "objects" / "runs").glob("*/summary.json")
    assert json.loads(summary.read_text())["recordings"] == ["s3://archive/a/1.mcap", "s3://archive/a/2.mcap"]
    storage.put_file(str(archive / "a/1.mcap"), "archive/a/2.mcap")
    changed = main("reprocess", "s3://archive/a/2.mcap", *options)
    assert json.loads(changed.stdout)["done_before"] == 0, "another content is another version"


def test_what_cannot_be_read_is_named_by_its_address(
    archive: Path, main: Cli, storage: s3fs.S3FileSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    storage.pipe_file("archive/damaged.mcap", b"nonsense")
    for name, says in (("none.mcap", "no such object"), ("damaged.mcap", "damaged.mcap")):
        place = f"s3://archive/{name}"
        for command, code in (("reprocess", 65), ("diagnose", 66 if name == "none.mcap" else 65)):
            done = main(command, place, "--structure", archive / "frame.toml", "--out", archive / "out")
            assert (done.returncode, "Traceback" in done.stderr) == (code, False), done.stderr
            assert place in done.stderr and says in done.stderr
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{free_port()}")
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")
    done = main("diagnose", "s3://archive/a/1.mcap", "--structure", archive / "frame.toml", "--out", archive / "out")
    assert (done.returncode, "cannot be read" in done.stderr, "Traceback" in done.stderr) == (66, True, False)


def test_an_object_is_diagnosed(archive: Path, main: Cli) -> None:
    verdicts = []
    for place in ("s3://archive/a", archive / "a"):
        both = [f"{place}/{k}.mcap" for k in (1, 2)]
        done = main("diagnose", *both, "--structure", archive / "frame.toml", "--out", archive / "out", "--json")
        assert done.returncode == 0, done.stderr
        verdicts.append({k: v for k, v in json.loads(done.stdout).items() if k != "seconds"})
    assert verdicts[0] == verdicts[1] and verdicts[0]["tried"]
