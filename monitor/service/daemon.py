"""Long-running monitoring service of one site, as a process of its own: signals, systemd, and the loop that drives a `Site`."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from drivers.base import Source
from monitor.runs import warm_up
from monitor.service import systemd
from monitor.service.outlets import Outlet
from monitor.service.site import Site


class Daemon(Site):
    """Monitoring service of one site.

    Parameters
    ----------
    tick_s : float
        Longest wait for a block before requests and deadlines are looked at, s.

    Raises
    ------
    MissingInputError, BadInputError, BadConfigurationError
        As `Site` raises them.
    """

    def __init__(
        self,
        path: Path,
        source: Source | None = None,
        outlets: Sequence[Outlet] = (),
        *,
        clock: Callable[[], float] = time.monotonic,
        tick_s: float = 0.2,
        quiet_s: float = 10.0,
    ) -> None:
        super().__init__(path, source, outlets, clock=clock, quiet_s=quiet_s, warm=warm_up)
        self._tick_s = tick_s

    def run(self) -> None:
        """Monitor until the source ends or SIGTERM or SIGINT arrives; SIGHUP reads the site file again.

        Raises
        ------
        MissingInputError, BadInputError
            The files of the source are missing or unusable.
        """
        previous = {number: signal.signal(number, self._request_stop) for number in (signal.SIGTERM, signal.SIGINT)}
        previous[signal.SIGHUP] = signal.signal(signal.SIGHUP, self._request_reload)
        try:
            self.start()
            self._loop()
            self.finish()
        finally:
            self.close()
            for number, handler in previous.items():
                signal.signal(number, handler)
        self.raise_failure()

    def _request_stop(self, number: int, _: object) -> None:
        """Handle SIGTERM and SIGINT: stop within the deadlines."""
        self.ask_to_stop()
        signal.signal(number, signal.SIG_DFL)  # a second signal ends the process at once

    def _request_reload(self, number: int, _: object) -> None:
        """Handle SIGHUP: read the site file again in the main loop."""
        self.ask_to_reload()

    def _loop(self) -> None:
        """Evaluate blocks from the queue until it is closed and empty."""
        ready, stop_sent = False, False
        watchdog_s, notified_s = systemd.watchdog_s(), self._clock()
        while not self.reader.queue.over:
            item = self.reader.queue.take(self._tick_s)
            now = self._clock()
            if self.reader.opened and not ready:
                ready = True
                print("READY", file=sys.stderr, flush=True)
                systemd.notify("READY=1")
                self.tell_open()
            if watchdog_s is not None and now - notified_s >= watchdog_s:
                notified_s = now
                systemd.notify("WATCHDOG=1")
            if item is not None:
                self.take(*item)
            self.step(now)
            if self._stopping and not stop_sent:
                stop_sent = True
                systemd.notify("STOPPING=1")
                self.stop_reading()
