"""One effect is one file: outside of `monitor/model/effects` no module names a concrete effect."""

from __future__ import annotations

import ast
from collections.abc import Callable
from pathlib import Path
from typing import Any

from monitor.model import FORMS
from tests.contracts.effect_cases import CASES, parse

PACKAGE = Path(__file__).parents[2] / "monitor"
EFFECTS_DIRECTORY = PACKAGE / "model" / "effects"
CLASSES = {kind.__name__ for kind in FORMS.values()} | {type(parse(text)[0]).__name__ for text in CASES}
NAMED = CLASSES | set(FORMS)
WORDS: dict[type, Callable[[Any], object]] = {
    ast.Name: lambda n: n.id,
    ast.Attribute: lambda n: n.attr,
    ast.alias: lambda n: n.name.rpartition(".")[2],
    ast.ImportFrom: lambda n: (n.module or "").rpartition(".")[2],
    ast.Constant: lambda n: n.value,
}
"""What a node of code names, if it names something."""
MODULES = [path for path in sorted(PACKAGE.rglob("*.py*")) if path.suffix in (".py", ".pyi")]
OUTSIDE = [path for path in MODULES if EFFECTS_DIRECTORY not in path.parents]


def named_effects(source: str) -> list[str]:
    """List the concrete effects that a module's code names, by class or by the name in files; comments and texts may."""
    found = []
    for node in ast.walk(ast.parse(source)):
        word = WORDS.get(type(node), lambda n: None)(node)
        if isinstance(word, str) and word in NAMED:
            found.append(f"line {getattr(node, 'lineno', '?')}: {word}")
    return found


def test_the_search_finds_what_it_looks_for() -> None:
    kind = next(iter(FORMS.values()))
    for source in (
        f"from monitor.model.effects import {kind.__name__}",
        f"from monitor.model.effects.{kind.name} import anything",
        f"found = isinstance(effect, effects.{kind.__name__})",
        f"found = effect.name == {kind.name!r}",
        f"match name:\n    case {kind.name!r}:\n        found = True",
    ):
        assert named_effects(source), source
    assert not named_effects(f'"""Look for {kind.name}."""')


def test_no_module_outside_names_an_effect() -> None:
    assert len(OUTSIDE) > 100
    found = {str(path.relative_to(PACKAGE)): named_effects(path.read_text(encoding="utf-8")) for path in OUTSIDE}
    assert {path: named for path, named in found.items() if named} == {}
