"""Files of a site in object storage (``s3://BUCKET/NAME``), from which the monitor of another machine goes on.

One object, the manifest, says who monitors the site and in which objects its files stand.  It is written on the condition that
nobody wrote it since it was read, so that what is stored is always the work of one monitor after another, never a mixture.
Nobody's clock has to be right: a monitor is gone when its manifest has not changed for some of its intervals.

A folder may be copied or restored with all that is in it, so that it proves nothing alone: each run has a name of its own, the
manifest says in which folder of which machine it works, and counts the states of the files, of which the folder knows the latest.
"""

from __future__ import annotations

import logging
import os
import re
import socket
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from functools import lru_cache
from itertools import zip_longest
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO, Literal, NamedTuple
from uuid import uuid4

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from drivers.disk import destination, private, sync_folder
from monitor.config import Configuration
from monitor.core import Busy, InUseError, MissingInputError, import_extra, write_atomically
from monitor.service.boot import boot_time
from monitor.service.threads import background

_log = logging.getLogger(__name__)

_MANIFEST = "manifest.json"
_LOCK = "state/lock"
"""File that a monitor of this folder holds open and locked, so that no other file has its number meanwhile."""
_NOTE = "state/owner"
"""File with what this folder knows of the manifest (`_Note`); it is not stored."""
_SUPERSEDED = "superseded"
"""Folder for what a folder held when the monitor of another machine had gone on meanwhile."""
_FETCHED = ".fetched"
"""What the name of a file ends with until it was fetched."""
_OWN = re.compile(rf"{_LOCK}|{_NOTE}|state/history\.db.*|{_SUPERSEDED}/.*|.*\{_FETCHED}")
"""Files that stay on this machine: the database repeats results.jsonl, and changes anywhere at any time."""
_APPENDED = re.compile(r".*\.(jsonl|mcap|mcap\.part)")
"""Files to which bytes are only appended; others are small, and read again when they have changed."""
_TAIL_BYTES = 4096
"""Length of the end of such a file by which it is known again. [bytes; judgement: lines and messages differ by their times]"""
_SILENT = 3.0
"""Intervals without another manifest after which its monitor counts as gone. [1; judgement: one write may fail]"""
OBJECT_BYTES = 4 << 20
"""Longest object. [bytes; cost: it is held in memory, and the manifest is not written while it is sent]"""
_TIMEOUT_S = 5.0
"""Longest wait for a connection, or for an answer. [s; judgement]"""
_CONNECTIONS = 32
"""Most connections of the process at the same time. [1; cost]"""
_CONFLICTS = {"PreconditionFailed", "ConditionalRequestConflict"}
_ABSENT = {"NoSuchKey", "404"}


State = Literal["held", "released", "ended"]
"""Whether the owner of a site monitors it, has stopped, or has read the source to its end."""


class Part(NamedTuple):
    """Bytes of a file: `length` bytes of an object from `offset` on."""

    object: str
    offset: int
    length: int


class StoredFile(BaseModel):
    """One file: its parts in order, the CRC-32 of all of it, and its time of change, ns since 1970."""

    model_config = ConfigDict(frozen=True)

    parts: tuple[Part, ...] = ()
    crc32: int
    mtime_ns: int

    @property
    def length(self) -> int:
        """Length of the file, bytes."""
        return sum(part.length for part in self.parts)


class Manifest(BaseModel):
    """What is stored of a site, and who monitors it."""

    model_config = ConfigDict(frozen=True)

    owner: str = Field(min_length=1)
    """Name of the run of a monitor, drawn when it took the site."""
    machine: str
    process: int = 0
    """Number of its process there."""
    place: str = ""
    """Start of the machine's kernel and number of the folder's lock on its file system: no copy of the folder has the same."""
    generation: int = 0
    """Counts the states of the files."""
    number: int
    """Counts how often the manifest was written, so that each one differs from the one before."""
    every_s: float
    state: State
    files: dict[str, StoredFile]

    @field_validator("files")
    @classmethod
    def _stay_in_the_folder(cls, files: dict[str, StoredFile]) -> dict[str, StoredFile]:
        for name in files:
            if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts or _OWN.fullmatch(name):
                raise ValueError(f"{name!r} is no file of a site")
        return files


class _Note(BaseModel):
    """What a folder knows of the manifest, written before the manifest itself: so a folder that knows less is an older one."""

    owners: tuple[str, ...] = ()
    """Names under which its monitor may have written the manifest last."""
    generation: int = 0
    """State of the files that it has, or newer ones."""


class SiteStore:
    """Copy of a site's output folder in object storage, ``s3://BUCKET/NAME/SITE``, and the right to monitor the site.

    From `open` to `close` a thread stores what has changed every `every_s`, and another one, which touches no disk, says that
    the monitor is at work, whatever other threads wait for.  `is_lost` tells that the monitor of another machine has taken the
    site over.
    """

    dropped = 0  # what could not be stored is stored by a later attempt

    def __init__(
        self,
        url: str,
        site: str,
        out: Path,
        every_s: float,
        *,
        clock: Callable[[], float] = time.monotonic,
        client: Callable[[], Any] | None = None,
        thread: Callable[[Callable[[], None], str], threading.Thread] = background,
    ) -> None:
        self._client, self._new_thread = client or _client, thread
        self.url = f"{url.rstrip('/')}/{site}"
        bucket, _, prefix = self.url.removeprefix("s3://").partition("/")
        self._bucket, self._prefix, self._out, self.every_s, self._clock = bucket, f"{prefix}/", out, every_s, clock
        self._owner = uuid4().hex
        self._place = ""
        self._writing = threading.Lock()
        """Held while the manifest is written; no holder touches a disk."""
        self._present: Manifest | None = None
        self._tag: str | None = None
        """ETag of the manifest on which the next one is based; None where there was none."""
        self._seen: tuple[str, float] | None = None
        """ETag of another's manifest, and since when it is that one, s."""
        self._committed_s = float("-inf")
        self._known: dict[str, tuple[int, int]] = {}
        """Number of the file and CRC-32 of its end, as it was stored, for files to which bytes are appended."""
        self.is_lost = False
        self._failure: str | None = None
        self._busy = Busy(clock)
        self._changed = threading.Condition()
        self._asked: list[threading.Event] = []
        """Set when what has changed up to now is stored."""
        self._last: State | None = None
        """State to store before the thread ends; None while it goes on."""
        self._threads: tuple[threading.Thread, ...] = ()

    @property
    def failed(self) -> str | None:
        """Why the present files are not stored; None while they are."""
        return self._failure or self._busy.overdue

    def is_held(self) -> bool:
        """Ask whether the monitor of another machine is at work; where the storage does not answer, it may be."""
        try:
            found, tag = self._read()
        except OSError:
            return True
        return self._is_at_work(found, tag)

    def has_ended(self) -> bool:
        """Ask whether a monitor has read the source of the site to its end."""
        try:
            found, _ = self._read()
        except OSError:
            return False
        return found is not None and found.state == "ended"

    def open(self, *, wait: bool) -> None:
        """Take the site, and fetch its files where the monitor of another machine wrote last.

        Where the storage does not answer, monitoring goes on with the files of this folder, if they are the site's.  With
        `wait` it is waited until it is known whether another monitor is at work.  InUseError tells that one is, or may be;
        MissingInputError that the storage does not answer, or lacks files, and that the folder has none to go on from;
        MissingExtraError that the extra `s3` is not installed.
        """
        self._owner, self._place = uuid4().hex, self._here()
        try:
            found, tag = self._read()
            begun = tag
            while found is not None and self._is_at_work(found, tag):
                if not wait or tag != begun:
                    raise self._in_use(found, "is at work, in another folder")
                time.sleep(min(1.0, self.every_s))
                found, tag = self._read()
            self._take(found, tag)
        except OSError as error:
            if not self._note().owners:
                raise MissingInputError(f"{self.url}: {error}") from error
            self._fail(error)
        self._last = None
        self._threads = self._new_thread(self._work, "store"), self._new_thread(self._stay, "lease")
        for thread in self._threads:
            thread.start()

    def settle(self, timeout_s: float) -> None:
        """Store what has changed up to now, and wait for it for at most `timeout_s`; not where the storage fails."""
        if self.failed is not None:
            return
        done = threading.Event()
        with self._changed:
            self._asked.append(done)
            self._changed.notify_all()
        done.wait(timeout_s)

    def close(self, state: State, timeout_s: float) -> None:
        """Store everything and the state in which the site is left, for at most `timeout_s`."""
        with self._changed:
            self._last = state
            self._changed.notify_all()
        end_s = time.monotonic() + timeout_s
        for thread in self._threads:
            thread.join(max(0.0, end_s - time.monotonic()))

    def _stay(self) -> None:
        """Say that the monitor is at work until it is closed (the thread's work)."""
        while True:
            with self._changed:
                if self._changed.wait_for(lambda: self._last is not None, self.every_s / 2):
                    return
            self.renew()

    def renew(self) -> None:
        """Say that the monitor is at work, if it is time; touches no disk."""
        try:
            with self._writing:
                present = self._present
                if present is not None and (present.owner, present.state) == (self._owner, "held") and self._is_due():
                    self._write_manifest("held", present.files, present.generation)
        except InUseError as error:
            self._lose(error)
        except OSError as error:
            self._fail(error)

    def _work(self) -> None:
        """Store what has changed, again and again (the thread's work)."""
        last = None
        while last is None:
            with self._changed:
                self._changed.wait_for(lambda: self._asked or self._last is not None, self.every_s)
                asked, self._asked = self._asked, []
                last = self._last
            try:
                self.push(last or "held")
            except Exception as error:  # noqa: BLE001 - the next attempt is made all the same
                _log.exception("%s: not stored", self.url)
                self._failure = f"{type(error).__name__}: {error}"
            for done in asked:
                done.set()

    def push(self, state: State = "held") -> None:
        """Store what has changed; a failure shows in `failed`, and the loss of the site in `is_lost`."""
        if self.is_lost:
            return
        try:
            if self._present is None:  # the storage has not answered before, or has lost the manifest
                found, tag = self._read()
                if found is not None and not (self._is_own(found) and self._is_from_here(found)):
                    raise self._in_use(found, "went on from other files")
                self._take(found, tag)
            self._store_changes(state)
        except InUseError as error:
            self._lose(error)
        except OSError as error:
            self._fail(error)
        else:
            if self._failure is not None:
                _log.warning("%s: stored again", self.url)
            self._failure = None

    def _in_use(self, found: Manifest, says: str) -> InUseError:
        return InUseError(f"{self.url}: the monitor of {found.machine} (process {found.process}) {says}")

    def _lose(self, error: InUseError) -> None:
        self.is_lost, self._failure = True, str(error)

    def _fail(self, error: OSError) -> None:
        if self._failure is None:
            _log.warning(
                "%s: %s; monitoring goes on, and another machine may take the site over meanwhile", self.url, error
            )
        self._failure = str(error)

    def _is_at_work(self, found: Manifest | None, tag: str | None) -> bool:
        """Return whether a manifest is that of a monitor that may be at work elsewhere."""
        if found is None or self._is_from_here(found):
            self._seen = None
            return False
        assert tag is not None
        if self._seen is None or self._seen[0] != tag:
            self._seen = tag, self._clock()
        return self._clock() - self._seen[1] < _SILENT * found.every_s

    def _here(self) -> str:
        """Say in which folder of which machine this monitor works; empty where that cannot be said."""
        boot_id, _ = boot_time()
        try:
            about = (self._out / _LOCK).stat()
        except OSError:
            return ""
        return f"{boot_id} {about.st_dev}:{about.st_ino}" if boot_id else ""

    def _is_from_here(self, found: Manifest) -> bool:
        """Return whether a manifest is that of no monitor elsewhere: one that has left the site, or one of this very folder.

        The lock of the folder says that the latter is gone.
        """
        if found.state != "held" or found.owner == self._owner:
            return True
        return found.owner in self._note().owners and found.place != "" and found.place == (self._place or self._here())

    def _is_own(self, found: Manifest) -> bool:
        """Return whether the files of this folder are as new as those of a manifest, which its monitor wrote."""
        note = self._note()
        return found.owner == self._owner or (found.owner in note.owners and found.generation <= note.generation)

    def _demand_own(self, found: Manifest | None) -> None:
        """Check that a manifest is one of this run, if there is one; else raise InUseError."""
        if found is not None and found.owner != self._owner:
            raise InUseError(f"{self.url}: taken over by the monitor of {found.machine}")

    def _take(self, found: Manifest | None, tag: str | None) -> None:
        """Become the one who writes the manifest, else raise InUseError; fetch the files unless those of this folder are newer.

        Where files are fetched the note is written last: of a folder whose files were not all fetched nobody goes on.
        """
        note = self._note()
        is_own = found is None or self._is_own(found)
        if is_own:
            self._keep_note(note.generation, note.owners)
        else:  # the files of this folder are not the latest: nobody goes on from them
            (self._out / _NOTE).unlink(missing_ok=True)
        files = {} if found is None else found.files
        with self._writing:
            self._present, self._tag = found, tag
        try:
            self._commit("held", files)
            if not is_own:
                self._fetch(files)
            self._keep_note(note.generation if found is None or is_own else found.generation)
        except OSError:
            self._present = None
            raise
        self._remove_others({_MANIFEST} | _objects(files))

    def _note(self) -> _Note:
        """Return what this folder knows of the manifest."""
        try:
            return _Note.model_validate_json((self._out / _NOTE).read_text(encoding="ascii"))
        except (OSError, ValueError):
            return _Note()

    def _keep_note(self, generation: int, owners: tuple[str, ...] = ()) -> None:
        """Note, before it is stored, which state of the files this folder has, and the names of its monitor."""
        place = self._out / _NOTE
        place.parent.mkdir(parents=True, exist_ok=True)
        names = dict.fromkeys((*owners, self._owner))
        write_atomically(place, _Note(owners=tuple(names), generation=generation).model_dump_json(), private)
        sync_folder(place.parent)

    # The storage.  All of it raises OSError where it does not answer.

    def _read(self) -> tuple[Manifest | None, str | None]:
        """Read the manifest and its ETag; None where there is none."""
        answer = self._ask("get_object", Key=_MANIFEST)
        if answer is None:
            return None, None
        body, tag = answer
        try:
            return Manifest.model_validate_json(body), tag
        except ValidationError as error:
            raise OSError(f"{_MANIFEST} is damaged: {error.errors()[0]['msg']}") from error

    def _commit(self, state: State, files: dict[str, StoredFile]) -> None:
        """Write the manifest if nobody else did since the one on which it is based; else raise InUseError."""
        before = self._present
        generation = 0 if before is None else before.generation
        if before is not None and files != before.files:
            generation += 1
            self._keep_note(generation)
        with self._writing:
            self._write_manifest(state, files, generation)
        if before is not None:
            self._remove(_objects(before.files) - _objects(files))

    def _write_manifest(self, state: State, files: dict[str, StoredFile], generation: int) -> None:
        """Do that, with the lock held."""
        before = self._present
        manifest = Manifest(
            owner=self._owner,
            machine=socket.gethostname(),
            process=os.getpid(),
            place=self._place,
            generation=generation,
            number=1 if before is None else before.number + 1,
            every_s=self.every_s,
            state=state,
            files=files,
        )
        body = manifest.model_dump_json().encode()
        for _ in range(2):
            condition = {"IfNoneMatch": "*"} if self._tag is None else {"IfMatch": self._tag}
            answer = self._ask("put_object", Key=_MANIFEST, Body=body, **condition)
            if answer is not None:
                self._tag, self._present, self._committed_s = answer[1], manifest, self._clock()
                return
            found, tag = self._read()  # refused: a write of ours may have arrived whose answer did not
            self._demand_own(found)  # before its tag is taken: by another's the other thread would write over it
            self._tag = tag
            if found is None and before is not None:
                self._present = None
                raise OSError(f"{_MANIFEST} was removed; all files are stored anew")
        raise OSError(f"{_MANIFEST} cannot be written")

    def _store_changes(self, state: State) -> None:
        """Store what has changed since the files that are stored.

        Checkpoints come first: the other files may be newer than these, as after a kill, but never older.
        """
        assert self._present is not None
        stored, files = self._present.files, dict[str, StoredFile]()

        def put(name: str, data: bytes) -> None:
            self._ask("put_object", Key=name, Body=data)
            self._say_at_work(stored | {name: file for name, file in files.items() if not _is_state(name)})

        # A name is never used twice: a manifest may have arrived whose answer did not, and its objects must stay.
        writer = _Objects(f"{self._present.number:09d}-{uuid4().hex}", put)
        for name in sorted(self._files(), key=lambda name: (not _is_state(name), name)):
            with suppress(FileNotFoundError):  # gone since it was listed
                files[name] = self._store(name, stored.get(name), writer)
        writer.close()
        self._commit(state, files)

    def _say_at_work(self, files: dict[str, StoredFile] | None = None) -> None:
        """Write the manifest, with the files given or those before, if it is time: much is being stored or fetched."""
        assert self._present is not None
        if self._is_due():
            self._commit("held", self._present.files if files is None else files)

    def _is_due(self) -> bool:
        return self._clock() - self._committed_s >= self.every_s

    def _files(self) -> Iterator[str]:
        """List the names of the files that are kept in the storage."""
        for folder, _, names in os.walk(self._out):
            for name in names:
                path = Path(folder, name).relative_to(self._out).as_posix()
                if not _OWN.fullmatch(path):
                    yield path

    def _store(self, name: str, before: StoredFile | None, writer: _Objects) -> StoredFile:
        """Store what a file has got at its end, or all of it where it is another file.

        Parts that are no longer than what follows them are stored again with it, so that there are few.
        """
        with (self._out / name).open("rb") as file:
            about = os.fstat(file.fileno())
            if before is not None and (before.length, before.mtime_ns) == (about.st_size, about.st_mtime_ns):
                return before
            parts: list[Part] = []
            known = crc32 = 0
            if before is not None and before.length <= about.st_size and self._goes_on(name, file, before):
                parts, known, crc32 = [*before.parts], before.length, before.crc32
            begin = known
            while parts and parts[-1].length <= about.st_size - begin:
                begin -= parts.pop().length
            file.seek(begin)
            for data in _pieces(file, about.st_size - begin):
                crc32 = zlib.crc32(data[max(0, known - begin) :], crc32)
                begin += len(data)
                parts.append(writer.add(data))
            self._known[name] = about.st_ino, _tail_crc32(file, begin)
        return StoredFile(parts=tuple(parts), crc32=crc32, mtime_ns=about.st_mtime_ns)

    def _goes_on(self, name: str, file: BinaryIO, before: StoredFile) -> bool:
        """Return whether a file begins with what is stored of it."""
        if _APPENDED.fullmatch(name):
            known = os.fstat(file.fileno()).st_ino, _tail_crc32(file, before.length)
            if self._known.get(name) == known:
                return True
        file.seek(0)
        return _crc32(file, before.length) == before.crc32

    def _fetch(self, files: dict[str, StoredFile]) -> None:
        """Have the folder hold the stored files; those that it has already are not fetched.

        What nobody could get back is put aside: what this machine recorded and judged while another one had the site.
        """
        aside, fetched = self._out / _SUPERSEDED / f"{datetime.now(UTC):%Y%m%dT%H%M%S.%fZ}", 0
        for name in [*self._files()]:
            if name not in files:
                _put_aside(self._out / name, name, aside)
        for name, file in files.items():
            path = destination(self._out / name)
            if path.exists() and _is_content(path, file):
                continue
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary = path.with_name(path.name + _FETCHED)
            with open(temporary, "wb", opener=private if _is_state(name) else None) as target:
                self._write(name, file, target)
            if path.exists() and not _begins_with(temporary, path):
                _put_aside(path, name, aside)
            os.utime(temporary, ns=(file.mtime_ns, file.mtime_ns))
            temporary.replace(path)
            fetched += 1
        for path in (self._out / "state").glob("history.db*"):
            path.unlink()
        _log.warning("%s: %d of %d files fetched", self.url, fetched, len(files))

    def _write(self, name: str, file: StoredFile, target: BinaryIO) -> None:
        """Write the parts of a stored file, and meanwhile go on to say that this monitor is at work."""
        crc32 = 0
        for part in file.parts:
            span = f"bytes={part.offset}-{part.offset + part.length - 1}"
            answer = self._ask("get_object", Key=part.object, Range=span)
            if answer is None:
                raise OSError(f"{name}: {part.object} is missing")
            target.write(answer[0])
            crc32 = zlib.crc32(answer[0], crc32)
            self._say_at_work()
        if crc32 != file.crc32:
            raise OSError(f"{name}: not as it was stored")
        target.flush()
        os.fsync(target.fileno())

    def _remove_others(self, kept: set[str]) -> None:
        """Remove the objects of the site that nothing refers to: those of writes that came to nothing."""
        with suppress(OSError):
            self._remove({name for name in self._list() if name not in kept})

    def _list(self) -> Iterator[str]:
        with _told():
            pages = self._client().get_paginator("list_objects_v2").paginate(Bucket=self._bucket, Prefix=self._prefix)
            for page in pages:
                yield from (entry["Key"].removeprefix(self._prefix) for entry in page.get("Contents", ()))

    def _remove(self, names: set[str]) -> None:
        with suppress(OSError):  # they are removed when the site is taken next
            for name in names:
                self._ask("delete_object", Key=name)

    def _ask(self, what: str, *, Key: str, **options: Any) -> tuple[bytes, str] | None:  # noqa: N803 - the name of the interface
        """Call the storage; return body and ETag of the answer, None where there is no such object or the condition fails."""
        with self._busy, _told():
            try:
                answer = getattr(self._client(), what)(Bucket=self._bucket, Key=self._prefix + Key, **options)
            except self._client().exceptions.ClientError as error:
                if error.response["Error"]["Code"] in _CONFLICTS | _ABSENT:
                    return None
                raise
            return answer["Body"].read() if "Body" in answer else b"", answer.get("ETag", "")


def store_of(settings: Configuration, out: Path, clock: Callable[[], float] = time.monotonic) -> SiteStore | None:
    """Return the copy of an output folder that a site file names; None if it names none."""
    output = settings.output
    if output.store is None:
        return None
    return SiteStore(output.store, settings.site_name, out, output.store_every_s, clock=clock)


class _Objects:
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


def _is_state(name: str) -> bool:
    return name.startswith("state/")


def _objects(files: dict[str, StoredFile]) -> set[str]:
    return {part.object for file in files.values() for part in file.parts}


def _pieces(file: BinaryIO, length: int) -> Iterator[bytes]:
    """Read the next bytes of a file, in pieces that fit an object; fewer where the file is shorter."""
    while length > 0 and (data := file.read(min(length, OBJECT_BYTES))):
        length -= len(data)
        yield data


def _crc32(file: BinaryIO, length: int) -> int:
    """Compute the CRC-32 of the first bytes of a file."""
    found = 0
    for data in _pieces(file, length):
        found = zlib.crc32(data, found)
    return found


def _put_aside(path: Path, name: str, folder: Path) -> None:
    """Move a file of a site into another folder; checkpoints and summaries, which follow from the others, are dropped."""
    if _is_state(name) or name == "summary.json":
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


@lru_cache(1)
def _client() -> Any:
    """Return the process's client of the storage; access is by the usual ``AWS_`` variables or ``~/.aws``."""
    what = "output.store"
    config = import_extra("botocore.config", what).Config(
        connect_timeout=_TIMEOUT_S,
        read_timeout=_TIMEOUT_S,
        max_pool_connections=_CONNECTIONS,
        retries={"total_max_attempts": 1},  # the next attempt is the next interval's
    )
    return import_extra("botocore.session", what).get_session().create_client("s3", config=config)


@contextmanager
def _told() -> Iterator[None]:
    """Turn errors of the storage into OSError with one line."""
    errors = import_extra("botocore.exceptions", "output.store")
    try:
        yield
    except (errors.BotoCoreError, errors.ClientError) as error:
        raise OSError(" ".join(str(error).split())) from error
