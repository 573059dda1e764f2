"""What every command owes: exit codes, one clear message, JSON without NaN."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

Done = subprocess.CompletedProcess[str]


def ended(*command: object, cwd: Path | None = None, timeout_s: float = 600.0, **environment: str) -> Done:
    """A command at its end, with some variables of the environment changed."""
    return subprocess.run(
        [*map(str, command)], capture_output=True, text=True, check=False, cwd=cwd, timeout=timeout_s,
        env={**os.environ, **environment},
    )  # fmt: skip


def strict(text: str) -> object:
    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is no JSON")

    return json.loads(text, parse_constant=refuse)


def assert_ok(done: Done) -> None:
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr


def assert_refused(done: Done, codes: set[int], *words: str) -> None:
    """One clear message, the right code, never a traceback."""
    assert "Traceback" not in done.stderr, done.stderr[-2000:]
    assert done.returncode in codes, (done.returncode, done.stderr)
    if done.returncode == 2:
        assert "Usage" in done.stderr
    else:
        assert [line[:7] for line in done.stderr.splitlines()].count("error: ") == 1, done.stderr
        assert done.stderr.startswith("error: ") or done.stderr.startswith("warning: ")
    told = " ".join(done.stderr.split())
    assert all(word in told for word in words), (words, done.stderr)
    assert done.stdout == ""


KEYS = {"verdict", "cause", "causes", "alternatives", "separating_measurement", "misfit", "gain", "standing", "tried"}
