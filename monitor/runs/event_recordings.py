"""Recordings of events: the samples of each event as they came, in a file of its own, with what the site's files say."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from pathlib import Path

from drivers.base import SampleBlock
from drivers.mcap_file import McapWriter
from monitor.core import sha256
from monitor.events import Event, EventSettings
from monitor.runs.recent_blocks import MARGIN_S, RecentBlocks

_log = logging.getLogger(__name__)

_GB = 1 << 30
"""One GiB. [bytes; definition]"""
FOLDER = "events"
"""Folder of the recordings, beside results.jsonl. [name; contract of events.jsonl]"""
ABOUT = "event"
"""Name of the metadata record of a recording. [name; definition]"""


def at_once(_: str, job: Callable[[], None]) -> None:
    """Do a job, which has a name, now."""
    job()


class EventRecordings:
    """Keep the latest blocks, and write those of each event into the folder ``events`` of the results' folder.

    `run` does a job of some name that writes a file, now or in another thread.  `note` takes the name and the SHA-256 of each
    recording that is written, in the thread that wrote it.  `failed` says why the latest recording could not be written.
    """

    dropped = 0  # a recording that cannot be written is told by `failed`

    def __init__(
        self,
        out: Path,
        settings: EventSettings,
        run: Callable[[str, Callable[[], None]], None] = at_once,
        note: Callable[[str, str], None] | None = None,
    ) -> None:
        self._out, self._settings, self._run, self._note = out, settings, run, note
        self.failed: str | None = None
        self._recent = RecentBlocks(settings.pre_s)
        self._bytes = _used(out / FOLDER)
        self._refused: set[str] = set()

    @property
    def reach_s(self) -> float:
        """Length of data that an event may need."""
        s = self._settings
        return s.pre_s + s.longest_s + s.merge_s + s.post_s + MARGIN_S

    def push(self, block: SampleBlock, *, active: bool) -> None:
        """Keep a block; without an event that goes on, only those that the next one may need."""
        self._recent.push(block, drop=not active)

    def save(self, event: Event, about: Mapping[str, str]) -> str | None:
        """Write the samples of an event's final line; return the file's name, or None where it has none.

        `about`, what the site's files say, is written into the file's metadata.  Where the budget of ``[events] keep_gb`` is
        full, nothing is written, and a log line says so.
        """
        name = f"{FOLDER}/{event.id}.mcap"
        if event.revision is None or event.id in self._refused:
            return None
        if event.revision == 0:
            if self._bytes > self._settings.keep_gb * _GB:
                _log.error(
                    "events: %s has no recording: [events] keep_gb = %g is full", event.id, self._settings.keep_gb
                )
                self._refused.add(event.id)
                return None
            first_ns = event.begin_ns - round(self._settings.pre_s * 1e9)
            last_ns = event.end_ns + round(self._settings.post_s * 1e9)
            blocks = [
                b
                for b in self._recent.blocks
                if b.t_ns + round(b.samples.shape[0] / b.sample_rate_hz * 1e9) >= first_ns and b.t_ns < last_ns
            ]
            self._run(name, lambda: self._write(name, blocks, about))
        return name

    def _write(self, name: str, blocks: list[SampleBlock], about: Mapping[str, str]) -> None:
        """Write blocks in the order of their times."""
        path = self._out / name
        try:
            with McapWriter(path, {ABOUT: about}) as file:
                for block in sorted(blocks, key=lambda b: b.t_ns):
                    file.write(block)
            self._bytes = _used(path.parent)
            if self._note is not None:
                self._note(name, sha256(path))
            self.failed = None
        except OSError as error:
            self.failed = f"{path}: {error.strerror}"
            _log.error("events: %s cannot be written: %s", path, error.strerror)


def _used(folder: Path) -> int:
    """Return the size of the recordings and the pages in a folder, bytes; a page counts from the next recording on."""
    return sum(path.stat().st_size for path in folder.glob("*") if path.suffix in (".mcap", ".html"))
