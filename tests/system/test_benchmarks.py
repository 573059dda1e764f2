"""The benchmark command runs; what it finds is for a quiet machine to say."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.benchmarks.rounds import Cost, interleaved

pytestmark = pytest.mark.system

ROOT = Path(__file__).resolve().parents[2]


def test_rounds_are_interleaved_and_the_first_does_not_count() -> None:
    order: list[str] = []
    costs = interleaved({"a": lambda: order.append("a"), "b": lambda: order.append("b")}, 2)
    assert order == ["a", "b"] * 3
    assert [len(cost.seconds) for cost in costs.values()] == [2, 2]


def test_ratios_are_taken_round_by_round() -> None:
    slow, fast = Cost("slow", [2.0, 20.0, 2.0]), Cost("fast", [1.0, 10.0, 1.0])
    assert slow.over(fast) == [2.0, 2.0, 2.0]
    assert slow.row(fast, unit=1.0) == "| slow | 2 (2-11) | 2 | 2 (2-2) |"


def test_the_command_runs(tmp_path: Path) -> None:
    found = tmp_path / "found.json"
    command = [sys.executable, ROOT / "tests/benchmarks/speed.py", "--quick", "--json", found]
    done = subprocess.run(command, capture_output=True, text=True, timeout=280.0, check=False)
    assert done.returncode == 0, done.stderr
    told = json.loads(found.read_text())
    assert told["windows_ms"]["hop without uncertainty"] > 0
    assert told["replay"]["all"]["windows"] == 69
    assert "| floor of a hop |" in done.stdout
