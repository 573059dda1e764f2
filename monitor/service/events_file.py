"""File events.jsonl of a daemon, to which no event is written twice."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from monitor.core import parse_json
from monitor.service.appended_lines import AppendedLines


class EventsFile(AppendedLines):
    """Append lines of events; what a run before a restart wrote already is not written again, and its last line is `last`."""

    def __init__(self, path: Path, run: Callable[[Callable[[], None]], None]) -> None:
        super().__init__(path, run=run)
        self._written: set[tuple[str, int]] = set()
        self.last: str | None = None
        for text in path.read_bytes().splitlines():
            try:
                line = parse_json(text)
                self._written.add((line["id"], line["revision"]))
                self.last = text.decode()
            except (ValueError, KeyError, TypeError):  # a line that a crash cut is written again
                continue

    def write_event(self, id: str, revision: int, line: str) -> bool:
        """Append a line; return False where it was written before."""
        if (id, revision) in self._written:
            return False
        self._written.add((id, revision))
        self.write(line)
        return True
