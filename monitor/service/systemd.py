"""What a service and systemd say to each other: signals, and sd_notify(3), a datagram to the socket that systemd names."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
from collections.abc import Callable, Iterator
from typing import Literal


@contextlib.contextmanager
def signals(stop: Callable[[], None], reload: Callable[[], None]) -> Iterator[None]:
    """Have SIGTERM and SIGINT call `stop`, where a second one ends the process at once, and SIGHUP call `reload`."""

    def take(number: int, _: object) -> None:
        if number == signal.SIGHUP:
            reload()
        else:
            stop()
            signal.signal(number, signal.SIG_DFL)

    previous = {n: signal.signal(n, take) for n in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def notify(text: str) -> None:
    """Send a state to systemd, as ``READY=1``, ``WATCHDOG=1`` or ``STOPPING=1``; a failure is ignored, as no socket is."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return
    if address[0] == "@":  # an abstract socket
        address = "\0" + address[1:]
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as out:
        out.connect(address)
        out.sendall(text.encode())


def print_word(word: str) -> None:
    """Print a word on standard error at once."""
    print(word, file=sys.stderr, flush=True)


class Service:
    """What a service tells systemd: that it is ready, and stopping, once, and that it is at work as often as the watchdog asks.

    `told` are the words so far; the word READY is also given to `say`, by default printed on standard error.
    """

    def __init__(self, now: float, say: Callable[[str], None] = print_word) -> None:
        microseconds = os.environ.get("WATCHDOG_USEC", "")
        is_watched = microseconds.isdigit() and os.environ.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        self._every_s = int(microseconds) / 2e6 if is_watched else float("inf")
        self._told_s, self._say = now, say
        self.told: set[str] = set()

    def at_work(self, now: float) -> None:
        """Notify the watchdog, if it is time: at half its limit."""
        if now - self._told_s >= self._every_s:
            self._told_s = now
            notify("WATCHDOG=1")

    def tell(self, word: Literal["READY", "STOPPING"]) -> bool:
        """Say a word, if that was not said; return whether it was said now."""
        if word in self.told:
            return False
        self.told.add(word)
        if word == "READY":
            self._say(word)
        notify(f"{word}=1")
        return True
