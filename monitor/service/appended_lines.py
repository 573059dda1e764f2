"""Append-only files of lines: each line is written to the disk at once, and a full disk delays lines without losing them."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from pathlib import Path

_log = logging.getLogger(__name__)

_TAIL_BYTES = 1 << 20
_MOST_PENDING_BYTES = 16 << 20


class AppendedLines:
    """Append-only file of lines that other programs may follow while it grows.

    Lines that the disk does not accept wait in memory, up to a bound.  An incomplete last line, as a power cut leaves it, is
    removed when the file is opened.

    Parameters
    ----------
    path : Path
        File to append to.
    most_bytes : int, optional
        Size limit.  A larger file is renamed to NAME.1 and replaces the previous NAME.1.

    Attributes
    ----------
    dropped : int
        Number of lines lost because too many waited.
    failed : str
        Why lines wait; empty if none do.

    Raises
    ------
    OSError
        The file cannot be opened.
    """

    def __init__(self, path: Path, most_bytes: int | None = None) -> None:
        self._path, self._most_bytes = path, most_bytes
        self._pending = b""
        self.dropped, self._losing = 0, False
        self.failed = ""
        self._open()

    @property
    def size(self) -> int:
        """Size of the file in bytes."""
        return os.fstat(self._handle).st_size

    @property
    def position(self) -> int:
        """Position at the end of the file, for `lines_after`."""
        return self.size

    def lines_after(self, position: int, most_bytes: int) -> Iterator[bytes]:
        """Read the lines after a position, at most `most_bytes`."""
        with self._path.open("rb") as file:
            file.seek(position)
            yield from file.read(most_bytes).split(b"\n")

    def write(self, line: str) -> None:
        """Append one line; a failing disk does not raise, `failed` then holds the reason."""
        data = line.encode() + b"\n"
        if len(self._pending) + len(data) > _MOST_PENDING_BYTES:
            if not self._losing:
                _log.error("%s: no room for more lines to wait; lines are lost from here on", self._path)
            self._losing = True
            self.dropped += 1
        else:
            self._pending += data
        self.flush()

    def flush(self) -> None:
        """Try again to write the lines that wait."""
        try:
            while self._pending:
                self._pending = self._pending[os.write(self._handle, self._pending) :]
            self.failed, self._losing = "", False
            if self._most_bytes is not None and os.fstat(self._handle).st_size > self._most_bytes:
                self.roll(self._path.with_name(self._path.name + ".1"))
        except OSError as error:
            self.failed = f"{self._path}: {error.strerror or error}"

    def roll(self, place: Path) -> None:
        """Rename the file to `place` and begin a new one.

        Raises
        ------
        OSError
            The disk does not allow it.
        """
        os.replace(self._path, place)
        before = self._handle
        try:
            self._open()
        except OSError:
            os.replace(place, self._path)
            raise
        os.close(before)

    def sync(self) -> None:
        """Force the written lines onto the disk (fsync), so that they survive a power cut."""
        try:
            os.fsync(self._handle)
        except OSError as error:
            self.failed = f"{self._path}: {error.strerror or error}"

    def close(self) -> None:
        """Write the lines that wait and close the file."""
        self.flush()
        self.sync()
        os.close(self._handle)

    def _open(self) -> None:
        """Open the file and remove an incomplete last line."""
        self._handle = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)
        size = os.fstat(self._handle).st_size
        tail = os.pread(self._handle, _TAIL_BYTES, max(0, size - _TAIL_BYTES))
        os.ftruncate(self._handle, size - len(tail) + tail.rfind(b"\n") + 1)
