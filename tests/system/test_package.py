"""The distribution: wheel and sdist hold all that is needed, and the core does its work without any extra."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from importlib.metadata import distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from tests.support.commands import ended
from tests.support.frames import shear_frame_text

pytestmark = pytest.mark.system

ROOT = Path(__file__).parents[2]
RECORDINGS = ROOT / "recordings"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]

TWO_STORIES = shear_frame_text([1000.0, 1000.0], [2e6, 2e6])


def run(environment: Path, *arguments: str | Path, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run Python with the packages of a folder alone."""
    variables = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")}
    return subprocess.run(
        [sys.executable, "-S", *map(str, arguments)],
        env={**variables, "PYTHONPATH": str(environment), "OPENBLAS_NUM_THREADS": "1"},
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )


def link_core(place: Path) -> None:
    """Link into a folder the distributions that `dependencies` of pyproject.toml name, and those that they require."""
    place.mkdir()
    todo, done = [Requirement(line) for line in PROJECT["dependencies"]], set()
    while todo:
        one = todo.pop()
        name = re.sub(r"[-_.]+", "-", one.name).lower()
        if name in done or (one.marker is not None and not one.marker.evaluate({"extra": ""})):
            continue
        done.add(name)
        found = distribution(one.name)
        todo += [Requirement(line) for line in found.requires or ()]
        for top in {file.parts[0] for file in found.files or () if file.parts[0] not in ("..", "__pycache__")}:
            target = Path(str(found.locate_file(top)))
            if not (place / top).exists() and target.exists():
                (place / top).symlink_to(target)


@pytest.fixture(scope="module")
def core(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment of the core alone, on this source tree, whose compiled functions are kept."""
    place = tmp_path_factory.mktemp("core") / "packages"
    link_core(place)
    for name in ("monitor", "drivers"):
        (place / name).symlink_to(ROOT / name)
    (place / "shm_monitor").symlink_to(ROOT / "monitor/api/installed/shm_monitor")
    return place


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Wheel and sdist: the wheel is built from what the sdist holds."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("dist")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for name in ("monitor", "drivers"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    done = ended(sys.executable, "-m", "build", "--no-isolation", "--outdir", out, source, timeout_s=240.0)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return out


def test_wheel_and_sdist_hold_every_file_of_the_packages(built: Path) -> None:
    (wheel,) = built.glob("*.whl")
    (sdist,) = built.glob("*.tar.gz")
    here = {
        path.relative_to(ROOT).as_posix()
        for name in ("monitor", "drivers")
        for path in (ROOT / name).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    inside = set(zipfile.ZipFile(wheel).namelist())
    with tarfile.open(sdist) as archive:
        sent = {name.partition("/")[2] for name in archive.getnames()}
    installed = {name.removeprefix("monitor/api/installed/") for name in here}
    assert not installed - inside, "not in the wheel"
    assert not here - sent, "not in the sdist"
    assert not {name for name in inside - installed if ".dist-info/" not in name}
    assert wheel.stat().st_size < 2e6


def test_the_wheel_installs_and_its_library_and_commands_answer(built: Path, tmp_path: Path) -> None:
    (wheel,) = built.glob("*.whl")
    place = tmp_path / "packages"
    link_core(place)
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target", str(place)]
    done = ended(*command, wheel, timeout_s=120.0)
    assert done.returncode == 0, done.stderr
    assert run(place, "-m", "monitor", "--version", folder=tmp_path).stdout.strip() == PROJECT["version"]
    checked = run(place, "-m", "monitor", "check", RECORDINGS / "frame.toml", folder=tmp_path)
    assert "no problems" in checked.stdout, checked.stderr
    code = "import shm_monitor as shm; print(shm.__version__, shm.structure(masses_kg=[1], stiffness_n_per_m=[4e3]).channels)"
    asked = run(place, "-c", code, folder=tmp_path)
    assert asked.stdout.strip() == f"{PROJECT['version']} ('a1',)", asked.stderr


def test_the_core_replays_and_diagnoses_and_names_the_extra_that_it_lacks(core: Path, tmp_path: Path) -> None:
    frame = RECORDINGS / "mini-shake-table-flexible.mcap"
    (tmp_path / "out").mkdir()
    (tmp_path / "out/live.rrd").write_text("of an earlier run")
    options = (frame, "--structure", frame.with_suffix(".toml"), "--out")
    done = run(core, "-m", "monitor", "replay", *options, "out", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    says = "it needs the extra viewer: pip install 'shm-monitor[viewer]'"
    assert done.stderr.splitlines() == [f"warning: live.rrd is left out: {says}"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir() if path.is_file()) == [
        "events.jsonl", "results.jsonl", "results.mcap", "summary.json",
    ]  # fmt: skip
    assert json.loads((tmp_path / "out/summary.json").read_text())["windows"] == 9
    (tmp_path / "s.toml").write_text(TWO_STORIES)
    options = ("--structure", "s.toml", "--out")
    size = ("--duration", "80", "--rate", "100")
    made = run(core, "-m", "monitor", "simulate", *options, "r.mcap", *size, folder=tmp_path)
    assert made.returncode == 0, made.stderr
    found = run(core, "-m", "monitor", "diagnose", "r.mcap", *options, "diagnosis", folder=tmp_path)
    assert found.returncode == 0, found.stderr
    assert found.stderr.splitlines() == [f"warning: diagnosis.rrd is left out: {says}"]
    assert (tmp_path / "diagnosis/report.html").exists()
    assert not (tmp_path / "diagnosis/diagnosis.rrd").exists()


def test_a_command_or_a_site_that_needs_an_extra_names_it(core: Path, tmp_path: Path) -> None:
    site = (
        RECORDINGS / "frame.toml"
    ).read_text() + '\n[notify]\nurls = ["mailto://somebody@localhost"]\n[output]\nweb = "127.0.0.1:0"\n'
    (tmp_path / "site.toml").write_text(site)
    (tmp_path / "x.rrd").write_text("")
    for extra, code, arguments in (
        ("viewer", 78, ("view", "x.rrd")),
        ("archive", 78, ("reprocess", "*.mcap", "--structure", "site.toml", "--out", "out")),
        ("notify", 0, ("check", "site.toml")),
        ("web", 0, ("check", "site.toml")),
    ):
        done = run(core, "-m", "monitor", *arguments, folder=tmp_path)
        assert done.returncode == code, done.stderr
        assert done.stderr.count(f"needs the extra {extra}: pip install 'shm-monitor[{extra}]'") == 1, done.stderr
        assert "Traceback" not in done.stderr
