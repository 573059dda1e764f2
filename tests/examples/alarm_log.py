"""A publisher: takes results as they come, and keeps a line for every change of the alarm's level."""

from __future__ import annotations

from pathlib import Path

from monitor.core import Level, WindowResult
from monitor.publish import Publisher


class AlarmLog(Publisher):
    """One line a change; what else there is to take (`samples`, `gap`, `health`) passes by."""

    def __init__(self, path: Path) -> None:
        self._path, self._level = path, Level.NORMAL

    def window(self, result: WindowResult, line: str) -> None:
        """Note a change."""
        if result.skipped is None and result.alarm.level is not self._level:
            self._level = result.alarm.level
            with self._path.open("a", encoding="utf-8") as file:
                file.write(f"{result.t_end_ns} {self._level.value}: {result.alarm.reason}\n")
