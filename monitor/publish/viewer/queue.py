"""One thread between the monitor and Rerun: whatever a viewer or a disk does stays behind a bounded queue."""

from __future__ import annotations

import logging
import re
import socket
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Generic, TypeVar

import rerun as rr
from rerun.chunk import RrdReader

from monitor.core import finish, partial

T = TypeVar("T")

_log = logging.getLogger(__name__)


class Output:
    """A Rerun recording that goes to a file, to viewers that join, or both.

    Parameters
    ----------
    name : str
        Application and recording id, so that the same data give the same recording.
    file : Path, optional
        Takes this name only once complete.
    serve : (str, int), optional
        Address and port to listen on; viewers join at ``rerun+http://ADDRESS:PORT/proxy``.
    memory : str
        What the server keeps for viewers that join late; the oldest goes first.

    Raises
    ------
    OSError, RuntimeError
        The file cannot be made or the port is taken.
    """

    def __init__(self, name: str, file: Path | None, serve: tuple[str, int] | None, memory: str = "64MB") -> None:
        rr.set_strict_mode(True)  # else a wrong call is only warned about
        entry = re.sub(r"[^0-9A-Za-z_ -]+", "-", name)  # what Rerun takes as a name without a warning
        self.stream = rr.RecordingStream(entry, recording_id=entry, send_properties=False)
        self._file = file
        sinks: list[rr.FileSink | rr.GrpcServerSink] = []
        if serve is not None:
            _require_free_port(*serve)
            host = f"[{serve[0]}]" if ":" in serve[0] else serve[0]
            sinks.append(rr.GrpcServerSink(bind_ip=host, port=serve[1], server_memory_limit=memory))
        if file is not None:
            # An index would be kept in memory until the end, an entry for all that is sent by itself.
            sinks.append(rr.FileSink(partial(file), write_footer=False))
        self.stream.set_sinks(*sinks)
        self.stream.set_log_time_enabled(False)  # time is the data's

    def close(self, timeout_s: float) -> None:
        """Write all that is left, see that the file is whole, and give it its name.

        Raises
        ------
        OSError, RuntimeError
            Something did not arrive, as on a full disk; no file is left.
        """
        try:
            self.stream.flush(timeout_sec=timeout_s)
            self.stream.disconnect()
            if self._file is not None:
                # Where writing failed, flush has raised; this raises at half a message, and warns that there is no index.
                with warnings.catch_warnings(action="ignore"):
                    found = RrdReader(partial(self._file)).recordings()
                if not found:
                    raise OSError(f"{self._file}: nothing arrived")
                finish(self._file)
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Let go of the sinks and leave no unfinished file behind."""
        self.stream.disconnect()
        if self._file is not None:
            partial(self._file).unlink(missing_ok=True)


def _require_free_port(address: str, port: int) -> None:
    """Raise OSError if nobody can listen there: Rerun itself only prints that and goes on deaf."""
    with socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((address, port))
        except OSError as error:
            raise OSError(f"cannot serve viewers on {address}:{port}: {error.strerror or error}") from error


class Worker(Generic[T]):
    """A daemon thread that handles items in order.

    Its first exception is logged once and ends the work: `failed` tells, and everything put later is ignored.

    Parameters
    ----------
    run : callable
        Called in the thread with `take`, which returns the next item, or None when the queue is closed and empty.
    size : int
        Items that may wait.
    lossless : bool
        When full, `put` waits; otherwise it drops the item and counts it.
    """

    def __init__(self, name: str, run: Callable[[Callable[[], T | None]], None], size: int, lossless: bool) -> None:
        self.dropped = 0
        self.failed: str | None = None
        self.cancelled = False
        self._run, self._size, self._lossless = run, size, lossless
        self._items: deque[T] = deque()
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)
        self._thread.start()

    def put(self, item: T) -> None:
        """Hand an item over; never raises."""
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
        if self._thread.is_alive() and self.failed is None:
            self._fail(f"not finished within {timeout_s:g} s")

    @property
    def _over(self) -> bool:
        return self._closed or self.failed is not None

    def _take(self) -> T | None:
        with self._changed:
            self._changed.wait_for(lambda: bool(self._items) or self._over)
            if not self._items or self.failed is not None:
                return None
            item = self._items.popleft()
            self._changed.notify_all()
            return item

    def _work(self) -> None:
        try:
            self._run(self._take)
        except Exception as error:  # noqa: BLE001 - the viewer's troubles, of whatever kind, never reach the monitor
            self._fail(f"{type(error).__name__}: {error}")

    def _fail(self, reason: str) -> None:
        with self._changed:
            self.failed = reason
            self.cancelled = True
            self._items.clear()
            self._changed.notify_all()
        _log.error("the Rerun view is off from here on: %s", reason)
