"""Copy of a site's output folder in object storage: stores what has changed, and fetches what is newer there."""

from __future__ import annotations

import logging
import os
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO
from uuid import uuid4

from drivers.disk import begins_with, destination, private
from monitor.service.manifest import (
    FETCHED,
    SUPERSEDED,
    Files,
    Part,
    StoredFile,
    forms,
    is_appended,
    is_kept,
    is_state,
    is_unique,
    to_get,
    to_put,
    without_shorter,
)
from monitor.service.objects import OBJECT_BYTES, Objects

_log = logging.getLogger(__name__)

_TAIL_BYTES = 4096
"""Length of the end of such a file by which it is known again. [bytes; judgement: lines and messages differ by their times]"""


class _UnusableError(OSError):
    """An object of a stored file is missing or damaged."""


class Mirror:
    """Files of an output folder, and their copies; `goes_on` is called before each step, of which one may hang."""

    def __init__(self, out: Path, objects: Objects, goes_on: Callable[[], None]) -> None:
        self._out, self._objects, self._goes_on = out, objects, goes_on
        self._known: dict[str, tuple[int, int]] = {}
        """Number of the file and CRC-32 of its end, as it was stored, for files that this run stored."""

    def store(self, stored: Files, put: Callable[[Files], None]) -> dict[str, StoredFile]:
        """Store what has changed since the `stored` files, and return all; `put` is told them as far as they are stored.

        Checkpoints come first: the other files may be newer than these, as after a kill, but never older.
        """
        files: dict[str, StoredFile] = {}

        def full(name: str, data: bytes) -> None:
            self._goes_on()
            self._objects.put(name, data)
            put({**stored, **{name: file for name, file in files.items() if not is_state(name)}})

        # A name is never used twice: a manifest may have arrived whose answer did not, and its objects must stay.
        writer = _Writer(uuid4().hex, full)
        for name in sorted(self._names(), key=lambda name: (not is_state(name), name)):
            self._goes_on()
            for place in (name, name.removesuffix(".part")):  # a recording may have been finished since it was listed
                with suppress(FileNotFoundError):
                    files[place] = self._store(place, stored.get(place), writer)
                    break
        writer.close()
        return files

    def fetch(self, files: Files, *, is_ours: bool, is_running: bool) -> None:
        """Have the folder hold what is newer in the storage.

        Another machine's files replace those of the folder, which are put aside.  Of its own monitor's (`is_ours`) those are
        fetched that it lacks; one that does not go on from the stored one, or that a monitor `is_running` may write, stays, and
        the stored one is put aside.
        """
        files = without_shorter(files)
        aside = self._out / SUPERSEDED / f"{datetime.now(UTC):%Y%m%dT%H%M%S.%fZ}"
        present: dict[str, tuple[int, int]] = {}
        for name in self._names():
            with suppress(FileNotFoundError):  # gone since it was listed
                about = (self._out / name).stat()
                present[name] = about.st_size, about.st_mtime_ns
        if is_ours:
            lacking = to_get(files, present, self._is_gone_on_from)
        else:
            lacking = [
                name
                for name, file in files.items()
                if name not in present or present[name][0] != file.length or not self._is_gone_on_from(name, file)
            ]
            for name in present.keys() - files.keys():
                _put_aside(self._out / name, name, aside)
            for path in (self._out / "state").glob("history.db*"):
                path.unlink()
        for name in lacking:
            try:
                self._get(name, files[name], aside, is_ours=is_ours, is_running=is_running)
            except _UnusableError as error:
                if not is_ours:
                    raise
                _log.error("%s", error)  # the folder has what is left of it
        if lacking or not is_ours:
            _log.warning("%s: %d of %d files fetched", self._out, len(lacking), len(files))

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
            if before is not None and not self._begins(name, file, before):
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
        """Return whether a file begins with what is stored of it."""
        about = os.fstat(file.fileno())
        if about.st_size < before.length:
            return False
        if is_appended(name) and self._known.get(name) == (about.st_ino, _tail_crc32(file, before.length)):
            return True
        return _crc32(file, before.length) == before.crc32

    def _is_gone_on_from(self, name: str, before: StoredFile) -> bool:
        self._goes_on()
        with (self._out / name).open("rb") as file:
            return self._begins(name, file, before)

    def _get(self, name: str, stored: StoredFile, aside: Path, *, is_ours: bool, is_running: bool) -> None:
        """Fetch a file beside its place, and put it there, and aside what was there; or the other way round."""
        path = destination(self._out / name)
        path.parent.mkdir(parents=True, exist_ok=True)
        fetched = path.with_name(path.name + FETCHED)
        self._write(name, stored, fetched)
        there = {place: form for form in forms(name) if (place := destination(self._out / form)).exists()}
        others = {place: form for place, form in there.items() if not _is_beginning(place, fetched)}
        if is_ours and there and (is_running or (is_appended(name) and others)):
            _put_aside(fetched, name, aside)
            return
        for place, form in others.items():
            _put_aside(place, form, aside)
        fetched.replace(path)
        for place in there.keys() - others.keys() - {path}:
            place.unlink()

    def _write(self, name: str, stored: StoredFile, path: Path) -> None:
        """Write the parts of a stored file."""
        crc32 = 0
        with open(path, "wb", opener=private if is_state(name) else None) as target:
            for part in stored.parts:
                self._goes_on()
                answer = self._objects.get(part.object, (part.offset, part.length))
                if answer is None:
                    raise _UnusableError(f"{name}: {part.object} is missing")
                target.write(answer[0])
                crc32 = zlib.crc32(answer[0], crc32)
            if crc32 != stored.crc32:
                raise _UnusableError(f"{name}: not as it was stored")
            target.flush()
            os.fsync(target.fileno())
        os.utime(path, ns=(stored.mtime_ns, stored.mtime_ns))


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


def _crc32(file: BinaryIO, length: int, begin: int = 0) -> int:
    """Compute the CRC-32 of `length` bytes of a file from `begin` on."""
    found = 0
    file.seek(begin)
    for data in _pieces(file, length):
        found = zlib.crc32(data, found)
    return found


def _tail_crc32(file: BinaryIO, length: int) -> int:
    """Compute the CRC-32 of the last of the first `length` bytes of a file."""
    begin = max(0, length - _TAIL_BYTES)
    return _crc32(file, length - begin, begin)


def _is_beginning(path: Path, fetched: Path) -> bool:
    """Return whether a file of the folder has nothing that the fetched one lacks.

    An empty file of lines may have been begun when the stored one was full, and had got another name.
    """
    is_new = path.suffix == ".jsonl" and path.stat().st_size == 0
    return not is_new and begins_with(fetched, path)


def _put_aside(path: Path, name: str, folder: Path) -> None:
    """Move a file of a site into another folder; checkpoints and summaries, which follow from the others, are dropped."""
    if not is_unique(name):
        path.unlink()
        return
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    path.replace(folder / name)
    _log.warning("%s: superseded; kept as %s", path, folder / name)
