"""Campaigns go on where they were interrupted: no trial and no test that passed is done again for the same code."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.campaign import each, gone_on_with, words
from tests.support.reference import ROOT


def noted(folder: str, number: int) -> int:
    """A trial that leaves a note of each time that it is done, and is interrupted where a file says so."""
    if (Path(folder) / f"stop-{number}").exists():
        raise KeyboardInterrupt
    with (Path(folder) / "notes").open("a") as notes:
        notes.write(f"{number} ")
    return number**2


def test_a_kept_trial_is_done_once_and_an_interrupted_one_again(tmp_path: Path) -> None:
    tasks = [(str(tmp_path), number) for number in range(4)]
    (tmp_path / "stop-2").touch()
    with pytest.raises(KeyboardInterrupt):
        each(noted, tasks, keep=True)
    (tmp_path / "stop-2").unlink()
    assert each(noted, tasks, keep=True) == each(noted, tasks, keep=True) == [0, 1, 4, 9]
    assert (tmp_path / "notes").read_text() == "0 1 2 3 "
    assert each(noted, tasks[:2], 2) == [0, 1]
    assert len((tmp_path / "notes").read_text().split()) == 6


def test_a_file_of_results_is_gone_on_with(tmp_path: Path) -> None:
    file, made = tmp_path / "out" / "rows.jsonl", list[tuple[str, int]]()

    def trial(name: str, seed: int) -> dict[str, int]:
        made.append((name, seed))
        return {"found": 10 * seed}

    first = gone_on_with(file, ("name", "seed"), [("a", 1), ("b", 1)], trial)
    assert first == [{"name": "a", "seed": 1, "found": 10}, {"name": "b", "seed": 1, "found": 10}]
    assert gone_on_with(file, ("name", "seed"), [("b", 1), ("b", 2)], trial)[2]["found"] == 20
    assert made == [("a", 1), ("b", 1), ("b", 2)]


def test_words_of_a_command_have_the_type_of_their_default() -> None:
    given = ["3", "x", "0.5"]
    assert words(int, Path, 2.0, "none", given=given) == [3, Path("x"), 0.5, "none"]
    for kinds in ((int,), (int, str, str, int)):
        with pytest.raises(SystemExit, match="words are needed, not 3"):
            words(*kinds, given=given)


@pytest.mark.system
def test_a_test_that_passed_is_not_run_again_before_its_code_changes(tmp_path: Path) -> None:
    files = [tmp_path / name / f"test_{name}.py" for name in ("same", "changed")]
    for file in files:
        file.parent.mkdir()
        file.write_text("def test_passes():\n    pass\n\n\ndef test_fails():\n    assert False\n")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "tests.support.resumed", "-p", "no:cacheprovider", *files]

    def told() -> str:
        return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False).stdout.splitlines()[-1]

    assert "2 failed, 2 passed" in told()
    files[1].write_text(files[1].read_text() + "\n")
    assert "2 failed, 1 passed, 1 deselected" in told()
