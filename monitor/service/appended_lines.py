"""Append-only files of lines: a full disk or one that hangs delays lines without losing them."""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

from drivers.disk import destination
from monitor.core import Busy

_log = logging.getLogger(__name__)

_PIECE_BYTES = 1 << 20
"""Length of the pieces in which the end of the last complete line is looked for, backwards. [bytes; cost]"""


def at_once(flush: Callable[[], None]) -> None:
    """Write the lines that wait in the thread that appends them."""
    flush()


class AppendedLines:
    """Append-only file of lines that other programs may follow while it grows.

    Lines that the disk does not accept wait in memory, up to `most_pending_bytes`; beyond them lines are lost and counted in
    `dropped`.  An incomplete last line, as a power cut leaves it, is removed when the file is opened.  A file larger than
    `most_bytes` replaces NAME.1.  `run` calls the function that it is given, which writes the lines that wait: at once, or in
    another thread, so that `write` waits for no disk.  `size` is that of the file when all lines so far are written.
    The file is looked up by its name whenever lines are written: one that was removed, moved or replaced meanwhile is told, and
    the lines go into the file of that name in the same folder; where that folder was removed, they wait.
    """

    def __init__(
        self,
        path: Path,
        most_bytes: int | None = None,
        run: Callable[[Callable[[], None]], None] = at_once,
        most_pending_bytes: int = 16 << 20,
    ) -> None:
        self._path, self._most_bytes, self._run = path, most_bytes, run
        self._most_pending_bytes = most_pending_bytes
        self._pending = b""
        self._lock = threading.Lock()
        """Held while lines are queued or taken; no holder waits for a disk."""
        self._writing = threading.Lock()
        """Held by the thread that writes."""
        self._busy, self._syncing = Busy(), Busy()
        self.dropped, self._losing = 0, False
        self._failure = ""
        self._folder = os.open(path.parent, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
        """Folder of the file, which stays the same one where another is made under its path."""
        try:
            self._open()
        except OSError:
            os.close(self._folder)
            raise

    @property
    def failed(self) -> str:
        """Why lines wait; empty if none do."""
        return self._busy.overdue or self._syncing.overdue or self._failure

    @property
    def position(self) -> int:
        """Position at the end of the file, for `lines_after`."""
        return self.size

    def lines_after(self, position: int, most_bytes: int) -> Iterator[bytes]:
        """Read the lines after a position, at most `most_bytes`; all of a file that is shorter, as one begun anew since."""
        with self._path.open("rb") as file:
            file.seek(position if position <= os.fstat(file.fileno()).st_size else 0)
            yield from file.read(most_bytes).split(b"\n")

    def write(self, line: str) -> None:
        """Append one line; a failing disk does not raise, `failed` then holds the reason."""
        data = line.encode() + b"\n"
        with self._lock:
            is_room = len(self._pending) + len(data) <= self._most_pending_bytes
            if is_room:
                self._pending += data
                self.size += len(data)
            else:
                self.dropped += 1
        if not is_room and not self._losing:
            _log.error("%s: no room for more lines to wait; lines are lost from here on", self._path)
        self._losing = self._losing or not is_room
        self._run(self.flush)

    def flush(self) -> None:
        """Write the lines that wait, as far as the disk takes them."""
        with self._writing, self._busy:
            try:
                self._follow()
                while data := self._pending:
                    n_written = os.write(self._handle, data)
                    with self._lock:
                        self._pending = self._pending[n_written:]
                self._failure, self._losing = "", False
                if self._most_bytes is not None and os.fstat(self._handle).st_size > self._most_bytes:
                    self.roll(self._path.with_name(self._path.name + ".1"))
            except OSError as error:
                self._failure = f"{self._path}: {error.strerror or error}"

    def try_roll(self, place: Path) -> bool:
        """Rename the file to `place` and begin a new one, if no line waits and the disk allows it; return whether it was done."""
        if self._pending or not self._writing.acquire(blocking=False):
            return False
        try:
            with self._busy:
                self.roll(place)
        except OSError as error:
            _log.warning("%s: not closed: %s", place, error.strerror or error)
            return False
        finally:
            self._writing.release()
        return True

    def roll(self, place: Path) -> None:
        """Rename the file to `place` and begin a new one; raise OSError where the disk does not allow it."""
        self._follow()
        path, place = destination(self._path), destination(place)
        os.replace(path, place)
        before = self._handle
        try:
            self._open()
        except OSError:
            os.replace(place, path)
            raise
        os.close(before)

    def sync(self) -> None:
        """Write the lines that wait and force them onto the disk (fsync), so that they survive a power cut."""
        self.flush()
        with self._syncing:
            try:
                os.fsync(self._handle)
            except OSError as error:
                self._failure = f"{self._path}: {error.strerror or error}"

    def close(self) -> None:
        """Write the lines that wait and close the file."""
        self.sync()
        with self._writing:
            os.close(self._handle)
            os.close(self._folder)

    def _follow(self) -> None:
        """Open the file of this name where it is no longer the one that is open."""
        try:
            is_there = os.path.samestat(os.stat(self._path.name, dir_fd=self._folder), os.fstat(self._handle))
        except FileNotFoundError:
            is_there = False
        if not is_there:
            before = self._handle
            self._open()
            os.close(before)
            _log.warning("%s: was removed or moved away while it was written; begun anew", self._path)

    def _open(self) -> None:
        destination(self._path)  # refuses what is no regular file
        flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC
        try:
            self._handle = os.open(self._path.name, flags, 0o644, dir_fd=self._folder)
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self._path)) from error
        size = end = os.fstat(self._handle).st_size
        while end > 0:
            begin = max(0, end - _PIECE_BYTES)
            newline = os.pread(self._handle, end - begin, begin).rfind(b"\n")
            if newline >= 0:
                end = begin + newline + 1
                break
            end = begin
        if end < size:
            _log.warning("%s: an incomplete last line of %d bytes is removed", self._path, size - end)
        size = end
        os.ftruncate(self._handle, size)
        with self._lock:
            self.size = size + len(self._pending)
