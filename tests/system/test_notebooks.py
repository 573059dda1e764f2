"""The notebooks run, hold what they say, and are stored without output."""

from __future__ import annotations

import sys
from pathlib import Path

import nbformat
import pytest

from tests.support.commands import ended

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "docs/notebooks").glob("*.ipynb"))
_RUN = """
import sys, nbformat
from nbclient import NotebookClient
NotebookClient(nbformat.read(sys.argv[1], as_version=4), timeout=600, kernel_name="python3").execute()
"""


def test_there_are_three() -> None:
    assert [path.stem for path in NOTEBOOKS] == ["csv_to_cause", "own_effect", "paper"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_a_notebook_is_stored_without_output(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    for cell in notebook.cells:
        assert not cell.get("outputs") and cell.get("execution_count") is None


@pytest.mark.docs
@pytest.mark.timeout(600)
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_a_notebook_runs(path: Path, tmp_path: Path) -> None:
    """In a kernel of its own; its assertions are what it claims."""
    (tmp_path / "recordings").symlink_to(ROOT / "recordings")
    places = f"{ROOT}:{ROOT / 'monitor/api/installed'}"
    environment = {"PYTHONPATH": places, "OPENBLAS_NUM_THREADS": "1", "MPLBACKEND": "agg"}
    done = ended(sys.executable, "-c", _RUN, path, cwd=tmp_path, **environment)
    assert done.returncode == 0, done.stderr[-3000:]
