"""Rooms use each other by their faces only: what a room's ``__init__.pyi`` exports, no more and no less."""

from __future__ import annotations

import ast
import importlib
import inspect
from dataclasses import FrozenInstanceError, fields, is_dataclass
from functools import cache
from pathlib import Path
from types import FunctionType

import pytest

PACKAGE = Path(__file__).parents[2] / "monitor"
SOURCES = sorted([*PACKAGE.rglob("*.py"), *PACKAGE.rglob("*.pyi")])
STUBS = {path.parent.name: path for path in sorted(PACKAGE.glob("*/__init__.pyi"))}
TESTS = PACKAGE.parent / "tests"
WITHOUT_STUB = {"cli": {"main", "command_line"}, "pipeline": None}
"""What else may be imported from: the command line's entry, and the pipeline, which is one module and has no face."""
INSIDE = {
    "benchmarks/hops.py": "makes a state that nobody has learned, in other checkouts too, whose tests may lack a maker",
    "benchmarks/windows.py": "times the kernels of a hop bare",
    "examples/opensees_frame.py": "stands for a file of monitor/model/structures",
}
"""Tests outside the room's folder that may use its inner parts -> why."""

STAGES = ("core", "signals", "model", "inference", "identification", "events", "diagnosis", "damage")

FOR_USERS = {"api"}
"""Rooms whose face other people's programs use; tests/api/test_library.py uses each of its names."""

Import = tuple[str, str]
"""Module and name."""


@cache
def imports(path: Path) -> list[Import]:
    """List the names of this package that a file imports, with relative modules written out."""
    package = path.relative_to(PACKAGE.parent).parent.parts
    found: list[Import] = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [(alias.name, "") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = ".".join(package[: len(package) + 1 - node.level]) if node.level else ""
            module = ".".join(part for part in (above, node.module) if part)
            found += [(module, alias.name) for alias in node.names]
    return [(module, name) for module, name in found if module.partition(".")[0] == "monitor"]


def room_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


@cache
def exported(room: str) -> list[str]:
    """List the names that a face offers, as its stub spells them."""
    return [name for _, name in imports(STUBS[room])]


def from_elsewhere(path: Path) -> list[Import]:
    """List a file's imports from other rooms."""
    return [
        (module, name)
        for module, name in imports(path)
        if module != "monitor" and module.split(".")[1] != room_of(path)
    ]


def beside_the_face(module: str, name: str) -> bool:
    room = module.removeprefix("monitor.")
    if room in STUBS:
        return name not in exported(room)
    names = WITHOUT_STUB.get(room, set())
    return names is not None and name not in names


def test_every_room_has_a_face() -> None:
    rooms = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    assert rooms == set(STUBS) | {"cli"}


def test_other_rooms_are_used_by_their_faces() -> None:
    assert len(SOURCES) > 100
    elsewhere = [(path, *found) for path in SOURCES for found in from_elsewhere(path)]
    assert [f"{path}: {module}: {name}" for path, module, name in elsewhere if beside_the_face(module, name)] == []
    whole = {(str(path), name) for path in SOURCES for module, name in imports(path) if module == "monitor"}
    assert {place for place in whole if place[1] != "__version__"} == set()


@pytest.mark.parametrize("room", STUBS)
def test_a_face_is_what_its_stub_says(room: str) -> None:
    names = exported(room)
    module = importlib.import_module(f"monitor.{room}")
    assert len(set(names)) == len(names)
    assert sorted(module.__all__) == sorted(names)
    for source, name in imports(STUBS[room]):
        assert source == f"monitor.{room}" or source.startswith(f"monitor.{room}."), f"{name} is another room's"
        defined = importlib.import_module(f"{source}.{name}") if source == f"monitor.{room}" else None
        found = getattr(module, name)
        assert found is (defined or getattr(importlib.import_module(source), name))


@pytest.mark.parametrize("room", STAGES)
def test_no_field_of_what_a_stage_shows_others_can_be_set(room: str) -> None:
    module = importlib.import_module(f"monitor.{room}")
    shown = [getattr(module, name) for name in exported(room)]
    kinds = [found for found in shown if isinstance(found, type) and is_dataclass(found) and fields(found)]
    assert kinds
    for kind in kinds:
        if inspect.isabstract(kind):
            continue
        with pytest.raises(FrozenInstanceError):
            setattr(object.__new__(kind), fields(kind)[0].name, None)


@pytest.mark.parametrize("room", STUBS)
def test_functions_of_a_face_are_typed(room: str) -> None:
    module = importlib.import_module(f"monitor.{room}")
    for name in exported(room):
        function = getattr(module, name)
        if isinstance(function, FunctionType):
            signature = inspect.signature(function)
            kinds = [signature.return_annotation, *(p.annotation for p in signature.parameters.values())]
            assert inspect.Signature.empty not in kinds, name


def test_tests_of_other_folders_use_a_room_by_its_face() -> None:
    beside = set()
    for path in TESTS.rglob("*.py"):
        place = path.relative_to(TESTS)
        own = f"monitor.{place.parts[0].removeprefix('test_').removesuffix('.py')}"
        for module, name in imports(path):
            if "." in module and not f"{module}.".startswith(f"{own}.") and beside_the_face(module, name):
                beside.add(str(place))
    assert beside == set(INSIDE)


def test_a_face_has_nothing_that_no_other_room_uses() -> None:
    used = {found for path in SOURCES for found in from_elsewhere(path)}
    idle = [
        f"monitor.{room}: {name}"
        for room in STUBS.keys() - FOR_USERS
        for name in exported(room)
        if (f"monitor.{room}", name) not in used
    ]
    assert not idle


@pytest.mark.parametrize("room", STUBS)
def test_no_name_of_a_face_is_a_submodule_too(room: str) -> None:
    """Such a name would be the module or the object, whichever was imported last."""
    modules = {path.stem for path in STUBS[room].parent.iterdir() if path.suffix == ".py" or path.is_dir()}
    names = {
        alias.name
        for node in ast.parse(STUBS[room].read_text(encoding="utf-8")).body
        if isinstance(node, ast.ImportFrom) and node.module
        for alias in node.names
    }
    assert not names & modules
