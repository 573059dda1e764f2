"""What lies between a transport's threads and the one that reads."""

from __future__ import annotations

import threading
from collections import deque


class Inbox:
    """Payloads with the topic that they came on, bounded in bytes; who puts into a full one waits.

    A closed inbox takes nothing and lets nobody wait; what is in it can still be got.

    Parameters
    ----------
    limit_bytes : int
        One payload always finds room.
    """

    def __init__(self, limit_bytes: int) -> None:
        self._limit, self._held = limit_bytes, 0
        self._items: deque[tuple[str, bytes]] = deque()
        self._changed = threading.Condition()
        self._open = False

    def open(self) -> None:
        """Take payloads from now on."""
        self._set_open(True)

    def close(self) -> None:
        """Take none any more and wake all who wait."""
        self._set_open(False)

    def put(self, topic: str, data: bytes) -> None:
        """Add a payload, when there is room."""
        with self._changed:
            self._changed.wait_for(lambda: not self._open or not self._items or self._held + len(data) <= self._limit)
            if self._open:
                self._items.append((topic, data))
                self._held += len(data)
                self._changed.notify_all()

    def get(self, timeout_s: float) -> tuple[str, bytes] | None:
        """The oldest payload; None if there is none in time, or none and the inbox is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._items or not self._open, timeout_s)
            if not self._items:
                return None
            item = self._items.popleft()
            self._held -= len(item[1])
            self._changed.notify_all()
            return item

    def _set_open(self, is_open: bool) -> None:
        with self._changed:
            self._open = is_open
            self._changed.notify_all()
