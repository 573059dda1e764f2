"""Files of results, whose closed months are packed, and of events; and the budget that bounds the output folder."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

from monitor.config import OutputSettings
from monitor.core import BadInputError, parse_json
from monitor.publish import closed_files, month_file, pack_month, read_lines
from monitor.service.appended_lines import AppendedLines, at_once
from monitor.service.threads import Recording

_log = logging.getLogger(__name__)

_GB = 1 << 30
"""One GiB. [bytes; definition]"""
_TAIL_BYTES = 1 << 20
"""Length of the end of a file in which its last line begins. [bytes; cost]"""
_MONTH_BYTES = 1 << 48
"""Bound of the length of a month's results: a position is a month's number times this, plus a length. [bytes; definition]"""
_T_END = re.compile(rb'"t_end_ns": (\d{1,19})\b')
"""End of a window in its line; nineteen digits end in the year 2286, and more are of a damaged line. [1; definition]"""


class ResultsFile(AppendedLines):
    """File results.jsonl; with `by_month` the first window of another month begins a new file."""

    def __init__(self, path: Path, *, by_month: bool, run: Callable[[Callable[[], None]], None] = at_once) -> None:
        super().__init__(path, run=run)
        self._by_month = by_month
        self._to_close: tuple[Path, int] | None = None
        """Name for the month that is to be closed, and the end of a window after it (ns); None if none is."""
        with path.open("rb") as file:
            file.seek(max(0, self.size - _TAIL_BYTES))
            ends = _T_END.findall(file.read())
        self._last_ns = int(ends[-1]) if ends else None

    @property
    def position(self) -> int:
        """Position at the end of the file: the month that it holds, and its length in bytes."""
        return self._month * _MONTH_BYTES + self.size

    def lines_after(self, position: int, most_bytes: int) -> Iterator[bytes]:
        """Read the lines after a position, also where its month was closed since; at most `most_bytes` of the present file."""
        month, offset = divmod(position, _MONTH_BYTES)
        if month in {0, self._month}:
            yield from super().lines_after(offset, most_bytes)
            return
        for path in closed_files(self._path.parent):
            if _month_of(path) >= month:
                yield from _lines_from(path, offset if _month_of(path) == month else 0)
        yield from super().lines_after(0, most_bytes)

    @property
    def _month(self) -> int:
        """Number of the month that the file holds; 0 where months are not told apart, or without a line."""
        if not self._by_month or self._last_ns is None:
            return 0
        return _month_of(month_file(self._path.parent, self._last_ns))

    def write_window(self, line: str, t_end_ns: int) -> None:
        """Append the line of a window that ends at `t_end_ns` (UTC, ns since 1970)."""
        if self._last_ns is None or not self._by_month or self._begin_month(self._last_ns, t_end_ns):
            self._last_ns = t_end_ns
        self.write(line)

    def _begin_month(self, last_ns: int, t_end_ns: int) -> bool:
        """Have the file's month closed where another begins; return whether the file now holds the month of `t_end_ns`.

        The file is renamed by the thread that writes, after the lines that wait: until it is, windows go into the file that was.
        """
        closed = month_file(self._path.parent, last_ns)
        if closed == month_file(self._path.parent, t_end_ns):
            return True
        self._to_close = closed, t_end_ns
        self._run(self.flush)
        return self._to_close is None

    def flush(self) -> None:
        """Write the lines that wait, and close the month if it is to be closed."""
        super().flush()
        if (turn := self._to_close) is None:
            return
        closed, t_end_ns = turn
        if os.path.lexists(closed) or self.try_roll(closed):
            self._last_ns, self._to_close = t_end_ns, None


def _month_of(path: Path) -> int:
    """Read the number of a closed month from its file's name: 202601 for January 2026."""
    year, month = path.name.removeprefix("results-").partition(".")[0].split("-")
    return 100 * int(year) + int(month)


def _lines_from(path: Path, offset: int) -> Iterator[bytes]:
    """Read the lines of a closed month that begin at a byte offset or after it; a file that cannot be read has none."""
    begin = 0
    try:
        for line in read_lines(path):
            if begin >= offset:
                yield line
            begin += len(line)
    except (OSError, BadInputError) as error:
        _log.warning("%s: %s; windows at the turn of the month may be written twice", path, error)


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


class Storage:
    """Keeper of the budget of the output folder.

    What is beyond the budget goes in this order: the oldest recordings, all but the one being written (the recorder gets the
    rest of the budget); then the oldest closed months of results.  Nothing else is removed: if that does not suffice, or a
    month cannot be packed, `failed` says so.
    """

    dropped = 0  # what goes for the budget is named in the log, and counts as removed, not as lost

    def __init__(self, out: Path, settings: OutputSettings, recording: Recording) -> None:
        self._out, self._settings, self._recording = out, settings, recording
        self.failed: str | None = None

    def tidy(self) -> None:
        """Pack closed months, and remove what is beyond the budget (in a thread that may wait for the disk)."""
        try:
            for path in closed_files(self._out):
                if path.suffix == ".jsonl" and self._settings.pack_months:
                    pack_month(path)
            self.failed = None if self._settings.keep_gb is None else self._limit(round(self._settings.keep_gb * _GB))
        except OSError as error:
            self.failed = f"{self._out}: {error.strerror or error}"
        except BadInputError as error:
            self.failed = str(error)

    def _limit(self, most_bytes: int) -> str | None:
        """Remove closed months beyond the budget and give its rest to the recorder; return what is wrong."""
        used = self._used_bytes()
        for path in closed_files(self._out):
            if used <= most_bytes:
                break
            used -= path.stat().st_size
            path.unlink()
            _log.warning("%s: removed, for the output folder may hold %g GiB", path, self._settings.keep_gb)
        self._recording.limit(max(0, most_bytes - used))
        if used <= most_bytes:
            return None
        return f"{self._out}: {used / _GB:.2f} GiB without recordings, keep_gb = {self._settings.keep_gb:g}; raise it"

    def _used_bytes(self) -> int:
        total = 0
        for path in self._out.rglob("*"):
            with suppress(FileNotFoundError):  # removed meanwhile
                if (self._out / "recordings") not in path.parents and path.is_file():
                    total += path.stat().st_size
        return total
