"""Threads that do the same again and again beside a test."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable


class Repeating:
    """Repeats acts until the end, whatever becomes of them."""

    def __init__(self) -> None:
        self.done = 0
        self._ended = threading.Event()
        self._threads: list[threading.Thread] = []

    def start(self, act: Callable[[], object], pause_s: float) -> None:
        def work() -> None:
            while not self._ended.wait(pause_s):
                with contextlib.suppress(OSError):
                    act()
                    self.done += 1

        self._threads.append(threading.Thread(target=work))
        self._threads[-1].start()

    def end(self) -> None:
        self._ended.set()
        for thread in self._threads:
            thread.join(30.0)
