"""The browser of the machine, driven from tests."""

from __future__ import annotations

from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).parents[2]


def browser_tool() -> ModuleType:
    spec = spec_from_file_location("browser", ROOT / "docs/browser.py")
    tool = module_from_spec(spec)
    spec.loader.exec_module(tool)
    return tool
