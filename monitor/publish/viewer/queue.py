"""Thread between the monitor and Rerun: delays and errors of a viewer or a disk stay behind a bounded queue."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

from monitor.core import Busy

T = TypeVar("T")

_log = logging.getLogger(__name__)


class Worker(Generic[T]):
    """Daemon thread that handles items in order.

    `run` is called in the thread with a function that returns the next item, or None when the queue is closed and empty.  While
    `size` items wait, `put` waits too if `lossless`; otherwise it drops the item and counts it.  The first exception is logged
    once and ends the work: `failed` holds the reason, and later items are ignored.  While the thread is with one item for long,
    `failed` says that it does not answer.
    """

    def __init__(self, name: str, run: Callable[[Callable[[], T | None]], None], size: int, lossless: bool) -> None:
        self.dropped = 0
        self._failure: str | None = None
        self._busy = Busy()
        self.cancelled = False
        self._run, self._size, self._lossless = run, size, lossless
        self._items: deque[T] = deque()
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)
        self._thread.start()

    def put(self, item: T) -> None:
        """Append an item to the queue; never raises."""
        with self._changed:
            if self._lossless:
                self._changed.wait_for(lambda: len(self._items) < self._size or self._over)
            if self._over:
                return
            if len(self._items) < self._size:
                self._items.append(item)
                self._changed.notify_all()
            else:
                self.dropped += 1

    def close(self, timeout_s: float, *, cancel: bool = False) -> None:
        """Let the thread end, at once if cancelled, and wait for it no longer than `timeout_s`."""
        deadline = time.monotonic() + timeout_s
        with self._changed:
            self._closed, self.cancelled = True, self.cancelled or cancel
            if cancel:
                self._items.clear()
            self._changed.notify_all()
        self._thread.join(max(0.0, deadline - time.monotonic()))
        if self._thread.is_alive() and self._failure is None:
            self._fail(f"not finished within {timeout_s:g} s")

    @property
    def failed(self) -> str | None:
        """Reason for which the work has ended or does not go on; None if it does."""
        return self._failure or self._busy.overdue

    @property
    def _over(self) -> bool:
        """Whether the queue takes no more items."""
        return self._closed or self._failure is not None

    def _take(self) -> T | None:
        """Wait for the next item; return None when the queue is closed and empty."""
        self._busy.end()
        with self._changed:
            self._changed.wait_for(lambda: bool(self._items) or self._over)
            if not self._items or self._failure is not None:
                return None
            item = self._items.popleft()
            self._changed.notify_all()
        self._busy.begin()
        return item

    def _work(self) -> None:
        """Run the work and record its first exception."""
        try:
            self._run(self._take)
        except Exception as error:  # noqa: BLE001 - the viewer's troubles, of whatever kind, never reach the monitor
            self._fail(f"{type(error).__name__}: {error}")

    def _fail(self, reason: str) -> None:
        """Record the reason of a failure, end the work and log it."""
        with self._changed:
            self._failure = reason
            self.cancelled = True
            self._items.clear()
            self._changed.notify_all()
        self._busy.end()
        _log.error("the Rerun view is off from here on: %s", reason)
