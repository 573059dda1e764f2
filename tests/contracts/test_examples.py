"""The examples in docstrings run and print what they say."""

import doctest
import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def _modules_with_examples() -> list[str]:
    files = [file for package in ("monitor", "drivers") for file in sorted((ROOT / package).rglob("*.py"))]
    return [
        ".".join(file.relative_to(ROOT).with_suffix("").parts) for file in files if ">>> " in file.read_text("utf-8")
    ]


DIAGNOSES = {"monitor.api.causes"}
"""Modules whose examples take seconds."""


@pytest.mark.parametrize(
    "module", [pytest.param(m, marks=[pytest.mark.engine] if m in DIAGNOSES else []) for m in _modules_with_examples()]
)
def test_the_examples_of_a_module_run(module: str) -> None:
    result = doctest.testmod(importlib.import_module(module), optionflags=doctest.NORMALIZE_WHITESPACE)
    assert result.attempted
    assert not result.failed, f"python -m doctest shows what differs: {module}"
