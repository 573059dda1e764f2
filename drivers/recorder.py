"""Records all received blocks in files of limited size: in order of arrival, readable after a power cut, within a disk limit."""

from __future__ import annotations

import contextlib
import logging
import os
import re
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from drivers import codec
from drivers.base import ACCELERATION, UNIT_OF, RecordingError, SampleBlock
from drivers.disk import begins_with, sync_folder
from drivers.limits import absurdity
from drivers.mcap_file import scan_messages
from drivers.mcap_writer import McapWriter, arrival
from drivers.settings import RecorderSettings as RecorderSettings

_log = logging.getLogger(__name__)

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_MB, _GB = 1 << 20, 1 << 30
_NAME = re.compile(r"\d{8}T\d{6}\.\d{6}Z-\d{4}(?:-c(\d{1,9}))?\.mcap")
"""Name of a recording: UTC of its first block, a number, and how often the clock had been set back if it had been."""
_PART = ".part"
"""Ending of the name of a file that is being written. [name; drivers.mcap_writer]"""
_MAX_UNFLUSHED_BYTES = 8 * _MB
_MAX_BLOCK_BYTES = 64 * _MB
_FLUSH_SHARE = 0.8
"""Share of `flush_s` after which a flush begins, so that a slow disk has the data in time."""
_MIN_FLUSH_S = 1.0
"""Shortest time between two flushes that the length of the data causes, s."""
_PATIENCE_S = 60.0
"""Length of late data after which the clock was set back rather than blocks delayed. [s; judgement]"""


@dataclass(frozen=True, slots=True)
class RecorderHealth:
    """State of the recording; the counts never decrease."""

    recording: bool
    detail: str
    """Reason why recording is paused, or empty."""
    blocks: int
    """Those written."""
    lost_blocks: int
    """Those that arrived while recording was paused, or that were lost with a failed file."""
    files: int
    """Those begun."""
    removed_files: int


def unfit(block: SampleBlock) -> str | None:
    """Return the reason why a recording cannot hold a block, or None if it can."""
    if (absurd := absurdity(block)) is not None:
        return absurd
    if block.unit != UNIT_OF.get(block.topic):
        return f"topic {block.topic!r} in {block.unit!r}; known: {', '.join(UNIT_OF)}"
    if not block.channels or block.samples.nbytes > _MAX_BLOCK_BYTES:
        return f"a block of {len(block.channels)} channels and {block.samples.nbytes} bytes"
    return None


class Recorder:
    """Recorder of blocks to files that are named by the time of their first block, so that names sort by time.

    The log times of the messages increase strictly in the order of arrival, also from one run to the next.  When the clock was
    set back (a minute of data came more than a minute late), a file begins whose log times begin anew; its name and its
    channels count such restarts.  Reading the files therefore gives the blocks in the order of arrival.  A disk error pauses
    recording and raises nothing, but for a folder that cannot be created; recording is attempted again after `flush_s`.
    """

    def __init__(self, folder: Path, settings: RecorderSettings, clock: Callable[[], float] = time.monotonic) -> None:
        self._folder, self._settings, self._clock = folder, settings, clock
        self._writer: McapWriter | None = None
        self._begun_ns = self._flushed_ns = 0
        self._flushed_s = self._retry_s = clock()
        self._unflushed_bytes = self._unflushed_blocks = 0
        self._has_flushed = False
        """True if the present file has data on the disk."""
        self._detail = ""
        self._keep_bytes = settings.keep_gb * _GB
        self._short_of_room = False
        """True while recording is paused for too little free space."""
        self._received = self._lost = self._files = self._removed = 0
        folder.mkdir(parents=True, exist_ok=True)
        recover(folder)
        latest = _recordings(folder)[-1:]
        self._clocks = _clock(latest[0]) if latest else 0
        """Number of times that the clock was set back."""
        self._log_ns = max((log_ns for _, log_ns, _ in _messages(latest)), default=0)
        """Log time of the latest block, ns."""
        self._late_s = 0.0
        """Length of the latest data, all of which came late, s."""

    @property
    def stamp_ns(self) -> int:
        """Place of the latest block in the order of arrival: its log time, ns, while the clock was never set back."""
        return arrival(self._log_ns, self._clocks)

    def write(self, block: SampleBlock) -> None:
        """Record a block that is not `unfit`."""
        self._follow_clock(block)
        self._log_ns = max(self._log_ns + 1, block.t_ns)
        self._received += 1
        try:
            if self._writer is None and not self._begin_file():
                self._lost += 1
                return
            assert self._writer is not None
            self._unflushed_blocks += 1
            self._unflushed_bytes += block.samples.nbytes
            self._writer.write(block, self._log_ns)
            self.tick()
        except OSError as error:
            self._pause(f"cannot write: {error.strerror or error}")

    def tick(self) -> None:
        """Flush if a flush is due; call from time to time while no block arrives."""
        if self._writer is None or not self._unflushed_blocks:
            return
        waited_s, data_s = self._clock() - self._flushed_s, (self._log_ns - self._flushed_ns) * 1e-9
        flush_s = _FLUSH_SHARE * self._settings.flush_s
        due = waited_s >= flush_s or (data_s >= flush_s and waited_s >= min(_MIN_FLUSH_S, flush_s))
        if due or self._unflushed_bytes >= _MAX_UNFLUSHED_BYTES:
            self.flush()

    def flush(self) -> None:
        """Write all blocks so far to the disk, where they outlast a power cut."""
        if self._writer is None or not self._unflushed_blocks:
            return
        try:
            self._flush(self._writer)
        except OSError as error:
            self._pause(f"cannot write: {error.strerror or error}")

    def limit(self, most_bytes: int) -> None:
        """Bound all recordings to `most_bytes`, where that is less than `keep_gb`; may be called from any thread."""
        self._keep_bytes = min(self._settings.keep_gb * _GB, most_bytes)

    def health(self) -> RecorderHealth:
        """Return the counts so far; may be called from any thread."""
        written = self._received - self._lost
        return RecorderHealth(not self._detail, self._detail, written, self._lost, self._files, self._removed)

    def close(self) -> None:
        """Finish the present file; a second call does no harm."""
        writer, self._writer = self._writer, None
        if writer is None:
            return
        try:
            writer.close()
            sync_folder(self._folder)
        except OSError as error:
            self._detail = f"cannot write: {error.strerror or error}"

    def _follow_clock(self, block: SampleBlock) -> None:
        """Begin log times anew, in a new file, once the clock is believed to have been set back."""
        if block.topic != ACCELERATION:
            return
        is_late = block.t_ns < self._log_ns - _PATIENCE_S * 1e9
        self._late_s = self._late_s + block.length_s if is_late else 0.0
        if self._late_s < _PATIENCE_S:
            return
        _log.warning("the clock of the data was set back; recordings are named by it from here on")
        self.flush()
        self.close()
        self._clocks, self._log_ns, self._late_s = self._clocks + 1, 0, 0.0

    def _begin_file(self) -> bool:
        """Begin a new file; False while recording is paused."""
        if self._clock() < self._retry_s:
            return False
        free = shutil.disk_usage(self._folder).free
        least = self._settings.min_free_gb * _GB
        if self._short_of_room:  # a file fits, so that recording does not stop again at once
            least += self._settings.file_mb * _MB
        if free < least:
            self._pause(f"only {free / _GB:.2f} GiB free")
            self._short_of_room = True
            return False
        self._has_flushed = self._short_of_room = False
        name = _new_name(self._folder, self._log_ns, self._clocks)
        self._writer = McapWriter(name, as_arrived=True, clock=self._clocks)
        self._begun_ns = self._flushed_ns = self._log_ns
        self._flushed_s = self._clock()
        self._files += 1
        return True

    def _flush(self, writer: McapWriter) -> None:
        """Flush the file, remove old files, and finish the file if it is full or disk space is short."""
        writer.flush()
        self._has_flushed = True
        self._flushed_ns, self._flushed_s = self._log_ns, self._clock()
        self._unflushed_blocks = self._unflushed_bytes = 0
        size, s = writer.part_path.stat().st_size, self._settings
        self._remove_oldest(size)
        full = size >= s.file_mb * _MB or self._log_ns - self._begun_ns >= s.file_s * 1e9
        short = shutil.disk_usage(self._folder).free < s.min_free_gb * _GB
        if full or short:
            self._writer = None
            writer.close()
            sync_folder(self._folder)
        if short:
            self._pause("too little free space")
            self._short_of_room = True
        else:
            self._detail = ""  # only now: it records where what it writes reaches the disk

    def _remove_oldest(self, current: int) -> None:
        """Remove the oldest files until all fit into the limit; `current` is the size of the open file, bytes."""
        paths = _recordings(self._folder)
        sizes = [path.stat().st_size for path in paths]
        total = current + sum(sizes)
        for path, size in zip(paths, sizes, strict=True):
            if total <= self._keep_bytes:
                return
            path.unlink()
            self._removed += 1
            total -= size

    def _pause(self, detail: str) -> None:
        """Pause recording for `flush_s`; keep the flushed part of the present file."""
        self._detail = detail
        self._retry_s = self._clock() + self._settings.flush_s
        self._lost += self._unflushed_blocks
        self._unflushed_blocks = self._unflushed_bytes = 0
        writer, self._writer = self._writer, None
        if writer is not None:
            with contextlib.suppress(OSError):
                writer.keep() if self._has_flushed else writer.abort()


def recover(folder: Path) -> None:
    """Give the files that a crash left unfinished their final names.

    The whole blocks of each file can be read.  A file without blocks is removed, and one with which the finished file of its
    name begins, as where an older copy of the folder was restored; the finished one is replaced only by what goes on from it.
    A damaged file, one whose name is no time, and one that goes on otherwise than the finished one get the suffix `.damaged`.
    """
    for path in _recordings(folder):
        try:
            _begun_ns(path)
        except ValueError:
            place = path.with_suffix(".damaged")
            os.replace(path, place)
            _log.warning("%s: its name is no time; set aside as %s", path, place.name)
    for part in sorted(folder.glob("*.mcap.part")):
        name = part.with_suffix("")
        try:
            blocks = sum(1 for _ in scan_messages(part)) if part.stat().st_size else 0
        except RecordingError:
            os.replace(part, name.with_suffix(".damaged"))
            continue
        if not blocks or (name.exists() and begins_with(name, part)):
            part.unlink()
        elif name.exists() and not begins_with(part, name):
            place = name.with_suffix(".damaged")
            os.replace(part, place)
            _log.warning("%s: goes on otherwise than %s; set aside as %s", part, name.name, place.name)
        else:
            with part.open("rb") as file:  # what goes on from these blocks must not outlast them
                os.fsync(file.fileno())
            os.replace(part, name)
    sync_folder(folder)


def recorded(folder: Path, after_ns: int, *, unfinished: bool = False) -> Iterator[tuple[int, SampleBlock]]:
    """Read the recorded blocks after a place in the order of arrival, each with its place (`Recorder.stamp_ns`).

    Damaged blocks and files are logged and left out.  With `unfinished` the file being written is read too, as far as flushed.
    """
    paths = _recordings(folder, _PART if unfinished else "")
    ends = [*(arrival(_begun_ns(path), _clock(path)) for path in paths[1:]), None]
    for path, end in zip(paths, ends, strict=True) if paths else ():
        if end is not None and end <= after_ns:
            continue
        place = path if path.exists() or not unfinished else path.with_name(path.name + _PART)
        for topic, log_ns, data in _messages([place]):
            stamp_ns = arrival(log_ns, _clock(path))
            if stamp_ns <= after_ns:
                continue
            try:
                yield stamp_ns, codec.decode(data, topic)
            except ValueError as error:
                _log.warning("%s, recorded at %d ns: %s; left out", path, log_ns, error)


def _messages(paths: Sequence[Path]) -> Iterator[tuple[str, int, bytes]]:
    """Scan the messages of all files; log damage and continue with the next file."""
    for path in paths:
        try:
            yield from scan_messages(path)
        except RecordingError as error:
            _log.warning("%s; the rest of it is left out", error)


def _recordings(folder: Path, but_for: str = "") -> list[Path]:
    """List the recordings in a folder in the order of their arrival, by their names without the ending `but_for`."""
    named = {path.with_name(path.name.removesuffix(but_for)) for path in folder.iterdir()}
    paths = (path for path in named if _NAME.fullmatch(path.name))
    return sorted(paths, key=lambda path: (_clock(path), path.name))


def _clock(path: Path) -> int:
    """Read from a recording's name how often the clock had been set back."""
    found = _NAME.fullmatch(path.name)
    return int(found[1] or 0) if found else 0


def _begun_ns(path: Path) -> int:
    """Read the log time of a file's first block from its name, ns, rounded down to a microsecond."""
    begun = datetime.strptime(path.name[:22], "%Y%m%dT%H%M%S.%f").replace(tzinfo=UTC)
    return (begun - _EPOCH) // timedelta(microseconds=1) * 1000


def _new_name(folder: Path, t_ns: int, clock: int) -> Path:
    """Choose an unused name by UTC to the microsecond, and by how often the clock was set back."""
    seconds, rest = divmod(t_ns, 1_000_000_000)
    time_text = f"{datetime.fromtimestamp(seconds, UTC):%Y%m%dT%H%M%S}.{rest // 1000:06d}Z"
    numbered = (folder / f"{time_text}-{number:04d}{f'-c{clock}' if clock else ''}.mcap" for number in range(1, 10_000))
    return next(p for p in numbered if not p.exists() and not p.with_name(p.name + ".part").exists())
