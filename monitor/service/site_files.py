"""Files of a site's output folder, and the threads that write them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from monitor.config import Configuration
from monitor.core import MissingInputError, UserError
from monitor.publish import EVENTS
from monitor.service import restart
from monitor.service.appended_lines import AppendedLines
from monitor.service.component import Every
from monitor.service.daemon_health import HealthLines, Vitals
from monitor.service.history import History
from monitor.service.lease import FolderLease, Lease
from monitor.service.site_store import SiteStore
from monitor.service.storage import EventsFile, ResultsFile, Storage
from monitor.service.threads import Chores, Recording

END_S = 4.5
"""Deadline after the stop signal for everything to end. [s; definition: 5 s are promised]"""
_CHECK_S = 1.0
"""Interval at which the lock is looked at. [s; judgement]"""
_HEALTH_FILE_BYTES = 16 << 20
"""Length from which health.jsonl is begun anew. [bytes; judgement]"""


class Claim:
    """Right to write into an output folder, and into its copy in object storage: a lock, looked at again and again.

    `lost` says that the folder was removed, or may be another daemon's.
    """

    name, way = "claim", None

    def __init__(self, out: Path, settings: Configuration, undo: ExitStack) -> None:
        restart.make_private(out / "state", out)
        self._lease: Lease = FolderLease(out)
        self._lease.acquire()
        undo.callback(self._lease.release)
        restart.note_site(out / "state", settings)
        self.store: SiteStore | None = None
        self.lost: UserError | None = None

    def holds(self) -> bool:
        """Look whether the folder is still this site's, and note its loss (in a thread that may wait for the disk)."""
        try:
            self._lease.renew()
        except UserError as error:
            self.lost = error
            if self.store is not None:
                self.store.lost = error  # the copy keeps what the folder had
        return self.lost is None

    def keep(self, timeout_s: float) -> None:
        """Have the copy follow the folder, for at most `timeout_s`."""
        if self.store is not None:
            self.store.settle(timeout_s)

    def watch(self, chores: Chores, now: float) -> None:
        """Have `step` look at the lock from now on."""
        self._look = Every(_CHECK_S, partial(chores.do, "lock", self.holds), now)

    def step(self, now: float) -> None:
        """Look at the lock if it is time; raise the loss of the folder or of its copy, if it is known."""
        self._look(now)
        if self.lost is not None:
            raise self.lost
        if self.store is not None and self.store.lost is not None:
            raise self.store.lost

    def close(self, timeout_s: float) -> None:
        """Give the folder up."""
        self._lease.release()


class SiteFiles:
    """Files of an output folder.  MissingInputError tells that one cannot be written; `undo` closes what was opened."""

    def __init__(
        self,
        path: Path,
        settings: Configuration,
        healthy_path: Path | None,
        out: Path,
        vitals: Vitals,
        clock: Callable[[], float],
        quiet_s: float,
        undo: ExitStack,
    ) -> None:
        # Lines are written by a thread that waits for no fsync, so that health.jsonl can say that the others wait for one.
        self.chores, self.line_writer = Chores(), Chores("lines")
        self.event_writer = Chores("events")  # a page takes a second or two, for which no other file waits
        for chores in (self.chores, self.line_writer, self.event_writer):
            undo.callback(chores.close, END_S)
        later = self.line_writer.do
        try:
            results, by_month = out / "results.jsonl", settings.output.pack_months
            self.results = ResultsFile(results, by_month=by_month, run=partial(later, "results.jsonl"))
            undo.callback(self.results.close)
            lines = AppendedLines(out / "health.jsonl", _HEALTH_FILE_BYTES, partial(later, "health.jsonl"))
            undo.callback(lines.close)
            self.health = HealthLines(lines, vitals, self.line_writer, clock, quiet_s)
            self.events = EventsFile(out / EVENTS, partial(later, EVENTS))
            undo.callback(self.events.close)
            self.health.tell_start()
            self.recording = Recording(out / "recordings", settings.recorder)
            undo.callback(self.recording.close, END_S)
            self.storage = Storage(out, settings.output, self.recording)
            self.keeper = restart.Checkpointer(out, settings, healthy_path, self.recording, self.results)
            restart.note_baseline(out, path, healthy_path)
        except OSError as error:
            named = "" if error.filename is None else f"{error.filename}: "
            raise MissingInputError(f"{out}: cannot be written: {named}{error.strerror}") from error
        spans = settings.processing.hop_s, settings.health.span_s
        self.history = History(out / "state" / "history.db", settings.state, *spans)
        undo.callback(self.history.close, END_S)

    def close_lines(self, timeout_s: float) -> None:
        """Have the files of lines closed."""
        for lines in (self.results, self.events, self.health.way):
            self.chores.do(f"close {id(lines)}", lines.close)
