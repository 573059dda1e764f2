"""What docs/security.md promises of the source tree."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SOURCES = sorted([*(ROOT / "monitor").rglob("*.py"), *(ROOT / "drivers").rglob("*.py")])
FORBIDDEN = {"eval", "exec", "compile", "__import__", "breakpoint"}
MODULES = {"pickle", "marshal", "shelve", "dill", "cloudpickle", "joblib", "xml", "telnetlib", "ftplib", "yaml"}


def _name(node: ast.expr) -> str:
    if isinstance(node, ast.Name):
        return node.id
    return f"{_name(node.value)}.{node.attr}" if isinstance(node, ast.Attribute) else ""


def problems(tree: ast.AST) -> list[str]:
    """Calls and imports by which data could become code."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else [node.module or ""]
            found += [f"import {n}" for n in names if n.split(".")[0] in MODULES]
        if not isinstance(node, ast.Call):
            continue
        name = _name(node.func)
        if name in FORBIDDEN or name in {"os.system", "os.popen", "subprocess.getoutput", "tempfile.mktemp"}:
            found.append(name)
        flags = {k.arg: k.value for k in node.keywords}
        for flag in ("shell", "allow_pickle"):
            value = flags.get(flag)
            if value is not None and not (isinstance(value, ast.Constant) and value.value is False):
                found.append(f"{name}({flag}=...)")
        if name in ("np.load", "numpy.load") and "allow_pickle" not in flags:
            found.append(f"{name} without allow_pickle=False")
    return found


def test_data_never_become_code() -> None:
    assert len(SOURCES) > 100
    found = {str(path): problems(ast.parse(path.read_text(encoding="utf-8"))) for path in SOURCES}
    assert not {path: what for path, what in found.items() if what}


def test_it_would_be_seen() -> None:
    for text in ("eval('1')", "import pickle", "subprocess.run('x', shell=True)", "np.load('x')", "os.system('x')"):
        assert problems(ast.parse(text)), text


@pytest.mark.parametrize("lock", ["requirements", "requirements-dev", "deploy/requirements"])
def test_what_is_installed_is_pinned_by_hash_and_named_by_no_address(lock: str) -> None:
    """An audit against published faults needs the network and is the operator's (docs/security.md); this does not."""
    text = (ROOT / f"{lock}.txt").read_text()
    assert "://" not in text and not re.search(r"^\s*-(?!-hash)", text, re.MULTILINE)
    pinned = re.split(r"\n(?=[A-Za-z0-9])", text.strip())
    for block in pinned:
        assert re.match(r"[A-Za-z0-9_.\-\[\]]+==\S+", block) and "--hash=sha256:" in block, block[:80]
    names = {re.match(r"[A-Za-z0-9_.\-]+", block)[0].lower().replace("_", "-") for block in pinned}  # type: ignore[index]
    asked = re.findall(r"^([A-Za-z0-9][A-Za-z0-9_.\-]*)", (ROOT / f"{lock}.in").read_text(), re.MULTILINE)
    assert {n.lower().replace("_", "-") for n in asked} <= names


def test_installed_packages_fit_together() -> None:
    done = subprocess.run([sys.executable, "-m", "pip", "check"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
