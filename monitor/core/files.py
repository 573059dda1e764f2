"""Atomic writing of files: a file exists under its final name only when it is complete."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from errno import EISDIR
from itertools import count
from pathlib import Path

from drivers.disk import destination, finish as finish, partial as partial
from monitor.core.errors import MissingInputError, WrongUsageError, os_errors_of


def spare_inputs(outputs: Iterable[Path], inputs: Iterable[Path | None]) -> None:
    """Refuse, by WrongUsageError, outputs that would overwrite an input."""
    taken = {os.path.realpath(path) for path in inputs if path is not None}
    for path in outputs:
        if os.path.realpath(path) in taken:
            raise WrongUsageError(f"{path} is an input of this command; name another place for its output")


def demand_place(path: Path) -> None:
    """Make the folder of an output and check that a file can be written there; raise MissingInputError if not."""
    try:
        part = partial(path)
        part.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            raise IsADirectoryError(EISDIR, "is a folder")
        part.open("w").close()
        part.unlink()
    except OSError as error:
        raise MissingInputError(f"{path}: cannot be written: {error.strerror}") from error


def demand_file(path: Path) -> None:
    """Raise MissingInputError where a device, a pipe or a socket stands, reading which may wait for ever."""
    with os_errors_of(path):
        destination(path)


@contextmanager
def no_empty_folder(folder: Path) -> Iterator[None]:
    """Remove a folder that is made within the block, if an error leaves the block before a file is in it."""
    was_there = folder.exists()
    try:
        yield
    except BaseException:
        if not was_there and folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
        raise


def set_aside(path: Path) -> Path:
    """Rename a damaged file to the first of NAME.damaged-1, NAME.damaged-2 .. that is free, and return its new path."""
    numbered = (path.with_name(f"{path.name}.damaged-{n}") for n in count(1))
    place = next(p for p in numbered if not p.exists())
    os.replace(path, place)
    return place


def write_atomically(path: Path, text: str, opener: Callable[[str, int], int] | None = None) -> None:
    """Write a small text file that gets its final name only when it is complete; `opener` as of `open`."""
    temporary = partial(path)
    try:
        with open(temporary, "w", encoding="utf-8", opener=opener) as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        finish(path)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        # The name that was given, not where a link leads.
        raise OSError(error.errno, error.strerror, str(path)) from error


def sha256(path: Path) -> str:
    """Compute the SHA-256 checksum of a file, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def tail_lines(path: Path, most_bytes: int) -> list[bytes]:
    """Read the complete lines in the last `most_bytes` of a file; none if it cannot be read."""
    try:
        with path.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(0, size - most_bytes))
            rows = file.read(most_bytes).split(b"\n")[:-1]
    except OSError:
        return []
    return rows[1:] if size > most_bytes else rows
