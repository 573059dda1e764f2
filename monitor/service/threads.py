"""Threads of the daemon besides the main one: reading a source, recording, and small writes to the disk."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from contextvars import copy_context
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Generic, TypeVar

from drivers.base import EndOfStream, SampleBlock, Source, SourceError
from drivers.recorder import Recorder, RecorderHealth, RecorderSettings
from monitor.core import Busy, write_atomically

_log = logging.getLogger(__name__)

_POLL_S = 0.2
_LEAST_WAIT_S, _LONGEST_WAIT_S = 0.5, 30.0
_MOST_TEXT = 300


T = TypeVar("T")


def background(work: Callable[[], None], name: str) -> threading.Thread:
    """Create a thread that knows the site for whose work it is created (`monitor.service.logs`), and ends with the process."""
    return threading.Thread(target=copy_context().run, args=(work,), name=name, daemon=True)


class BlockQueue(Generic[T]):
    """Bounded queue of blocks and other items, in order; when it is full, `put` waits, and `offer` refuses.

    A single block of any size fits an empty queue.  `changed` is called when an item was appended or the queue was closed, so
    that one thread can wait for many queues.
    """

    def __init__(
        self, most_blocks: int = 1024, most_bytes: int = 8 << 20, changed: Callable[[], None] = lambda: None
    ) -> None:
        self._most_blocks, self._most_bytes, self._tell = most_blocks, most_bytes, changed
        self._items: deque[tuple[T, float]] = deque()
        self._bytes = 0
        self._closed = self._unbounded = False
        self._changed = threading.Condition()

    def put(self, block: T) -> None:
        """Append a block; wait until there is room for it."""
        arrived_s = time.monotonic()
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._unbounded or self._has_room(_size(block)))
            self._append(block, arrived_s)

    def offer(self, block: T) -> bool:
        """Append a block if there is room for it; return whether there was."""
        with self._changed:
            if not self._has_room(_size(block)):
                return False
            self._append(block, time.monotonic())
            return True

    def take(self, timeout_s: float) -> tuple[T, float] | None:
        """Remove and return the next block and its time of arrival (monotonic clock, s).

        None is returned if no block arrives within `timeout_s` or the queue is closed and empty.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._items or self._closed, timeout_s)
            if not self._items:
                return None
            block, arrived_s = self._items.popleft()
            self._bytes -= _size(block)
            self._changed.notify_all()
            return block, arrived_s

    def lift(self) -> None:
        """Remove the bounds, so that a waiting `put` returns: the thread that calls it is about to end."""
        with self._changed:
            self._unbounded = True
            self._changed.notify_all()

    def close(self) -> None:
        """Close the queue: no call waits any more, and items in the queue can still be taken."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._tell()

    @property
    def first_s(self) -> float | None:
        """Time of arrival of the next block (monotonic clock, s); None if no block waits."""
        with self._changed:
            return self._items[0][1] if self._items else None

    @property
    def over(self) -> bool:
        """True if the queue is closed and empty."""
        with self._changed:
            return self._closed and not self._items

    def __len__(self) -> int:
        return len(self._items)

    def _append(self, block: T, arrived_s: float) -> None:
        self._items.append((block, arrived_s))
        self._bytes += _size(block)
        self._changed.notify_all()
        self._tell()

    def _has_room(self, size: int) -> bool:
        fits = len(self._items) < self._most_blocks and self._bytes + size <= self._most_bytes
        return fits or not self._items  # else a block larger than the bound would wait for ever


def _size(item: object) -> int:
    return item.samples.nbytes if isinstance(item, SampleBlock) else 0


class Reader:
    """Reader of a source in a separate thread, which opens the source again whenever it is lost.

    It puts the blocks into `queue`, which is closed when no more follow, and looks every `poll_s` whether it is to stop.
    `opened` tells that the source has been open, `ended` that it has no more data, `lost` how often it failed or could not be
    opened, and `error` why it did last, empty while it is open.  `failure` is an error that ended reading for good, which
    reopening cannot cure.
    """

    dropped = 0  # the source waits while the queue is full

    def __init__(
        self,
        source: Source,
        queue: BlockQueue[SampleBlock] | None = None,
        poll_s: float = _POLL_S,
        busy: Busy | None = None,
    ) -> None:
        self.source, self._poll_s = source, poll_s
        self.queue: BlockQueue[SampleBlock] = BlockQueue() if queue is None else queue
        self.opened = self.ended = False
        self.failure: Exception | None = None
        self.lost = 0
        self.error, self._again_s = "", 0.0
        self._received = 0
        self._busy = Busy() if busy is None else busy
        self._stop = threading.Event()
        self._thread = background(self._work, "reader")

    @property
    def failed(self) -> str | None:
        """Words that say that the source's driver does not answer; None while it does, whether there are data or not."""
        return self._busy.overdue

    @property
    def next_try_s(self) -> float | None:
        """Time until a lost source is opened again, s; None while it is open, or its driver connects it again."""
        return max(0.0, self._again_s - time.monotonic()) if self.error else None

    def start(self) -> None:
        """Start reading."""
        self._thread.start()

    def stop(self, timeout_s: float) -> None:
        """Stop reading after the blocks that have already arrived; wait for the source to close for at most `timeout_s`."""
        self._stop.set()
        self.queue.lift()
        if self._thread.is_alive():  # else it has ended, or could not be started
            self._thread.join(timeout_s)
        self.queue.close()

    def _work(self) -> None:
        """Read until the source ends, fails for good or is stopped (the thread's work)."""
        wait_s = _LEAST_WAIT_S
        while not self._stop.is_set():
            before = self._received
            try:
                self._read()
            except EndOfStream:
                self.ended = True
                break
            except SourceError as error:
                self.lost += 1
                self.error = str(error)[:_MOST_TEXT] or type(error).__name__
                wait_s = _LEAST_WAIT_S if self._received > before else min(2.0 * wait_s, _LONGEST_WAIT_S)
                self._again_s = time.monotonic() + wait_s
                _log.warning("source lost: %s; opening it again in %.1f s", self.error, wait_s)
            except Exception as error:  # noqa: BLE001 - the main thread raises it again
                self.failure = error
                break
            finally:
                with self._busy:
                    self.source.close()
            self._stop.wait(wait_s)
        try:
            if self.failure is None:
                self._drain()
        finally:
            self.queue.close()

    def _drain(self) -> None:
        """Queue the blocks that a closed source still holds."""
        with contextlib.suppress(EndOfStream, SourceError):
            while (block := self.source.read(0.0)) is not None:
                self.queue.put(block)

    def _read(self) -> None:
        """Open the source and queue its blocks until it raises or reading is stopped."""
        with self._busy:
            self.source.open()
        self.opened = True
        self.error = ""
        while not self._stop.is_set():
            with self._busy:
                block = self.source.read(self._poll_s)
            if block is not None:
                self._received += 1
                self.queue.put(block)


Job = Callable[[int], None]
"""Function that is called when all blocks before it are on the disk, with the log time of the last one (ns)."""


class Recording:
    """Recorder in a separate thread, behind a queue that holds minutes of data, so that a slow disk delays nothing.

    While the queue is full, as when a disk hangs, blocks and jobs are refused; lost blocks are counted in `dropped`.  If the
    recorder is not `enabled` in its settings, nothing is recorded but jobs are still done.
    """

    def __init__(self, folder: Path, settings: RecorderSettings) -> None:
        self._recorder = Recorder(folder, settings) if settings.enabled else None
        self._queue: BlockQueue[SampleBlock | Job] = BlockQueue(4096, 64 << 20)
        self._busy = Busy()
        self._error: str | None = None
        """Error that nobody expected, of the latest block; None if there was none."""
        self.dropped, self._losing, self._at_once = 0, False, False
        self._thread = background(self._work, "recorder")
        self._thread.start()

    def health(self) -> RecorderHealth | None:
        """Return the health of the recorder; None if nothing is to be recorded."""
        if self._recorder is None:
            return None
        health, overdue = self._recorder.health(), self.failed
        health = replace(health, lost_blocks=health.lost_blocks + self.dropped)
        return health if overdue is None else replace(health, recording=False, detail=overdue)

    @property
    def failed(self) -> str | None:
        """Words that say that the recorder does not answer, or fails; None while it works, whether it records or pauses."""
        return self._busy.overdue or self._error

    def limit(self, most_bytes: int) -> None:
        """Bound the recordings to `most_bytes` where that is less than their own limit."""
        if self._recorder is not None:
            self._recorder.limit(most_bytes)

    def write(self, block: SampleBlock, *, at_once: bool = False) -> None:
        """Queue a block for recording, or count it as lost if the queue is full.

        With `at_once` it goes to the disk, with all before it, as soon as no other block waits.
        """
        if self._recorder is None:
            return
        self._at_once = at_once
        taken = self._queue.offer(block)
        if not taken and not self._losing:
            _log.error("recorder: %d blocks wait; blocks are lost from here on", len(self._queue))
        self._losing = not taken
        self.dropped += self._losing

    def then(self, job: Job) -> bool:
        """Call `job` in the recorder's thread when all blocks so far are on the disk; return False if the queue is full."""
        return self._queue.offer(job)

    def flush(self, timeout_s: float) -> bool:
        """Wait until all blocks queued so far are on the disk; return False if they are not after `timeout_s`.

        A recorder that does not answer is not waited for.
        """
        done = threading.Event()
        return self.failed is None and self.then(lambda _: done.set()) and done.wait(timeout_s)

    def close(self, timeout_s: float) -> None:
        """Write the queued blocks and finish the file, for at most `timeout_s`."""
        self._queue.close()
        self._thread.join(timeout_s)

    def _work(self) -> None:
        """Record blocks and do jobs until the queue is closed and empty (the thread's work)."""
        while not self._queue.over:
            item = self._queue.take(1.0)
            with self._busy:
                self._do_all_the_same(None if item is None else item[0])
        if self._recorder is not None:
            self._recorder.close()

    def _do_all_the_same(self, item: SampleBlock | Job | None) -> None:
        """Do what `_do` does; an error that nobody expected costs a block, is told, and does not end the thread."""
        try:
            self._do(item)
        except Exception as error:  # noqa: BLE001 - the blocks and checkpoints after it are written all the same
            self.dropped += isinstance(item, SampleBlock)
            if self._error is None:
                _log.exception("recorder: a block or a job failed")
            self._error = f"{type(error).__name__}: {error}"[:_MOST_TEXT]
        else:
            self._error = None if isinstance(item, SampleBlock) else self._error

    def _do(self, item: SampleBlock | Job | None) -> None:
        """Record a block, or do a job; None gives the recorder time to flush."""
        recorder = self._recorder
        if isinstance(item, SampleBlock):
            assert recorder is not None
            recorder.write(item)
            if self._at_once and not len(self._queue):
                recorder.flush()
        elif item is not None:
            if recorder is not None:
                recorder.flush()
            item(0 if recorder is None else recorder.stamp_ns)
        elif recorder is not None:
            recorder.tick()


class Chores:
    """Worker for small jobs that may wait for the disk, in a separate thread so that no other thread waits.

    Of waiting jobs with the same name only the latest is done.
    """

    dropped = 0  # the latest job of a name stands for those before

    def __init__(self, name: str = "chores") -> None:
        self._jobs: dict[str, Callable[[], object]] = {}
        self._errors: dict[Path, str] = {}
        self._changed = threading.Condition()
        self._closed = False
        self._busy = Busy()
        self._thread = background(self._work, name)
        self._thread.start()

    def do(self, name: str, job: Callable[[], object]) -> None:
        """Queue a job, which must not raise."""
        with self._changed:
            self._jobs[name] = job
            self._changed.notify_all()

    def write(self, path: Path, text: str, is_allowed: Callable[[], bool] = lambda: True) -> None:
        """Queue the writing of a small file, if it is allowed then; a failure shows in `failed` until the file is written."""
        self.do(str(path), partial(self._write, path, text, is_allowed))

    @property
    def failed(self) -> str | None:
        """Reason for which a file could not be written last, or for which none is written; None if there is none."""
        return self._busy.overdue or next((f"{path}: {reason}" for path, reason in self._errors.copy().items()), None)

    def settle(self, timeout_s: float) -> None:
        """Wait until the jobs that are queued now are done, for at most `timeout_s`."""
        done = threading.Event()
        self.do(f"settle {id(done)}", done.set)
        done.wait(timeout_s)

    def close(self, timeout_s: float) -> None:
        """Do the queued jobs, for at most `timeout_s`."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(timeout_s)

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._jobs or self._closed)
                if not self._jobs:
                    return
                job = self._jobs.pop(next(iter(self._jobs)))
            with self._busy:
                try:
                    job()
                except Exception:  # noqa: BLE001 - the jobs after it, the ledger's among them, are done all the same
                    _log.exception("%s: a job failed", self._thread.name)

    def _write(self, path: Path, text: str, is_allowed: Callable[[], bool]) -> None:
        if not is_allowed():
            return
        try:
            write_atomically(path, text)
            self._errors.pop(path, None)
        except OSError as error:
            self._errors[path] = str(error.strerror)
            _log.warning("%s: %s", path, error.strerror)
