"""Plugin by which `make test-slow` goes on after an interruption: ``pytest -p tests.support.resumed -m slow``.

A test that passed is not run again as long as the code (`tests.support.reference`) and the test's folder are the same.
"""

from __future__ import annotations

import hashlib

import pytest

from tests.support.reference import place


def _names(items: list[pytest.Item]) -> dict[str, str]:
    """Name of each test with the checksum of its folder."""
    folders = {item.path.parent for item in items}
    sums = {f: hashlib.sha256(b"\0".join(p.read_bytes() for p in sorted(f.glob("*.py")))).hexdigest() for f in folders}
    return {item.nodeid: f"{sums[item.path.parent][:16]} {item.nodeid}" for item in items}


class _Resumed:
    def __init__(self) -> None:
        self.names: dict[str, str] = {}

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, config: pytest.Config, items: list[pytest.Item]) -> None:
        file = place() / "passed"
        passed = set(file.read_text().splitlines()) if file.exists() else set()
        self.names = _names(items)
        done = [item for item in items if self.names[item.nodeid] in passed]
        config.hook.pytest_deselected(items=done)
        items[:] = [item for item in items if self.names[item.nodeid] not in passed]

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "call" and report.passed:
            with (place() / "passed").open("a") as file:
                file.write(self.names[report.nodeid] + "\n")


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(_Resumed())
