"""Every command that takes loggers' files, and the library, have all options by which they are read."""

from __future__ import annotations

from dataclasses import fields
from inspect import signature
from pathlib import Path

import numpy as np
import pytest
import shm_monitor as shm
from typer.testing import CliRunner

from monitor.cli.app import app
from monitor.cli.reader_options import reader_options
from monitor.runs import Options

SHARED = {f"--{name}" for name in signature(reader_options).parameters}
OF_TIMES = {"--time", "--timezone", "--start"}
"""What a table of features needs: it has neither waveforms nor a rate."""


def options_of(command: str) -> set[str]:
    from typer.main import get_command

    return {text for each in get_command(app).commands[command].params for text in each.opts}


@pytest.mark.parametrize("command", ["import", "look", "compare", "replay", "features"])
def test_a_command_that_takes_loggers_files_has_every_option_of_the_readers(command: str) -> None:
    assert (OF_TIMES if command == "features" else SHARED) <= options_of(command)


def test_every_field_of_the_readers_options_is_an_option_and_an_argument_of_the_library() -> None:
    names = {field.name for field in fields(Options)} - {"unknown_start_ns"}
    assert set(Options(**dict.fromkeys(names, "stated")).given()) == SHARED  # type: ignore[arg-type]
    assert names - {"align"} == set(signature(shm.read).parameters) - {"file"}  # which shifts several files


def counts(path: Path) -> Path:
    rng = np.random.default_rng(0)
    rows = "".join(
        f"{k / 50:.2f} {a:.0f} {b:.0f} 7\n" for k, (a, b) in enumerate(1000 * rng.standard_normal((3000, 2)))
    )
    path.write_text("since top [counts] low [counts] wind [m/s]\n" + rows)
    return path


def test_one_file_of_counts_is_read_by_all_alike(tmp_path: Path) -> None:
    path, run = counts(tmp_path / "a.txt"), CliRunner().invoke
    said = [
        "--scale",
        "0.001",
        "--time",
        "since",
        "--channel",
        "roof=top",
        "--channel",
        "low=low",
        "--start",
        "2026-01-01",
    ]
    looked = run(app, ["look", str(path), *said])
    assert looked.exit_code == 0 and "roof" in looked.stdout and "from 2026-01-01T00:00:00 UTC" in looked.stdout
    compared = run(app, ["compare", str(path), str(path), *said])
    assert compared.exit_code == 0, compared.output
    read = shm.read(
        path,
        scale=0.001,
        time="since",
        channels={"roof": "top", "low": "low"},
        covariates={"wind": "wind"},
        start_ns=10**18,
    )
    assert (read.channels, read.start_ns, read.rate_hz) == (("roof", "low"), 10**18, 50.0)
    assert read.samples.std() == pytest.approx(1.0, rel=0.05) and read.covariates["wind"][:3].tolist() == [[7.0]] * 3


def test_options_of_files_are_refused_for_what_states_them_itself(tmp_path: Path) -> None:
    run, path, out = CliRunner().invoke, counts(tmp_path / "a.txt"), tmp_path / "a.mcap"
    assert run(app, ["import", str(path), "--scale", "0.001", "--time", "since", "--out", str(out)]).exit_code == 0
    found = run(app, ["look", str(out), "--scale", "2", "--start", "2026-01-01"])
    assert "leave --start, --scale out" in str(found.exception)
    found = run(app, ["compare", str(tmp_path), str(tmp_path), "--unit", "g"])
    assert "is a folder of results: leave --unit out" in str(found.exception)
