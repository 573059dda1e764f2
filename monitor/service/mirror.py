"""Copy of a site's output folder in object storage: stores what has changed, and fetches what is newer there."""

from __future__ import annotations

import logging
import os
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from datetime import UTC, datetime
from itertools import zip_longest
from pathlib import Path
from typing import BinaryIO
from uuid import uuid4

from drivers.disk import destination, private
from monitor.service.manifest import (
    FETCHED,
    SUPERSEDED,
    Files,
    Part,
    StoredFile,
    is_appended,
    is_kept,
    is_state,
    is_unique,
    object_name,
    to_get,
    to_put,
)
from monitor.service.objects import OBJECT_BYTES, Objects

_log = logging.getLogger(__name__)

_TAIL_BYTES = 4096
"""Length of the end of such a file by which it is known again. [bytes; judgement: lines and messages differ by their times]"""


class _UnusableError(OSError):
    """A stored file that nobody can get: an object of it is missing or damaged."""


class Mirror:
    """Files of an output folder, and their copies; `goes_on` is called before each step, of which one may hang."""

    def __init__(self, out: Path, objects: Objects, goes_on: Callable[[], None]) -> None:
        self._out, self._objects, self._goes_on = out, objects, goes_on
        self._known: dict[str, tuple[int, int]] = {}
        """Number of the file and CRC-32 of its end, as it was stored, for files that this run stored."""

    def store(self, stored: Files, number: int, put: Callable[[Files], None]) -> dict[str, StoredFile]:
        """Store what has changed since the manifest `number`, which names the files `stored`, and return the files.

        Checkpoints come first: the other files may be newer than these, as after a kill, but never older.  `put` is told the
        files as far as they are stored, when an object was.
        """
        files: dict[str, StoredFile] = {}

        def full(name: str, data: bytes) -> None:
            self._goes_on()
            self._objects.put(name, data)
            put({**stored, **{name: file for name, file in files.items() if not is_state(name)}})

        writer = _Writer(object_name(number, uuid4().hex), full)
        for name in sorted(self._names(), key=lambda name: (not is_state(name), name)):
            self._goes_on()
            with suppress(FileNotFoundError):  # gone since it was listed
                files[name] = self._store(name, stored.get(name), writer)
        writer.close()
        return files

    def take_over(self, files: Files) -> None:
        """Have the folder hold the stored files; those that it has already are not fetched.

        What nobody could get back is put aside: what this machine recorded and judged while another one had the site.
        """
        aside, names = self._aside(), [*self._names()]
        for name in names:
            if name not in files:
                _put_aside(self._out / name, name, aside)
        lacking = [name for name, file in files.items() if name not in names or not _is_content(self._out / name, file)]
        for name in lacking:
            self._get(name, self._fetched(name, files[name]), aside, spare=False)
        for path in (self._out / "state").glob("history.db*"):
            path.unlink()
        _log.warning("%s: %d of %d files fetched", self._out, len(lacking), len(files))

    def recover(self, files: Files, *, is_running: bool) -> None:
        """Get what the folder lacks of its own monitor's files, as where a part of it was restored, or the power failed.

        A file that lacks its end is made whole, where no monitor `is_running` that writes it.  Of any other one that does not go
        on from what is stored, the stored form is put aside.
        """
        aside = self._aside()
        about = {name: (self._out / name).stat() for name in self._names()}
        present = {name: (found.st_size, found.st_mtime_ns) for name, found in about.items()}
        for name in to_get(files, present, self._is_gone_on_from):
            try:
                fetched = self._fetched(name, files[name])
            except _UnusableError as error:
                _log.error("%s", error)
                continue
            self._get(
                name, fetched, aside, spare=is_running or (is_appended(name) and not self._lacks_its_end(name, fetched))
            )

    def _get(self, name: str, fetched: Path, aside: Path, *, spare: bool) -> None:
        """Put a fetched file in its place, and aside what was there, unless it is its beginning; with `spare` the fetched one."""
        path = destination(self._out / name)
        if path.exists() and spare:
            _put_aside(fetched, name, aside)
            return
        if path.exists() and not _begins_with(fetched, path):
            _put_aside(path, name, aside)
        fetched.replace(path)
        _log.warning("%s: fetched from the storage, where it is newer", path)

    def _lacks_its_end(self, name: str, fetched: Path) -> bool:
        """Return whether a file is the beginning of a fetched one; an empty one may be the next, begun when that was full."""
        path = self._out / name
        return path.exists() and path.stat().st_size > 0 and _begins_with(fetched, path)

    def _aside(self) -> Path:
        return self._out / SUPERSEDED / f"{datetime.now(UTC):%Y%m%dT%H%M%S.%fZ}"

    def _names(self) -> Iterator[str]:
        """List the names of the files that are kept in the storage."""
        for folder, _, names in os.walk(self._out):
            for name in names:
                path = Path(folder, name).relative_to(self._out).as_posix()
                if is_kept(path):
                    yield path

    def _store(self, name: str, before: StoredFile | None, writer: _Writer) -> StoredFile:
        """Store what a file has got at its end, or all of it where it is another file."""
        with (self._out / name).open("rb") as file:
            about = os.fstat(file.fileno())
            is_known = self._known.get(name, (about.st_ino, 0))[0] == about.st_ino
            if (
                before is not None
                and is_known
                and (before.length, before.mtime_ns) == (about.st_size, about.st_mtime_ns)
            ):
                return before
            if before is not None and (before.length > about.st_size or not self._begins(name, file, before)):
                before = None
            parts, begin = to_put(before, about.st_size)
            known, crc32 = (0, 0) if before is None else (before.length, before.crc32)
            file.seek(begin)
            for data in _pieces(file, about.st_size - begin):
                crc32 = zlib.crc32(data[max(0, known - begin) :], crc32)
                begin += len(data)
                parts.append(writer.add(data))
                self._goes_on()
            self._known[name] = about.st_ino, _tail_crc32(file, begin)
        return StoredFile(parts=tuple(parts), crc32=crc32, mtime_ns=about.st_mtime_ns)

    def _begins(self, name: str, file: BinaryIO, before: StoredFile) -> bool:
        """Return whether a file, which is no shorter, begins with what is stored of it."""
        if is_appended(name) and self._known.get(name) == (
            os.fstat(file.fileno()).st_ino,
            _tail_crc32(file, before.length),
        ):
            return True
        file.seek(0)
        return _crc32(file, before.length) == before.crc32

    def _is_gone_on_from(self, name: str, before: StoredFile) -> bool:
        """Return whether a file of the folder begins with what is stored of it."""
        self._goes_on()
        with suppress(FileNotFoundError), (self._out / name).open("rb") as file:
            return os.fstat(file.fileno()).st_size >= before.length and self._begins(name, file, before)
        return False

    def _fetched(self, name: str, file: StoredFile) -> Path:
        """Write the parts of a stored file beside its place."""
        path, crc32 = destination(self._out / name), 0
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(path.name + FETCHED)
        with open(temporary, "wb", opener=private if is_state(name) else None) as target:
            for part in file.parts:
                self._goes_on()
                answer = self._objects.get(part.object, (part.offset, part.length))
                if answer is None:
                    raise _UnusableError(f"{name}: {part.object} is missing")
                target.write(answer[0])
                crc32 = zlib.crc32(answer[0], crc32)
            if crc32 != file.crc32:
                raise _UnusableError(f"{name}: not as it was stored")
            target.flush()
            os.fsync(target.fileno())
        os.utime(temporary, ns=(file.mtime_ns, file.mtime_ns))
        return temporary


class _Writer:
    """Writer of bytes into objects of one name and a number, which `put` stores when they are full, and at the end."""

    def __init__(self, name: str, put: Callable[[str, bytes], None]) -> None:
        self._name, self._put, self._count, self._data = name, put, 0, bytearray()

    def add(self, data: bytes) -> Part:
        """Append bytes, and say where they will be."""
        if len(self._data) + len(data) > OBJECT_BYTES:
            self.close()
        self._data += data
        return Part(f"{self._name}-{self._count}", len(self._data) - len(data), len(data))

    def close(self) -> None:
        """Store what has been appended."""
        if self._data:
            name, data = f"{self._name}-{self._count}", bytes(self._data)
            self._count, self._data = self._count + 1, bytearray()
            self._put(name, data)


def _pieces(file: BinaryIO, length: int) -> Iterator[bytes]:
    """Read the next bytes of a file, in pieces that fit an object; fewer where the file is shorter."""
    while length > 0 and (data := file.read(min(length, OBJECT_BYTES))):
        length -= len(data)
        yield data


def _crc32(file: BinaryIO, length: int) -> int:
    """Compute the CRC-32 of the next bytes of a file."""
    found = 0
    for data in _pieces(file, length):
        found = zlib.crc32(data, found)
    return found


def _put_aside(path: Path, name: str, folder: Path) -> None:
    """Move a file of a site into another folder; checkpoints and summaries, which follow from the others, are dropped."""
    if not is_unique(name):
        path.unlink()
        return
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    path.replace(folder / name)
    _log.warning("%s: superseded; kept as %s", path, folder / name)


def _is_content(path: Path, stored: StoredFile) -> bool:
    """Return whether a file is as it was stored."""
    with path.open("rb") as file:
        return os.fstat(file.fileno()).st_size == stored.length and _crc32(file, stored.length) == stored.crc32


def _begins_with(path: Path, beginning: Path) -> bool:
    """Return whether a file begins with all of another one."""
    with path.open("rb") as file, beginning.open("rb") as other:
        length = os.fstat(other.fileno()).st_size
        return all(a == b for a, b in zip_longest(_pieces(file, length), _pieces(other, length)))


def _tail_crc32(file: BinaryIO, length: int) -> int:
    """Compute the CRC-32 of the last of the first `length` bytes of a file."""
    begin = max(0, length - _TAIL_BYTES)
    file.seek(begin)
    return _crc32(file, length - begin)
