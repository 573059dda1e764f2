"""A room grows by decision: its budget of lines stands in pyproject.toml."""

from __future__ import annotations

import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def lines(place: Path) -> int:
    return sum(
        len(file.read_text(encoding="utf-8").splitlines())
        for file in ([place] if place.is_file() else place.rglob("*.py"))
    )


def test_no_room_is_larger_than_its_budget_and_each_has_one() -> None:
    budgets = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["rooms"]
    rooms = [p for p in (ROOT / "monitor").iterdir() if p.is_dir() and any(p.rglob("*.py"))]
    sizes = {p.stem: lines(p) for p in (*rooms, ROOT / "monitor/pipeline.py", ROOT / "drivers")}
    assert sizes.keys() == budgets.keys()
    assert {room: (size, budgets[room]) for room, size in sizes.items() if size > budgets[room]} == {}
