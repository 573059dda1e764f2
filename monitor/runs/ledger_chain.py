"""Lines of ledger.jsonl in a chain of hashes, so that a line that was changed, removed or put in later shows.

Each line holds as `previous` the SHA-256 of the line before it, without its newline.  The first such line of a file holds the
SHA-256 of everything before it: nothing, or the lines of an older program, which wrote none.  The hash of the last line, the
head, stands for the whole ledger: kept elsewhere, it also shows that lines were cut off at the end.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import time
from collections.abc import Mapping, Sequence
from io import FileIO
from pathlib import Path
from typing import Any

from drivers.disk import destination
from monitor.core import BadInputError, MissingInputError, os_errors_of, tail_lines

_READ_BYTES = 1 << 20
"""Bytes that are read at a time, and within which the last line begins. [bytes; cost]"""
_LOCK_S = 2.0
"""Longest wait for another process that writes the ledger. [s; judgement]"""


def append_lines(ledger: Path, entries: Sequence[Mapping[str, Any]]) -> str:
    """Append entries (at least one, without `previous`) to the chain, all or none; return the new head once they are on the disk.

    Raises MissingInputError if the ledger cannot be written; it is then as it was before.
    """
    with os_errors_of(ledger, "cannot be written: "), destination(ledger).open("a+b", buffering=0) as file:
        _lock(file)
        size = _remove_incomplete_line(file)
        text, previous = b"", _link(file, size)
        for entry in entries:
            line = json.dumps({**entry, "previous": previous}, allow_nan=False).encode()
            text, previous = text + line + b"\n", hashlib.sha256(line).hexdigest()
        try:
            rest = text
            while rest:
                rest = rest[file.write(rest) :]
            os.fsync(file.fileno())
        except OSError:
            file.truncate(size)
            raise
    return previous


def read_head(ledger: Path) -> str | None:
    """Read the hash of the ledger's last line; None without a ledger that can be read, or without a line in it."""
    rows = tail_lines(ledger, _READ_BYTES)
    return hashlib.sha256(rows[-1]).hexdigest() if rows and rows[-1] else None


def verify(ledger: Path, heads: Sequence[str] = ()) -> int:
    """Check the chain of a ledger and return its number of lines; a ledger that does not exist has none.

    Each of the `heads` that were kept elsewhere must be the hash of a line.  Raises BadInputError if the chain is broken: the
    message names the first line that does not follow from those before it.  MissingInputError if the ledger cannot be read.
    """
    number, everything, previous, missing = 0, hashlib.sha256(), "", set(heads)
    try:
        with ledger.open("rb") as file:
            for row in file:
                if not row.endswith(b"\n"):  # is being written, or was when the power went
                    break
                number, line, link = number + 1, row.removesuffix(b"\n"), _stated_link(row)
                due = previous or everything.hexdigest()
                if link != due and (previous or link is not None):
                    lacks = "holds no hash" if link is None else "does not hold the hash"
                    raise BadInputError(
                        f"{ledger}: line {number} {lacks} of what stands before it: a line there was changed, removed or put in; "
                        "compare with a copy"
                    )
                everything.update(row)
                head = hashlib.sha256(line).hexdigest()
                previous = head if link is not None else ""
                missing.discard(head)
    except OSError as error:
        if not isinstance(error, FileNotFoundError):
            raise MissingInputError(f"{ledger}: {error.strerror or error}") from error
    if missing:
        raise BadInputError(
            f"{ledger}: after line {number} lines are missing, for the head {min(missing)} was known; compare with a copy"
        )
    return number


def _lock(file: FileIO) -> None:
    """Keep other processes from writing until the file is closed; raise OSError if one of them does not end."""
    deadline = time.monotonic() + _LOCK_S
    while True:
        try:
            # A lock that only those can take who may write: a reader cannot keep the ledger from being written.
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            if time.monotonic() >= deadline:
                raise
        time.sleep(0.05)


def _remove_incomplete_line(file: FileIO) -> int:
    """Remove the part of a line that a power cut left at the end; return the size, bytes."""
    size = file.seek(0, os.SEEK_END)
    tail = os.pread(file.fileno(), _READ_BYTES, max(0, size - _READ_BYTES))
    whole = size - len(tail) + tail.rfind(b"\n") + 1
    if whole != size:
        file.truncate(whole)
    return whole


def _link(file: FileIO, size: int) -> str:
    """Compute the hash that the next line holds."""
    line = _last_line(file, size)
    if _stated_link(line) is not None:
        return hashlib.sha256(line).hexdigest()
    file.seek(0)
    return hashlib.file_digest(file, "sha256").hexdigest()


def _last_line(file: FileIO, size: int) -> bytes:
    """Read the last complete line of a file of `size` bytes, without its newline; empty if there is none."""
    tail = os.pread(file.fileno(), _READ_BYTES, max(0, size - _READ_BYTES))
    return tail[: tail.rfind(b"\n") + 1].removesuffix(b"\n").rpartition(b"\n")[2]


def _stated_link(row: bytes) -> str | None:
    """Read the hash that a line holds; None if it holds none."""
    try:
        content = json.loads(row)
    except (ValueError, RecursionError):
        return None
    link = content.get("previous") if isinstance(content, dict) else None
    return link if isinstance(link, str) else None
