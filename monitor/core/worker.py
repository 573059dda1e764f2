"""The one thread of the monitor: it does pieces of work in order, behind a bounded queue."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar, copy_context
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from monitor.core.bounded_queue import BoundedQueue
from monitor.core.busy import Busy

T = TypeVar("T")

_log = logging.getLogger(__name__)

_MOST_TEXT = 300


@dataclass(frozen=True)
class Work(Generic[T]):
    """What a worker does, each piece in its thread; what it need not do is None."""

    do: Callable[[T], object] | None = None
    """Does one item of the queue."""
    idle: Callable[[], float | None] | None = None
    """Is called while no item waits, first at once; returns after how many seconds it is to be called again, None after
    `Worker.wake` alone."""
    open: Callable[[], object] | None = None
    """Gets what the other pieces need, before the first one, and again after a failure."""
    finish: Callable[[], object] | None = None
    """Is called once after the last item, whether `open` was called or not, and not after an error that ended the work."""
    shut: Callable[[], object] | None = None
    """Lets go what `open` got: after a failure, and at the end, when `Worker.over` is true."""


class Retry:
    """Pauses between attempts that fail one after the other: each is twice as long as the one before, up to the longest.

    After an error of the kinds `of` the same piece of work is tried again.  `due_s` says when the next attempt is due.
    """

    def __init__(self, of: tuple[type[Exception], ...] = (), first_s: float = 0.5, longest_s: float = 30.0) -> None:
        self.of, self._first_s, self._longest_s = of, first_s, longest_s
        self._pause_s, self.due_s = 0.0, -math.inf

    def again(self, now: float) -> float:
        """Note that an attempt failed; return the pause before the next one, s."""
        self._pause_s = min(max(self._first_s, 2.0 * self._pause_s), self._longest_s)
        self.due_s = now + self._pause_s
        return self._pause_s

    def worked(self) -> None:
        """Begin again with the shortest pause."""
        self._pause_s, self.due_s = 0.0, -math.inf


class Hand:
    """Workers without threads: whoever made them has them do one piece after another, by a clock of his own."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self.clock = clock
        self.workers: list[Worker[Any]] = []

    def step(self) -> bool:
        """Have the first worker that has something to do, do one piece of it; return whether one had."""
        return any(worker.step() for worker in self.workers)

    @property
    def due_in_s(self) -> float:
        """Seconds until a worker has something to do; infinite if none will have."""
        return min((worker.due_in_s for worker in self.workers), default=math.inf)


_HAND: ContextVar[Hand | None] = ContextVar("hand", default=None)


@contextmanager
def by_hand(clock: Callable[[], float]) -> Iterator[Hand]:
    """Have the workers that are made meanwhile in this context do without threads (`Hand`)."""
    hand = Hand(clock)
    before = _HAND.set(hand)
    try:
        yield hand
    finally:
        _HAND.reset(before)


class _Mark:
    """Item that shows that all items before it are done."""

    done = False


class Worker(Generic[T]):
    """Thread behind a bounded queue, which does pieces of work in order; it ends with the process.

    `put` and `offer` leave it items; it begins with `start`.  A piece that raises an error of `retry` is done again after a pause
    that grows, with what it needs opened anew; so is `idle` or `open` with any other error.  Any other error of an item costs
    that item, or ends the work where `ends_on_error`.  An error is logged, and told in `failed` until a later piece is done.
    Once it is to end, it does the items that wait, up to the first error of `retry`.  Within ``Worker.by_hand(clock)`` workers
    get no thread.
    """

    by_hand = staticmethod(by_hand)

    def __init__(
        self,
        name: str,
        work: Work[T],
        queue: BoundedQueue[T] | None = None,
        *,
        retry: Retry | None = None,
        ends_on_error: bool = False,
        busy: Busy | None = None,
        clock: Callable[[], float] | None = None,
    ) -> None:
        self._hand = _HAND.get()
        self.clock = clock or (time.monotonic if self._hand is None else self._hand.clock)
        self.name, self._work, self._ends_on_error = name, work, ends_on_error
        self.queue: BoundedQueue[T] = BoundedQueue() if queue is None else queue
        self.retry, self.busy = retry or Retry(), busy or Busy(self.clock)
        self._idle_s = math.inf if work.idle is None else -math.inf
        self._is_open, self.over = work.open is None, False
        self._held: T | _Mark | None = None
        self._error: str | None = None
        self.failure: Exception | None = None
        """Error that ended the work."""
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Begin to work, unless it has begun."""
        if self._thread is not None or (self._hand is not None and self in self._hand.workers):
            return
        if self._hand is not None:
            self._hand.workers.append(self)
            return
        # It knows the context in which it is begun, as the site's name in the log.
        thread = threading.Thread(target=copy_context().run, args=(self._run,), name=self.name, daemon=True)
        thread.start()
        self._thread = thread

    @property
    def failed(self) -> str | None:
        """Words that say that it does not answer, or its latest error; None while all is well."""
        return self.busy.overdue or self._error

    @property
    def dropped(self) -> int:
        """Number of items that found no room."""
        return self.queue.dropped

    def put(self, item: T, key: object = None) -> bool:
        """Leave it an item, as the queue says where it is full; return whether it has it.  Nothing comes of one after the end."""
        if self.over:
            return False
        while self._hand is not None and self.queue.makes_wait(item, key) and self.step():
            continue
        losing, has_it = self.queue.is_losing, self.queue.put(item, key)
        if self.queue.is_losing and not losing:
            _log.warning("%s: %d wait; some are lost from here on", self.name, len(self.queue))
        return has_it

    def offer(self, item: T, key: object = None) -> bool:
        """Leave it an item if there is room; return whether there was."""
        return not self.over and self.queue.offer(item, key)

    def wake(self, in_s: float = 0.0) -> None:
        """Have `idle` called in so many seconds at the latest."""
        with self.queue.changed:
            due_s = self.clock() + in_s
            if due_s < self._idle_s:  # else it is awake by then
                self._idle_s = due_s
                self.queue.changed.notify_all()

    def settle(self, timeout_s: float) -> bool:
        """Wait until what was left so far is done, for at most `timeout_s`; return whether it is."""
        mark = _Mark()
        self.queue.append(mark)  # type: ignore[arg-type]
        return self.wait_for(lambda: mark.done, timeout_s)

    def wait_for(self, done: Callable[[], bool], timeout_s: float) -> bool:
        """Wait until a piece of work has made `done` true, for at most `timeout_s`; return whether it is."""
        if self._thread is None:
            while not done() and self._hand is not None and self in self._hand.workers and self.step():
                continue
            return done()
        with self.queue.changed:
            self.queue.changed.wait_for(lambda: done() or self.over, timeout_s)
        return done()

    def ask_to_end(self, *, at_once: bool = False) -> None:
        """Let it end when what waits is done, or `at_once`, without that; waits for nothing."""
        with self.queue.changed:
            if at_once:
                self.queue.clear()
            self.queue.close()

    def close(self, timeout_s: float) -> bool:
        """Let it end when what waits is done, and wait for that for at most `timeout_s`; return whether it has ended."""
        self.ask_to_end()
        return self.join(timeout_s)

    def join(self, timeout_s: float) -> bool:
        """Wait for the end for at most `timeout_s`; return whether it has come, and tell it in `failed` if it has not."""
        if self._hand is not None:
            self.wait_for(lambda: self.over, timeout_s)
        if self._thread is None or self._thread is threading.current_thread():
            return self.over
        self._thread.join(max(0.0, timeout_s))
        if self._thread.is_alive() and self._error is None:
            self._error = f"not finished within {timeout_s:g} s"
        return self.over

    @property
    def due_in_s(self) -> float:
        """Seconds until the next piece of work is due; infinite if none will be."""
        with self.queue.changed:
            if self.over:
                return math.inf
            if self.queue.is_closed:
                return 0.0
            now = self.clock()
            if self.retry.due_s > now:
                return self.retry.due_s - now
            waits = self._held is not None or not self._is_open or len(self.queue) > 0
            return 0.0 if waits else max(0.0, self._idle_s - now)

    def step(self) -> bool:
        """Do the next piece of work in the calling thread if one is due; return whether one was."""
        if self.due_in_s > 0.0:
            return False
        piece = self._next()
        try:
            with self.busy:
                piece()
        except Exception as error:  # noqa: BLE001 - of whatever kind, an error is told and reaches nobody else
            self._fail(error, piece)
        except BaseException as error:  # such as SystemExit, or a panic of a library in Rust
            if self._hand is not None:
                raise  # it is meant for whoever has the piece done
            told = RuntimeError(f"{type(error).__name__}: {error}")
            told.__cause__ = error
            self._fail(told, piece)
        with self.queue.changed:
            self.queue.changed.notify_all()
        return True

    def _run(self) -> None:
        """Do pieces of work when they are due, to the end (the thread's work)."""
        while not self.over:
            if not self.step():
                with self.queue.changed:
                    due_s = self.due_in_s
                    if due_s > 0.0:
                        self.queue.changed.wait(None if math.isinf(due_s) else due_s)

    def _next(self) -> Callable[[], None]:
        """Return the piece of work that is due."""
        if self._held is None and not self._is_open and not self.queue.over:
            return self._begin
        if self._held is None and (item := self.queue.take(0.0)) is not None:
            self._held = item[0]
        if self._held is not None:
            return self._do if self._is_open else self._begin
        return self._end if self.queue.is_closed else self._idle

    def _begin(self) -> None:
        if self._work.open is not None:
            self._work.open()
            self._error = None
        self._is_open = True

    def _do(self) -> None:
        if isinstance(self._held, _Mark):
            self._held.done = True
        elif self._held is not None and self._work.do is not None:
            self._work.do(self._held)
            self._error = None
            self._worked()
        self._held = None

    def _idle(self) -> None:
        with self.queue.changed:
            self._idle_s = math.inf
        assert self._work.idle is not None
        in_s = self._work.idle()
        if self._work.do is None:
            self._error = None
            self._worked()
        if in_s is not None:
            self.wake(in_s)

    def _worked(self) -> None:
        if self._work.open is None:  # else who opens says when it worked for long enough
            self.retry.worked()

    def _end(self) -> None:
        if self._work.finish is not None:
            self._work.finish()
        self._is_open, self.over = False, True
        self._shut()

    def _fail(self, error: Exception, piece: Callable[[], None]) -> None:
        """Note an error, and decide how the work goes on."""
        is_expected = isinstance(error, self.retry.of)
        text = f"{type(error).__name__}: {error}"[:_MOST_TEXT]
        if text != self._error:
            level = logging.WARNING if is_expected else logging.ERROR
            _log.log(level, "%s: %s", self.name, text, exc_info=None if is_expected else error)
        self._error = text
        if self._ends_on_error and not is_expected:
            self.failure = error
            self.ask_to_end(at_once=True)
        elif piece == self._do and not is_expected:
            self._held = None
            return
        self._is_open, self.over = self._work.open is None, self.queue.is_closed
        if self.over:
            self._held = None
        else:
            self.retry.again(self.clock())
            if self._work.idle is not None:
                self.wake()
        self._shut()

    def _shut(self) -> None:
        if self._work.shut is None:
            return
        try:
            with self.busy:
                self._work.shut()
        except Exception:  # noqa: BLE001 - what cannot be closed is opened anew all the same
            _log.exception("%s: not closed", self.name)
