"""Copy of a site's output folder in object storage (``s3://BUCKET/NAME``), from which the monitor of another machine goes on.

One worker stores what has changed.  Another one, which touches no disk, says that the monitor is at work, whatever hangs.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from monitor.config import Configuration
from monitor.core import InUseError, MissingInputError, Retry, UserError, Work, Worker
from monitor.service.lease import NoteFile, StoreLease
from monitor.service.manifest import Files, Note, State, left_over, to_delete
from monitor.service.mirror import Mirror
from monitor.service.objects import Objects

_log = logging.getLogger(__name__)


class SiteStore:
    """Copy of an output folder, which is stored every `every_s` from `open` to `close`, and the right to monitor the site.

    `lost` tells that the monitor of another machine has taken the site over; nothing is stored then.
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
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        self.url, self.every_s, self._clock = f"{url.rstrip('/')}/{site}", every_s, clock
        self._objects, self._note = Objects(self.url, client), NoteFile(out)
        self.lease = StoreLease(self._objects, self.url, self._note, every_s, clock, sleep)
        self._mirror = Mirror(out, self._objects, lambda: self._storing.busy.begin())
        self.lost: UserError | None = None
        self._failure: str | None = None
        self._last: State | None = None
        """State in which the site is left; None while it is monitored."""
        self._asked = self._answered = object()
        """What was asked to be stored last, and what that was when the latest storing began."""
        self._storing, self._renewing = self._new_workers()

    def _new_workers(self) -> tuple[Worker[None], Worker[None]]:
        retry = Retry((OSError,), longest_s=self.every_s / 2)
        return (
            Worker("store", Work(idle=self._store, finish=self._store), clock=self._clock),
            Worker("lease", Work(idle=self._renew), retry=retry, clock=self._clock),
        )

    @property
    def failed(self) -> str | None:
        """Why the present files are not stored, or the site may be another machine's; None if all is well."""
        says = (self.lost or self.lease.doubt, self._failure, self._storing.failed, self._renewing.failed)
        return "; ".join(str(reason) for reason in says if reason) or None

    def open(self, *, wait: bool) -> None:
        """Take the site, and fetch its files where the monitor of another machine wrote last.

        Where the storage does not answer, monitoring goes on with the files of this folder, if they are the site's; else
        MissingInputError is raised.  InUseError tells that another monitor is at work, or may be; `wait` until it is known.
        """
        self.lost = self._last = self._failure = None
        self._storing, self._renewing = self._new_workers()
        try:
            self.lease.acquire(wait=wait)
            self._renewing.start()
            self._fetch(is_running=False)
        except InUseError:
            self._renewing.ask_to_end(at_once=True)
            raise
        except OSError as error:
            if not self._note.read().owners:
                self._renewing.ask_to_end(at_once=True)
                with suppress(OSError):
                    self.lease.release()
                raise MissingInputError(f"{self.url}: {error}") from error
            self.lease.present = None  # regained once the storage answers
            self._fail(error)
        self._storing.start()

    def settle(self, timeout_s: float) -> None:
        """Store what has changed up to now, and wait for it for at most `timeout_s`; not where the storage fails."""
        if self.failed is None:
            asked = self._asked = object()
            self._storing.wake()
            self._storing.wait_for(lambda: self._answered is asked, timeout_s)

    def close(self, state: State, timeout_s: float) -> None:
        """Store everything and the state in which the site is left, for at most `timeout_s`."""
        self._last = state
        self._storing.close(timeout_s)
        self._renewing.ask_to_end(at_once=True)

    def _renew(self) -> float | None:
        """Say that the monitor is at work; return when to say so again."""
        try:
            self.lease.renew()
        except InUseError as error:
            self.lost = error
        return None if self.lost else self.every_s / 2

    def _store(self) -> float | None:
        """Store what has changed, and the state in which the site is left; return when to do so again."""
        asked = self._asked
        try:
            if self.lost is None:
                self._store_changes()
            self._failure = None
        except InUseError as error:
            self.lost = error
        except OSError as error:
            self._fail(error)
        self._answered = asked
        return None if self.lost else self.every_s

    def _fail(self, error: OSError) -> None:
        if self._failure is None:
            says = "monitoring goes on, and another machine may take the site over meanwhile"
            _log.warning("%s: %s; %s", self.url, error, says)
        self._failure = str(error)

    def _store_changes(self) -> None:
        if self.lease.present is None:
            self.lease.regain()
            self._fetch(is_running=True)
        assert self.lease.present is not None
        self._commit(self._mirror.store(self.lease.present.files, partial(self._commit, is_all=False)))
        if self._last is not None:
            self.lease.release(self._last)

    def _commit(self, files: Files, *, is_all: bool = True) -> None:
        """Have the manifest name other files, those stored so far if it is time; the folder notes before that it has them."""
        before = self.lease.present
        if before is None or files == before.files or not (is_all or self.lease.is_due):
            self.lease.renew()
            return
        generation = max(self._note.read().generation, before.generation) + 1
        self._note.write(Note(owners=(self.lease.owner,), generation=generation))
        self.lease.renew(files, generation)
        with suppress(OSError):  # they are removed when the site is taken next
            self._objects.delete(to_delete(before.files, files))

    def _fetch(self, *, is_running: bool) -> None:
        """Have the folder hold what is newer in the storage, and note then that it does."""
        present, note = self.lease.present, self._note.read()
        assert present is not None
        self._mirror.fetch(present.files, is_ours=bool(note.owners), is_running=is_running)
        self._note.write(Note(owners=(self.lease.owner,), generation=max(note.generation, present.generation)))
        with suppress(OSError):
            names = [*self._objects.names()]
            # Nobody has the site since these were listed: else they might be another's, which it named meanwhile.
            self.lease.renew(present.files, present.generation)
            self._objects.delete(left_over(names, present.files))


def store_of(settings: Configuration, out: Path, clock: Callable[[], float] = time.monotonic) -> SiteStore | None:
    """Return the copy of an output folder that a site file names; None if it names none."""
    output = settings.output
    if output.store is None:
        return None
    return SiteStore(output.store, settings.site_name, out, output.store_every_s, clock=clock)
