"""The command for features: what it writes, and what it says of a table that is not as it should be."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.support.samples import Cli

ROWS = 400


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rng = np.random.default_rng(3)
    degc = 10.0 + 8.0 * np.sin(np.arange(ROWS) / 20.0)
    hz = 4.0 * np.exp(-0.001 * degc + 0.002 * rng.standard_normal(ROWS))
    hz[350:] *= 0.97
    lines = ["time,f1,temperature"]
    lines += [f"{1_700_000_000 + 3600 * k},{f:.6f},{t:.3f}" for k, (f, t) in enumerate(zip(hz, degc, strict=True))]
    lines[20], lines[21], lines[22] = "1700068400,,10.0", "yesterday,4.0,10.0", "1700075600,4.0"
    path = tmp_path_factory.mktemp("features") / "f.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def call(main: Cli, table: Path, out: Path, **changed: str):
    options = {"time": "time", "features": "f1", "covariates": "temperature", "train-until": "2023-11-23T00:00:00"}
    options |= changed
    return main("features", table, *[x for k, v in options.items() for x in (f"--{k}", v)], "--out", out, "--json")


def test_a_table_is_judged_and_bad_rows_are_told_by_line(table: Path, main: Cli, tmp_path: Path) -> None:
    done = call(main, table, tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert "line 22: " in done.stderr and "line 23: 2 fields of 3" in done.stderr and "line 21" not in done.stderr
    lines = [json.loads(line) for line in (tmp_path / "out/results.jsonl").read_text().splitlines()]
    summary = json.loads((tmp_path / "out/summary.json").read_text())
    assert json.loads(done.stdout) == {**summary, "out": str(tmp_path / "out")}
    assert list(lines[0]) == ["t_end_ns", "residual_sigma", "alarm", "skipped"]
    assert list(lines[0]["alarm"]) == ["level", "features", "reason"]
    assert lines[-1]["alarm"]["level"] == "warning" and lines[-1]["alarm"]["features"] == ["f1"]
    first = next(line["t_end_ns"] for line in lines if line["alarm"]["level"] != "normal")
    assert first * 1e-9 >= 1_700_000_000 + 3600 * 350
    assert summary["features"][0]["variance_explained"] > 0.5


@pytest.mark.parametrize(
    ("changed", "code", "words"),
    [
        ({"features": "f9"}, 65, "no column f9; the columns are time, f1, temperature"),
        ({"train-until": "2023-11-15T00:00:00"}, 65, "healthy readings"),
        ({"train-until": "2033-01-01T00:00:00"}, 65, "nothing to judge"),
        ({"train-until": "soon"}, 2, "--train-until"),
        ({"features": ","}, 2, "at least one column"),
    ],
)
def test_what_cannot_be_done_is_said(
    table: Path, main: Cli, tmp_path: Path, changed: dict[str, str], code: int, words: str
) -> None:
    done = call(main, table, tmp_path / "out", **changed)
    assert done.returncode == code
    assert words in done.stderr.replace("\n", " ")
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("content", "code"), [(None, 66), (b"\xff\xfe\x00", 65), (b"", 65), (b"time,f1,temperature\n", 65)]
)
def test_what_is_no_table_is_refused(main: Cli, tmp_path: Path, content: bytes | None, code: int) -> None:
    path = tmp_path / "x.csv"
    if content is not None:
        path.write_bytes(content)
    done = call(main, path, tmp_path / "out")
    assert (done.returncode, "Traceback" in done.stderr) == (code, False)
    assert "x.csv" in done.stderr
