"""docs/constants.py: writes docs/constants.md, the constants that were chosen, room by room, from the code."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

PAGE = Path(__file__).with_suffix(".md")
ROOT = PAGE.parents[1]
ROOMS = ("signals", "model", "identification", "inference", "damage", "diagnosis", "events")
"""Rooms of the engine, in the order of the data's way."""
_HEAD = """# Constants

Each number in the engine that no setting changes: what it means, its unit, and where its value comes from. *Judgement* is
a value that an engineer chose and no measurement supports; *not recorded* is one whose reason is lost. *Cost* bounds time
or memory, *rounding* is a tolerance of the arithmetic, *definition* is no choice. Settings are in [settings](settings.md).

(Written by `.venv/bin/python docs/constants.py` from the code; a test sees that it is up to date.)
"""
_SAYS = re.compile(r"(?P<meaning>.*) \[(?P<unit>[^;\]]+); (?P<origin>[^\]]+)\]", re.DOTALL)


class Constant(NamedTuple):
    """A number that stands at the top of a module."""

    module: str
    name: str
    value: str
    says: str
    """Its docstring: ``Meaning. [unit; origin]``."""

    def parts(self) -> tuple[str, str, str]:
        """Return meaning, unit and origin.

        Raises
        ------
        ValueError
            If the docstring does not have the form.
        """
        found = _SAYS.fullmatch(" ".join(self.says.split()))
        if found is None:
            raise ValueError(f"{self.module}: {self.name} needs a docstring 'Meaning. [unit; origin]'")
        return found["meaning"], found["unit"], found["origin"]


def constants(room: str) -> Iterator[Constant]:
    """Find the numbers in upper case at the top of the modules of a room."""
    for file in sorted((ROOT / "monitor" / room).rglob("*.py")):
        body = ast.parse(file.read_text(encoding="utf-8")).body
        module = ".".join(file.relative_to(ROOT).with_suffix("").parts)
        for statement, after in zip(body, [*body[1:], None], strict=True):
            if not isinstance(statement, ast.Assign | ast.AnnAssign) or statement.value is None:
                continue
            targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
            names = [n.id for t in targets for n in ast.walk(t) if isinstance(n, ast.Name)]
            if isinstance(targets[0], ast.Tuple) and isinstance(statement.value, ast.Call):
                continue  # nodes and weights of an integration
            if not all(name == name.upper() and name.strip("_") for name in names) or not _is_number(statement.value):
                continue
            says = ""
            if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
                says = str(after.value.value)
            yield Constant(module, ", ".join(names), ast.unparse(statement.value), says)


def _is_number(value: ast.expr) -> bool:
    """Say whether an expression is a number or a tuple of numbers."""
    parts = list(ast.walk(value))
    numbers = [p for p in parts if isinstance(p, ast.Constant)]
    allowed = (
        ast.Constant,
        ast.BinOp,
        ast.UnaryOp,
        ast.Tuple,
        ast.operator,
        ast.unaryop,
        ast.expr_context,
        ast.Attribute,
    )
    called = (ast.Call, ast.Name)  # a logarithm, say
    return bool(numbers) and all(
        isinstance(p, (*allowed, *called)) and (not isinstance(p, ast.Constant) or type(p.value) in (int, float))
        for p in parts
    )


def page() -> str:
    """Return the page."""
    out = [_HEAD]
    for room in ROOMS:
        rows = [(c, *c.parts()) for c in constants(room)]
        out += [
            f"## {room}: {len(rows)}",
            "",
            "| where | name | value | unit | meaning | origin |",
            "|---|---|---|---|---|---|",
        ]
        for c, meaning, unit, origin in rows:
            out.append(
                f"| `{c.module.removeprefix('monitor.')}` | `{c.name}` | `{c.value}` | {unit} | {meaning} | {origin} |"
            )
        out.append("")
    return "\n".join(out)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
