"""A number that was chosen says what it means, in which unit, and where it comes from; docs/constants.md lists them all."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
SCRIPT: dict[str, Any] = runpy.run_path(str(ROOT / "docs/constants.py"))
ALL = [constant for room in SCRIPT["ROOMS"] for constant in SCRIPT["constants"](room)]


def test_a_constant_says_meaning_unit_and_origin() -> None:
    assert len(ALL) > 100
    assert [f"{c.module}:{c.name}" for c in ALL if not all(c.parts())] == []
    several = [f"{c.module}:{c.name}" for c in ALL if ", " in c.name]
    assert several == [], "one constant a statement, so that each has a docstring of its own"


def test_no_name_has_two_values() -> None:
    places: dict[str, set[str]] = {}
    for constant in ALL:
        places.setdefault(constant.name, set()).add(constant.module)
    assert {name: where for name, where in places.items() if len(where) > 1} == {}


def test_the_page_is_up_to_date() -> None:
    assert SCRIPT["page"]() == (ROOT / "docs/constants.md").read_text(encoding="utf-8"), "run docs/constants.py"
