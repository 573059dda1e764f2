"""Where the time of the tests goes: a plugin of pytest that notes it, and the tables of it.

python -m tests.times run default COMMAND ...   # a tier: its wall and CPU time
python -m tests.times                           # the tiers of the last run, in one line each
python -m tests.times tests 20                  # by folder and kind, and the twenty slowest tests
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

_KEPT = Path(__file__).resolve().parents[1] / "out" / "times"
_TIER = "TESTS_TIER"
_CPU = pytest.StashKey[tuple[float, float]]()


def _cpu_s() -> tuple[float, float]:
    """Of this process, and of those that it started and that ended."""
    own, others = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own.ru_utime + own.ru_stime, others.ru_utime + others.ru_stime


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[Any]) -> Iterator[None]:
    """Notes test, phase, wall time, CPU time of the process and of the processes that the test started."""
    report = yield
    if folder := os.environ.get(_TIER):
        now, before = _cpu_s(), item.session.stash.get(_CPU, _cpu_s())
        item.session.stash[_CPU] = now
        line = [item.nodeid, call.when, call.duration, now[0] - before[0], now[1] - before[1]]
        with open(Path(folder) / f"{os.environ.get('PYTEST_XDIST_WORKER', 'one')}.jsonl", "a") as file:
            file.write(json.dumps(line) + "\n")
    return report


def run(tier: str, command: list[str]) -> int:
    """Run a tier and keep its times; its exit code."""
    folder = _KEPT / tier
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    begin = time.monotonic()
    code = subprocess.run(command, env={**os.environ, _TIER: str(folder)}, check=False).returncode
    (folder / "tier.json").write_text(json.dumps({"wall_s": time.monotonic() - begin, "cpu_s": sum(_cpu_s())}))
    return code


def tell_tiers() -> None:
    print(f"{'tier':<10}{'wall, s':>9}{'CPU, s':>9}")
    for file in sorted(_KEPT.glob("*/tier.json"), key=lambda f: f.stat().st_mtime):
        kept = json.loads(file.read_text())
        print(f"{file.parent.name:<10}{kept['wall_s']:9.0f}{kept['cpu_s']:9.0f}")


def tell_tests(slowest: int) -> None:
    """Wall time by folder: set-up, computing, processes started, waiting (for clocks, processes, browsers)."""
    folders: dict[str, list[float]] = defaultdict(lambda: [0.0] * 5)
    tests: dict[str, float] = defaultdict(float)
    for file in _KEPT.glob("*/*.jsonl"):
        for line in file.read_text().splitlines():
            name, phase, wall_s, own_s, others_s = json.loads(line)
            tests[name] += wall_s
            of = folders[f"{file.parent.name}: {name.split('::')[0].split('/')[1].removesuffix('.py')}"]
            of[0] += wall_s
            of[1] += wall_s if phase == "setup" else 0.0
            for k, part in enumerate((own_s, others_s, max(wall_s - own_s - others_s, 0.0)), 2):
                of[k] += part
    print(f"{'tier: folder':<30}{'all, s':>9}{'set-up':>9}{'computing':>11}{'processes':>11}{'waiting':>9}")
    for name, (wall, setup, own, others, waiting) in sorted(folders.items(), key=lambda item: -item[1][0]):
        print(f"{name:<30}{wall:9.0f}{setup:9.0f}{own:11.0f}{others:11.0f}{waiting:9.0f}")
    for name in sorted(tests, key=lambda n: -tests[n])[:slowest]:
        print(f"{tests[name]:6.1f} s  {name}")


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["run", tier, *command]:
            sys.exit(run(tier, command))
        case ["tests", *count]:
            tell_tests(int(count[0]) if count else 10)
        case []:
            tell_tiers()
        case _:
            sys.exit(__doc__)
