"""Queue between threads, bounded by number and bytes."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from enum import Enum
from typing import Generic, TypeVar

T = TypeVar("T")


class Full(Enum):
    """What becomes of an item for which a queue has no room."""

    WAIT = "wait"
    """Who puts it waits for room."""
    REFUSE = "refuse"
    """It is refused and counted."""
    OLDEST = "oldest"
    """The oldest items give way and are counted."""


class BoundedQueue(Generic[T]):
    """Queue of items in order, bounded by their number and by their bytes, which `size` tells.

    A single item of any size fits an empty queue.  An item with the key of one that waits takes its place.  `tell` is called when
    an item came or the queue was closed, so that one thread can wait for many queues.  `changed` is notified then, and when an
    item was taken.  `dropped` counts the items that were lost because it was full; `is_losing` says that the latest `put` lost
    one.
    """

    def __init__(
        self,
        most: float = math.inf,
        most_bytes: float = math.inf,
        full: Full = Full.WAIT,
        *,
        size: Callable[[T], int] = lambda _: 0,
        tell: Callable[[], None] = lambda: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._most, self._most_bytes, self._full = most, most_bytes, full
        self._size, self._tell, self._clock = size, tell, clock
        self._items: dict[object, tuple[T, float, int]] = {}
        self._bytes, self.dropped = 0, 0
        self.is_closed = self.is_losing = self._is_lifted = False
        self.changed = threading.Condition()

    def put(self, item: T, key: object = None) -> bool:
        """Append an item as `full` says where there is no room; return whether the queue has it."""
        arrived_s = self._clock()
        with self.changed:
            self.changed.wait_for(lambda: not self.makes_wait(item, key))
            self.is_losing = not self._has_room(item, key)
            while self._full is Full.OLDEST and not self._has_room(item, key):
                self._pop()
                self.dropped += 1
            if self._has_room(item, key):
                self._append(item, key, arrived_s, self._size(item))
                return True
            self.dropped += 1
            return False

    def offer(self, item: T, key: object = None) -> bool:
        """Append an item if there is room for it; return whether there was.  Nobody waits, and nothing is counted."""
        with self.changed:
            if not self._has_room(item, key):
                return False
            self._append(item, key, self._clock(), self._size(item))
            return True

    def append(self, item: T) -> None:
        """Append an item without a size, whether there is room or not."""
        with self.changed:
            self._append(item, None, self._clock(), 0)

    def take(self, timeout_s: float) -> tuple[T, float] | None:
        """Remove and return the next item and its time of arrival, s.

        None is returned if none arrives within `timeout_s` or the queue is closed and empty.
        """
        with self.changed:
            if timeout_s > 0.0:
                self.changed.wait_for(lambda: self._items or self.is_closed, timeout_s)
            return self._pop() if self._items else None

    def clear(self) -> None:
        """Remove all items, which are not counted."""
        with self.changed:
            while self._items:
                self._pop()

    def lift(self) -> None:
        """Remove the bounds, so that a waiting `put` returns: the thread that calls it is about to end."""
        with self.changed:
            self._is_lifted = True
            self.changed.notify_all()

    def close(self) -> None:
        """Close the queue: no call waits any more, and items in the queue can still be taken."""
        with self.changed:
            self.is_closed = True
            self.changed.notify_all()
        self._tell()

    @property
    def first_s(self) -> float | None:
        """Time of arrival of the next item, s; None if none waits."""
        with self.changed:
            return next(iter(self._items.values()))[1] if self._items else None

    @property
    def over(self) -> bool:
        """True if the queue is closed and empty."""
        with self.changed:
            return self.is_closed and not self._items

    def makes_wait(self, item: T, key: object = None) -> bool:
        """Return whether `put` would wait now."""
        return self._full is Full.WAIT and not self._has_room(item, key)

    def _has_room(self, item: T, key: object) -> bool:
        fits = len(self._items) < self._most and self._bytes + self._size(item) <= self._most_bytes
        # Without the third an item larger than the bound would wait for ever.
        return fits or self.is_closed or not self._items or self._is_lifted or key in self._items

    def __len__(self) -> int:
        return len(self._items)

    def _append(self, item: T, key: object, arrived_s: float, size: int) -> None:
        key = object() if key is None else key
        if key in self._items:
            self._bytes -= self._items[key][2]
        self._items[key] = item, arrived_s, size
        self._bytes += size
        self.changed.notify_all()
        self._tell()

    def _pop(self) -> tuple[T, float]:
        item, arrived_s, size = self._items.pop(next(iter(self._items)))
        self._bytes -= size
        self.changed.notify_all()
        return item, arrived_s
