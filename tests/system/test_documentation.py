"""Every command of the documentation is run, or where it is heavy or needs a device, read by the real command line.

A ``sh`` block of a page runs in a folder of its own for that page, after the page's earlier blocks, with the repository's
`recordings` and `deploy` in it.  A comment before a block changes that:

``<!-- not run: WHY -->``      its commands are only parsed;
``<!-- slow: WHY -->``         it, and what follows on its page, runs with ``-m slow`` only;
``<!-- first: COMMANDS -->``   what a reader is taken to have already.

``python`` blocks must compile, and ``toml`` blocks must be TOML; links must lead somewhere.
"""

from __future__ import annotations

import os
import re
import runpy
import shlex
import shutil
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

import pytest

from monitor.cli import command_line
from tests.support.commands import ended

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), ROOT / "recordings/README.md"], key=lambda p: p.as_posix()
)
COMMANDS = command_line().commands
_BLOCK = re.compile(
    r"(?:<!-- (?P<mark>not run|slow|first): (?P<why>[^\n]*?) -->\n)?^```(?P<kind>\w*)\n(?P<text>.*?)^```$",
    re.DOTALL | re.MULTILINE,
)
_PROGRAM = re.compile(r"(?:^|[;&|(\s])(?:\.venv/bin/)?shm-monitor\s+(?P<rest>[^\n]*)")


@dataclass(frozen=True)
class Block:
    kind: str
    text: str
    mark: str
    why: str


def blocks(page: Path) -> list[Block]:
    found = _BLOCK.finditer(page.read_text(encoding="utf-8"))
    return [Block(b["kind"], b["text"], b["mark"] or "", b["why"] or "") for b in found]


def commands(text: str) -> list[list[str]]:
    """Arguments of every call of our program in a script."""
    joined = text.replace("\\\n", " ")
    out = []
    for match in _PROGRAM.finditer(joined):
        words = shlex.split(match["rest"].strip("` "), comments=True)
        stops = [i for i, w in enumerate(words) if w in ("&", "|", "||", "&&", ";", ">", "2>&1")]
        out.append(words[: min(stops, default=len(words))])
    return out


def parse(arguments: list[str]) -> None:
    """Read a command line as the program does, without running it."""
    name, *rest = arguments
    assert name in COMMANDS, f"no command {name!r}"
    if "--help" not in rest:
        COMMANDS[name].make_context(name, rest)


def programs(folder: Path) -> dict[str, str]:
    """An environment in which the documentation's names of programs mean this source tree."""
    places = folder / ".venv" / "bin"
    places.mkdir(parents=True)
    starts = f'#!/bin/sh\nexec "{sys.executable}" '
    for name, call in (("shm-monitor", '-m monitor "$@"'), ("python", '"$@"')):
        (places / name).write_text(starts + call + "\n")
        (places / name).chmod(0o755)
    path = f"{places}:{Path(sys.executable).parent}:{os.environ['PATH']}"
    return {
        **os.environ,
        "PATH": path,
        "PYTHONPATH": f"{ROOT}:{ROOT / 'monitor/api/installed'}",
        "OPENBLAS_NUM_THREADS": "1",
    }


RUN = [p for p in PAGES if any(b.kind == "sh" and b.mark != "not run" for b in blocks(p))]
SLOW = [p for p in RUN if any(b.mark == "slow" for b in blocks(p))]


def run(page: Path, folder: Path, *, slow: bool) -> None:
    for name in ("recordings", "docs", "tests"):
        (folder / name).symlink_to(ROOT / name)
    shutil.copytree(ROOT / "deploy", folder / "deploy")  # results go beside it
    site = folder / "deploy/mcap.toml"
    site.write_text(
        site.read_text().replace("speed = 100.0", "speed = 2000.0")
    )  # several pages run it, for ten seconds each
    environment = programs(folder)
    for block in blocks(page):
        if block.mark == "slow" and not slow:
            return
        if block.kind != "sh" or block.mark == "not run":
            continue
        script = "\n".join(["set -euo pipefail", block.why if block.mark == "first" else "", block.text])
        done = ended("bash", "-c", script, cwd=folder, timeout_s=900.0, **environment)
        assert done.returncode == 0, f"{page.name}:\n{block.text}\n{done.stdout[-2000:]}\n{done.stderr[-3000:]}"
        assert "Traceback" not in done.stderr


@pytest.mark.docs
@pytest.mark.parametrize(
    "page",
    [pytest.param(p, marks=pytest.mark.representative if p.stem == "viewing" else ()) for p in RUN],
    ids=[p.stem for p in RUN],
)
def test_the_commands_of_a_page_run(page: Path, tmp_path: Path) -> None:
    run(page, tmp_path, slow=False)


@pytest.mark.slow
@pytest.mark.parametrize("page", SLOW, ids=lambda p: p.stem)
def test_the_slow_commands_of_a_page_run(page: Path, tmp_path: Path) -> None:
    run(page, tmp_path, slow=True)


each_page = pytest.mark.parametrize("page", PAGES, ids=lambda p: f"{p.parent.name}-{p.stem}")


@each_page
def test_the_command_line_knows_every_command(page: Path) -> None:
    """In blocks that run or not, and in the running text."""
    text = page.read_text(encoding="utf-8")
    inline = [words for code in re.findall(r"`(shm-monitor [^`]+)`", text) for words in commands(code)]
    for words in inline:
        assert words[0] in COMMANDS or words[0].startswith("-"), words
    for block in blocks(page):
        if block.kind in ("sh", "text", ""):
            for words in commands(block.text):
                parse(words)


@each_page
def test_code_compiles_and_links_lead_somewhere(page: Path) -> None:
    for block in blocks(page):
        if block.kind == "python":
            compile(block.text, str(page), "exec")
        if block.kind == "toml":
            tomllib.loads(block.text)
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if "://" not in target:
            assert (page.parent / target.partition("#")[0]).exists(), target


def test_a_wrong_option_would_be_seen() -> None:
    for wrong in (["replay", "a.mcap", "--structur", "s.toml", "--out", "o"], ["replai"], ["calibrate", "a.mcap"]):
        with pytest.raises(Exception, match=r"(?i)no such option|no command|missing"):
            parse(wrong)


def test_every_page_is_on_the_map() -> None:
    index = (ROOT / "docs/index.md").read_text(encoding="utf-8")
    for page in (ROOT / "docs").glob("*.md"):
        assert page.name == "index.md" or f"({page.name})" in index, page.name


def test_the_tests_of_the_page_of_faults_are_there() -> None:
    """Each in the file that its cell links before it."""
    text = (ROOT / "docs/faults.md").read_text(encoding="utf-8")
    named = re.findall(r"\]\(\.\./(tests/\w+/test_\w+\.py)\): ((?:`test_\w+`(?:, )?)+)", text)
    assert sum(names.count("`") for _, names in named) == 2 * text.count("`test_") > 80
    for file, names in named:
        there = set(re.findall(r"^def (test_\w+)", (ROOT / file).read_text(encoding="utf-8"), re.MULTILINE))
        assert set(re.findall(r"`(test_\w+)`", names)) <= there, file


API = ROOT / "docs/api.py"


def api_reference(folder: Path, *names: str) -> set[str]:
    """Pages that are made, each with its module's docstring."""
    pytest.importorskip("pdoc")
    done = ended(sys.executable, API, folder, *names, cwd=folder, timeout_s=240.0, PYTHONPATH=str(ROOT))
    assert done.returncode == 0, done.stderr[-2000:]
    assert "Hankel" in (folder / "monitor/identification/ssi.html").read_text(encoding="utf-8")
    return {path.relative_to(folder).with_suffix("").as_posix() for path in folder.rglob("*.html")}


@pytest.mark.docs
def test_the_api_reference_is_made(tmp_path: Path) -> None:
    """Of some modules, and every module is one of those of which the whole is made."""
    found = api_reference(tmp_path, "monitor.identification.ssi", "monitor.service", "drivers.base")
    assert {"monitor/identification/ssi", "monitor/service", "drivers/base"} <= found
    every = {f.relative_to(ROOT).with_suffix("") for n in ("monitor", "drivers") for f in (ROOT / n).rglob("*.py")}
    told = {name.replace(".", "/") for name in runpy.run_path(str(API))["modules"]()}
    assert {path.as_posix() for path in every if path.stem not in ("__init__", "__main__")} < told


@pytest.mark.slow
def test_the_whole_api_reference_is_made(tmp_path: Path) -> None:
    """A page for every module."""
    found = api_reference(tmp_path)
    assert {name.replace(".", "/") for name in runpy.run_path(str(API))["modules"]()} <= found
