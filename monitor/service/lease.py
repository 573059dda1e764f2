"""Who may write a site: the lock of its output folder, and the manifest of its copy in object storage.

The manifest is written on the condition that nobody wrote it since it was read, so that of two monitors one has the site.
Nobody's clock has to be right: a monitor is gone when its manifest has not changed for some of its intervals.  A folder may be
copied or restored with all that is in it, so that it proves nothing alone: each run has a name of its own, and each write too.
"""

from __future__ import annotations

import fcntl
import os
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Protocol
from uuid import uuid4

from pydantic import ValidationError

from drivers.disk import private, sync_folder
from monitor.core import InUseError, MissingInputError, write_atomically
from monitor.service.boot import boot_time
from monitor.service.manifest import LOCK, MANIFEST, NOTE, Files, Manifest, Note, State
from monitor.service.objects import Objects

_LOCK_MODE = 0o600
_LOCK_WAIT_S, _LOCK_POLL_S = 1.0, 0.02
"""Time for which the lock is asked for, and pause between two attempts: `status`, run by the owner or root, holds it for
microseconds.  [s; judgement]"""
_SILENT = 3.0
"""Intervals without another manifest after which its monitor counts as gone. [1; judgement: one write may fail]"""


class Lease(Protocol):
    """Right to write a site, which one process has at a time.

    InUseError tells that another one has it, or may have it.
    """

    def acquire(self) -> None:
        """Become the one who may write."""

    def renew(self) -> None:
        """Check that this one still may, and let others know that it is at work."""

    def release(self) -> None:
        """Let another one write."""


class FolderLease:
    """Lock of an output folder: a file in it, which is made where it is missing; the lock ends with the process.

    Only its owner may open the file, so that nobody who may merely read the folder can hold the lock.
    """

    def __init__(self, out: Path) -> None:
        self._out, self._path, self._handle = out, out / LOCK, -1

    def acquire(self) -> None:
        """Lock the folder; MissingInputError tells that it cannot be written, InUseError that another daemon has locked it."""
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            handle = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, _LOCK_MODE)
            os.fchmod(handle, _LOCK_MODE)  # whatever the umask
        except OSError as error:
            raise MissingInputError(f"{self._out}: cannot be written: {error.strerror}") from error
        deadline = time.monotonic() + _LOCK_WAIT_S
        while True:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                if time.monotonic() >= deadline:
                    os.close(handle)
                    says = f"{self._out}: another daemon writes here; name another dir under [output]"
                    raise InUseError(says) from error
                time.sleep(_LOCK_POLL_S)
            else:
                self._handle = handle
                return

    def renew(self) -> None:
        """Check that the file is the one that is locked: MissingInputError tells that it was removed.  It may wait."""
        try:
            is_own = os.path.samestat(self._path.stat(), os.fstat(self._handle))
        except (FileNotFoundError, NotADirectoryError) as error:
            says = f"{self._out}: was removed while a daemon wrote here, which ends; start it again"
            raise MissingInputError(says) from error
        except OSError:
            return
        if not is_own:
            raise InUseError(
                f"{self._out}: was removed and made anew while a daemon wrote here, which ends; another may write here now"
            )

    def release(self) -> None:
        """Unlock the folder."""
        os.close(self._handle)


class NoteFile:
    """File of an output folder with what the folder knows of the manifest."""

    def __init__(self, out: Path) -> None:
        self._out, self._path = out, out / NOTE

    def read(self) -> Note:
        """Return what the folder knows; nothing where the file cannot be read."""
        try:
            return Note.model_validate_json(self._path.read_text(encoding="ascii"))
        except (OSError, ValueError):
            return Note()

    def write(self, note: Note) -> None:
        """Note what the folder knows, before it is stored."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(self._path, note.model_dump_json(), private)
        sync_folder(self._path.parent)

    def remove(self) -> None:
        """Forget it: the files of this folder are not the latest, and nobody goes on from them."""
        self._path.unlink(missing_ok=True)

    def place(self) -> str:
        """Say in which folder of which machine this is; empty where that cannot be said."""
        boot_id, _ = boot_time()
        try:
            about = (self._out / LOCK).stat()
        except OSError:
            return ""
        return f"{boot_id} {about.st_dev}:{about.st_ino}" if boot_id else ""


class StoreLease:
    """Manifest of a site in object storage, which the monitor of the site writes again and again.

    OSError tells that the storage does not answer; the monitor goes on then, and `doubt` says so once another machine may have
    the site.  Only `acquire` and `is_held` touch a disk.
    """

    def __init__(
        self,
        objects: Objects,
        url: str,
        note: NoteFile,
        every_s: float,
        clock: Callable[[], float],
        sleep: Callable[[float], object],
    ) -> None:
        self._objects, self._url, self._note, self.every_s = objects, url, note, every_s
        self._clock, self._sleep, self.owner, self._place = clock, sleep, "", ""
        self._writing = threading.Lock()
        """Held while the manifest is written; no holder touches a disk."""
        self.present: Manifest | None = None
        """Manifest that this monitor wrote last; None while it does not know whether it has the site."""
        self._tag: str | None = None
        """ETag of the manifest on which the next one is based; None where there was none."""
        self._unanswered: set[str] = set()
        """Names of the writes that may have arrived."""
        self._seen: tuple[str | None, float] | None = None
        """ETag of another's manifest, None where it vanished, and since when it is that one, s."""
        self._renewed_s = 0.0
        """When the latest write that arrived was begun, s."""

    @property
    def doubt(self) -> str | None:
        """Words that say that another machine may monitor the site by now; None while none can."""
        seconds = self._clock() - self._renewed_s
        has_left = not self.owner or (self.present is not None and self.present.state != "held")
        says = f"{self._url}: the site's lease is not renewed for {seconds:.0f} s; another machine may monitor the site"
        return None if has_left or seconds < _SILENT * self.every_s else says

    @property
    def is_due(self) -> bool:
        """Whether it is time to write the manifest again."""
        return self._clock() - self._renewed_s >= self.every_s

    def is_held(self) -> bool:
        """Ask whether the monitor of another machine is at work; where the storage does not answer, it may be."""
        try:
            return self._is_at_work(*self._read())
        except OSError:
            return True

    def has_ended(self) -> bool:
        """Ask whether a monitor has read the source of the site to its end."""
        with suppress(OSError):
            found, _ = self._read()
            return found is not None and found.state == "ended"
        return False

    def acquire(self, *, wait: bool = False) -> None:
        """Take the site; with `wait` it is waited until it is known whether another monitor is at work."""
        self.owner, self._place, self._renewed_s = uuid4().hex, self._note.place(), self._clock()
        found, tag = self._read()
        begun = tag
        while self._is_at_work(found, tag):
            if not wait or tag != begun:
                raise self._in_use(found, "is at work, in another folder")
            self._sleep(min(1.0, self.every_s))
            found, tag = self._read()
        self._take(found, tag)

    def regain(self) -> None:
        """Take the site while the monitor is at work, unless another one, or newer files of this one, came meanwhile."""
        found, tag = self._read()
        if found is not None and not (self._note.read().knows(found) and self._is_from_here(found)):
            raise self._in_use(found, "went on from other files")
        self._take(found, tag)

    def renew(self, files: Files | None = None, generation: int = 0) -> None:
        """Say that the monitor is at work, if it is time; or that it has stored `files`, their state `generation`."""
        with self._writing:
            if self.present is None and files is not None:
                raise OSError(f"{MANIFEST} was lost")
            if self.present is not None and self.present.state == "held" and (files is not None or self.is_due):
                self._write("held", files, generation)

    def release(self, state: State = "released") -> None:
        """Say that the monitor works no more."""
        with self._writing:
            if self.present is not None:
                self._write(state)

    def _read(self) -> tuple[Manifest | None, str | None]:
        """Read the manifest and its ETag; None where there is none."""
        answer = self._objects.get(MANIFEST)
        if answer is None:
            return None, None
        try:
            return Manifest.model_validate_json(answer[0]), answer[1]
        except ValidationError as error:
            raise OSError(f"{MANIFEST} is damaged: {error.errors()[0]['msg']}") from error

    def _in_use(self, found: Manifest | None, says: str) -> InUseError:
        who = "a monitor" if found is None else f"the monitor of {found.machine} (process {found.process})"
        return InUseError(f"{self._url}: {who} {says}")

    def _is_at_work(self, found: Manifest | None, tag: str | None) -> bool:
        """Return whether a manifest is that of a monitor that may be at work elsewhere; one that vanished is stored anew."""
        if (found is None and self._seen is None) or (found is not None and self._is_from_here(found)):
            self._seen = None
            return False
        if self._seen is None or self._seen[0] != tag:
            self._seen = tag, self._clock()
        return self._clock() - self._seen[1] < _SILENT * (self.every_s if found is None else found.every_s)

    def _is_from_here(self, found: Manifest) -> bool:
        """Return whether its monitor has left the site, or was one of this very folder, whose lock says that it is gone."""
        if found.state != "held" or found.owner == self.owner:
            return True
        is_here = found.place != "" and found.place == (self._place or self._note.place())
        return is_here and found.owner in self._note.read().owners

    def _take(self, found: Manifest | None, tag: str | None) -> None:
        """Write the manifest with the files as they are, and note before whether this folder goes on from its own."""
        note = self._note.read()
        if found is None or note.knows(found):
            owners = tuple(dict.fromkeys((*note.owners, self.owner)))
            self._note.write(Note(owners=owners, generation=note.generation))
        else:
            self._note.remove()
        with self._writing:
            self.present, self._tag = found, tag
            try:
                self._write("held")
            except (OSError, InUseError):
                self.present = None
                raise

    def _write(self, state: State, files: Files | None = None, generation: int = 0) -> None:
        """Write the manifest if nobody else did since the one on which it is based; else raise InUseError.

        Without `files` they stay as they are stored.
        """
        for _ in range(2):
            before, begun_s = self.present, self._clock()
            if files is None and before is not None:
                kept, generation = before.files, before.generation
            else:
                kept = dict(files or {})
            manifest = Manifest(
                owner=self.owner,
                machine=socket.gethostname(),
                process=os.getpid(),
                place=self._place,
                generation=generation,
                number=1 if before is None else before.number + 1,
                written=uuid4().hex,
                every_s=self.every_s,
                state=state,
                files=kept,
            )
            self._unanswered.add(manifest.written)
            tag = self._objects.replace(MANIFEST, manifest.model_dump_json().encode(), self._tag)
            if tag is not None:
                self._tag, self.present, self._renewed_s = tag, manifest, begun_s
                self._unanswered.clear()
                return
            self._go_on_from_own()
        raise OSError(f"{MANIFEST} cannot be written")

    def _go_on_from_own(self) -> None:
        """Go on from a write of this process that had arrived without an answer; else raise InUseError.

        OSError tells that the storage has lost what was written, or shows an older one; all is read anew then.
        """
        found, tag = self._read()
        is_own = found is not None and found.owner == self.owner
        if found is not None and is_own and found.written in self._unanswered:
            self.present, self._tag = found, tag
        elif found is None or (is_own and self.present is not None and found.number <= self.present.number):
            self.present = None
            raise OSError(f"{MANIFEST} was removed or replaced by an older one; what it lacks is stored anew")
        else:
            raise InUseError(f"{self._url}: taken over by the monitor of {found.machine}")
