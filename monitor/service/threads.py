"""Work beside the main thread: reading a source, recording, and small writes to the disk."""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TypeVar

from drivers.base import EndOfStream, SampleBlock, Source, SourceError
from drivers.recorder import Recorder, RecorderHealth, RecorderSettings
from monitor.core import BoundedQueue, Busy, Full, Retry, Work, Worker, write_atomically

_log = logging.getLogger(__name__)

_POLL_S = 0.2
_MOST_TEXT = 300


T = TypeVar("T")


class BlockQueue(BoundedQueue[T]):
    """Bounded queue of blocks and other items, which have no size."""

    def __init__(
        self,
        most_blocks: int = 1024,
        most_bytes: int = 8 << 20,
        changed: Callable[[], None] = lambda: None,
        full: Full = Full.WAIT,
    ) -> None:
        super().__init__(most_blocks, most_bytes, full, size=_size, tell=changed)


def _size(item: object) -> int:
    return item.samples.nbytes if isinstance(item, SampleBlock) else 0


class Reader:
    """Reader of a source in a separate thread, which opens the source again whenever it is lost.

    It puts the blocks into `queue`, which is closed when no more follow, and looks every `poll_s` whether it is to stop.
    `opened` tells that the source has been open, `ended` that it has no more data, `lost` how often it failed or could not be
    opened, and `error` why it did last, empty while it is open.
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
        self.lost, self.error = 0, ""
        work = Work[None](idle=self._read, open=self._open, shut=self._shut)
        self._worker = Worker("source", work, retry=Retry((SourceError,)), ends_on_error=True, busy=busy)

    @property
    def failed(self) -> str | None:
        """Words that say that the source's driver does not answer; None while it does, whether there are data or not."""
        return self._worker.busy.overdue

    @property
    def failure(self) -> Exception | None:
        """Error that ended reading for good, which reopening cannot cure."""
        return self._worker.failure

    @property
    def next_try_s(self) -> float | None:
        """Time until a lost source is opened again, s; None while it is open, or its driver connects it again."""
        return max(0.0, self._worker.retry.due_s - self._worker.clock()) if self.error else None

    def start(self) -> None:
        """Start reading."""
        self._worker.start()

    def stop(self, timeout_s: float) -> None:
        """Stop reading after the blocks that have already arrived; wait for the source to close for at most `timeout_s`."""
        self._worker.ask_to_end()
        self.queue.lift()
        self._worker.join(timeout_s)
        self.queue.close()

    @contextlib.contextmanager
    def _answering(self) -> Iterator[None]:
        """Note what a call of the source says of it."""
        try:
            yield
        except EndOfStream:
            self.ended = True
            self._worker.ask_to_end()
        except SourceError as error:
            self.lost += 1
            self.error = str(error)[:_MOST_TEXT] or type(error).__name__
            raise

    def _open(self) -> None:
        with self._answering():
            self.source.open()
            self.opened = True
            self.error = ""

    def _read(self) -> float:
        """Queue the next block, if one comes in time."""
        block = None
        with self._answering():
            block = self.source.read(self._poll_s)
        if block is not None:
            self._worker.retry.worked()
            self._put(block)
        return 0.0

    def _shut(self) -> None:
        """Close the source; at the end, queue the blocks that it still holds."""
        try:
            self.source.close()
            with contextlib.suppress(EndOfStream, SourceError):
                while self._worker.over and self.failure is None and (block := self.source.read(0.0)) is not None:
                    self._put(block)
        finally:
            if self._worker.over:
                self.queue.close()

    def _put(self, block: SampleBlock) -> None:
        self._worker.busy.end()  # to wait for room is no fault of the source
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
        self._spoiled, self._at_once = 0, False
        queue: BlockQueue[SampleBlock | Job] = BlockQueue(4096, 64 << 20, full=Full.REFUSE)
        idle, finish = (None, None) if self._recorder is None else (self._tick, self._recorder.close)
        self._worker = Worker("recorder", Work(self._do, idle, finish=finish), queue)
        self._worker.start()

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
        return self._worker.failed

    @property
    def dropped(self) -> int:
        """Number of blocks that found no room, or met an error that nobody expected."""
        return self._worker.dropped + self._spoiled

    def limit(self, most_bytes: int) -> None:
        """Bound the recordings to `most_bytes` where that is less than their own limit."""
        if self._recorder is not None:
            self._recorder.limit(most_bytes)

    def write(self, block: SampleBlock, *, at_once: bool = False) -> None:
        """Queue a block for recording, or count it as lost if the queue is full.

        With `at_once` it goes to the disk, with all before it, as soon as no other block waits.
        """
        if self._recorder is not None:
            self._at_once = at_once
            self._worker.put(block)

    def then(self, job: Job) -> bool:
        """Call `job` in the recorder's thread when all blocks so far are on the disk; return False if the queue is full."""
        return self._worker.offer(job)

    def flush(self, timeout_s: float) -> bool:
        """Wait until all blocks queued so far are on the disk; return False if they are not after `timeout_s`.

        A recorder that does not answer is not waited for.
        """
        done = threading.Event()
        asked = self.failed is None and self.then(lambda _: done.set())
        return asked and self._worker.wait_for(done.is_set, timeout_s)

    def close(self, timeout_s: float) -> None:
        """Write the queued blocks and finish the file, for at most `timeout_s`."""
        self._worker.close(timeout_s)

    def _do(self, item: SampleBlock | Job) -> None:
        """Record a block, or do a job; an error costs the block, and the blocks and checkpoints after it are written."""
        recorder = self._recorder
        if isinstance(item, SampleBlock):
            assert recorder is not None
            try:
                recorder.write(item)
                if self._at_once and not len(self._worker.queue):
                    recorder.flush()
            except Exception:
                self._spoiled += 1
                raise
        else:
            if recorder is not None:
                recorder.flush()
            item(0 if recorder is None else recorder.stamp_ns)

    def _tick(self) -> float:
        assert self._recorder is not None
        self._recorder.tick()
        return 1.0


class Chores:
    """Small jobs that may wait for the disk, in a separate thread so that no other thread waits.

    Of waiting jobs with the same name only the latest is done.
    """

    dropped = 0  # the latest job of a name stands for those before

    def __init__(self, name: str = "chores") -> None:
        self._errors: dict[Path, str] = {}
        self._worker: Worker[Callable[[], object]] = Worker(name, Work(lambda job: job()))
        self._worker.start()
        self.settle, self.close = self._worker.settle, self._worker.close

    def do(self, name: str, job: Callable[[], object]) -> None:
        """Queue a job, which must not raise."""
        self._worker.put(job, name)

    def write(self, path: Path, text: str, is_allowed: Callable[[], bool] = lambda: True) -> None:
        """Queue the writing of a small file, if it is allowed then; a failure shows in `failed` until the file is written."""
        self.do(str(path), partial(self._write, path, text, is_allowed))

    @property
    def failed(self) -> str | None:
        """Reason for which a file could not be written last, or for which none is written; None if there is none."""
        return self._worker.failed or next((f"{path}: {reason}" for path, reason in self._errors.copy().items()), None)

    def _write(self, path: Path, text: str, is_allowed: Callable[[], bool]) -> None:
        if not is_allowed():
            return
        try:
            write_atomically(path, text)
            self._errors.pop(path, None)
        except OSError as error:
            self._errors[path] = str(error.strerror)
            _log.warning("%s: %s", path, error.strerror)
