"""Bounded queue between the threads of a transport and the thread that reads."""

from __future__ import annotations

import threading
from collections import deque
from typing import Generic, TypeVar

L = TypeVar("L")


class Inbox(Generic[L]):
    """Queue of payloads, each with a label such as its topic, bounded in bytes; `put` waits while the queue is full.

    A single larger payload is accepted if the queue is empty.  A closed inbox accepts no payload and makes no caller wait;
    payloads that it already holds can still be read.
    """

    def __init__(self, limit_bytes: int) -> None:
        self._limit, self._n_bytes = limit_bytes, 0
        self._items: deque[tuple[L, bytes]] = deque()
        self._changed = threading.Condition()
        self._open = False

    def open(self) -> None:
        """Accept payloads from now on."""
        self._set_open(True)

    def close(self) -> None:
        """Accept no more payloads, and wake all waiting threads."""
        self._set_open(False)

    def put(self, label: L, data: bytes) -> None:
        """Add a payload as soon as there is room; discard the payload if the inbox is closed."""
        with self._changed:
            self._changed.wait_for(
                lambda: not self._open or not self._items or self._n_bytes + len(data) <= self._limit
            )
            if self._open:
                self._items.append((label, data))
                self._n_bytes += len(data)
                self._changed.notify_all()

    def get(self, timeout_s: float) -> tuple[L, bytes] | None:
        """Remove and return the oldest payload with its label; None if none arrives in time, or the inbox is closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._items or not self._open, timeout_s)
            if not self._items:
                return None
            item = self._items.popleft()
            self._n_bytes -= len(item[1])
            self._changed.notify_all()
            return item

    def _set_open(self, is_open: bool) -> None:
        with self._changed:
            self._open = is_open
            self._changed.notify_all()
