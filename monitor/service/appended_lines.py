"""Lines that are on the disk as soon as they are written; a full disk holds them up but loses none."""

from __future__ import annotations

import logging
import os
from pathlib import Path

_log = logging.getLogger(__name__)

_TAIL_BYTES = 1 << 20
_MOST_PENDING_BYTES = 16 << 20


class AppendedLines:
    """A file of lines that others may follow while it grows.

    What the disk does not take waits in memory, within bounds.  Half a line at the file's end, as a power cut leaves it, is
    removed first.

    Parameters
    ----------
    most_bytes : int, optional
        A file that has grown beyond this is set aside as NAME.1, in the place of the one before.

    Raises ``OSError`` if the file cannot be opened.
    """

    def __init__(self, path: Path, most_bytes: int | None = None) -> None:
        self._path, self._most_bytes = path, most_bytes
        self._pending = b""
        self.dropped, self._losing = 0, False
        """Lines that found no room to wait."""
        self.failed = ""
        """Why lines wait; empty while all is well."""
        self._open()

    @property
    def size(self) -> int:
        """Bytes that the file has."""
        return os.fstat(self._handle).st_size

    def write(self, line: str) -> None:
        """Add one line; never raises OSError."""
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
        """Try again to write what waits."""
        try:
            while self._pending:
                self._pending = self._pending[os.write(self._handle, self._pending) :]
            self.failed, self._losing = "", False
            if self._most_bytes is not None and os.fstat(self._handle).st_size > self._most_bytes:
                os.replace(self._path, self._path.with_name(self._path.name + ".1"))
                os.close(self._handle)
                self._open()
        except OSError as error:
            self.failed = f"{self._path}: {error.strerror or error}"

    def sync(self) -> None:
        """See that the lines outlast a power cut."""
        try:
            os.fsync(self._handle)
        except OSError as error:
            self.failed = f"{self._path}: {error.strerror or error}"

    def close(self) -> None:
        """The last of it."""
        self.flush()
        self.sync()
        os.close(self._handle)

    def _open(self) -> None:
        self._handle = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)
        size = os.fstat(self._handle).st_size
        tail = os.pread(self._handle, _TAIL_BYTES, max(0, size - _TAIL_BYTES))
        os.ftruncate(self._handle, size - len(tail) + tail.rfind(b"\n") + 1)
