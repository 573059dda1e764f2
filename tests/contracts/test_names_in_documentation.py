"""Every module, class, function and path of this repository that the documentation names exists."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    [*(ROOT / name for name in ("README.md", "ARCHITECTURE.md", "CONTRIBUTING.md")), *(ROOT / "docs").rglob("*.md")]
)
MAP = ROOT / "ARCHITECTURE.md"
ROOMS = sorted(p.parent.name for p in (ROOT / "monitor").glob("*/__init__.py"))
_PATH = re.compile(r"(?<![\w./-])(?:monitor|drivers|tests|deploy)/[\w./<>-]*")
_DOTTED = re.compile(r"(?<![\w./-])(?:monitor|drivers)\.[\w.]*\w")
_IN_ROOM = re.compile(rf"(?<![\w./-])(?:{'|'.join([*ROOMS, 'pipeline'])})\.[a-z_A-Z][\w.]*\w")
_CLASS = re.compile(r"`([A-Z][a-z]+[A-Za-z]*[a-z](?:\.[a-z_]+)?)(?:\([\w, ]*\))?`")
_SUFFIXES = (".py", ".toml", ".json", ".md", ".html", ".mcap", ".rrd")


def resolve(name: str) -> None:
    """Import the longest module of a dotted name, then take its attributes."""
    parts = name.split(".")
    for n in range(len(parts), 0, -1):
        try:
            found: object = import_module(".".join(parts[:n]))
        except ModuleNotFoundError as error:
            if error.name is None or not name.startswith(error.name):
                raise
            continue
        for attribute in parts[n:]:
            found = getattr(found, attribute)
        return
    raise ModuleNotFoundError(name)


def paths(text: str) -> list[str]:
    """Paths of this repository; of one with a placeholder, the folder."""
    found = (m.group().rstrip(".") for m in _PATH.finditer(text))
    return [p.partition("<")[0].rpartition("/")[0] if "<" in p else p for p in found]


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_what_a_page_names_exists(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    missing = [p for p in paths(text) if not (ROOT / p).exists()]
    for name in _DOTTED.findall(text):
        if not name.endswith(_SUFFIXES):
            try:
                resolve(name)
            except (ModuleNotFoundError, AttributeError):
                missing.append(name)
    assert not missing


def test_what_the_map_calls_by_its_room_exists() -> None:
    """Names as `damage.alarm` in ARCHITECTURE.md, and the classes that it names alone."""
    text = MAP.read_text(encoding="utf-8")
    for name in _IN_ROOM.findall(text):
        if not name.endswith(_SUFFIXES):
            resolve(f"monitor.{name}")
    source = "\n".join(p.read_text(encoding="utf-8") for d in ("monitor", "drivers") for p in (ROOT / d).rglob("*.py"))
    for name in _CLASS.findall(text):
        kind = name.partition(".")[0]
        assert re.search(rf"^(?:class {kind}\b|{kind}(?::| =))", source, re.MULTILINE), name


def test_the_map_has_every_room() -> None:
    """Each with its layer, as the contract in pyproject.toml orders them."""
    rows = re.findall(r"^\| (\d) \| `(\w+)(?:\.py)?` \|", MAP.read_text(encoding="utf-8"), re.MULTILINE)
    contract = re.search(r"^layers = \[(.*?)^\]", (ROOT / "pyproject.toml").read_text(encoding="utf-8"), re.S | re.M)
    layers = [sorted(re.findall(r"\w+", line)) for line in re.findall(r'"([^"]+)"', contract.group(1))]
    of_map: dict[int, list[str]] = {}
    for number, room in rows:
        of_map.setdefault(int(number), []).append(room)
    assert [sorted(of_map[n]) for n in sorted(of_map, reverse=True)] == layers


def test_a_name_that_is_none_would_be_seen() -> None:
    for wrong in ("monitor.damage.nothing", "monitor.nothing", "drivers.base.Nothing"):
        with pytest.raises((ModuleNotFoundError, AttributeError)):
            resolve(wrong)
    assert paths("see `monitor/model/effects/<name>.py`, tests/x.py.") == ["monitor/model/effects", "tests/x.py"]
