"""Long-running monitoring service of one site, as a process of its own: signals, systemd, and the loop that drives a `Site`."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path

from drivers.base import SampleBlock, Source
from monitor.runs import warm_up
from monitor.service import systemd
from monitor.service.outlets import Outlet
from monitor.service.site import Site
from monitor.service.threads import BlockQueue


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
        queue: BlockQueue[SampleBlock] | None = None,
    ) -> None:
        super().__init__(path, source, outlets, clock=clock, quiet_s=quiet_s, queue=queue, warm=warm_up)
        self._tick_s = tick_s

    def run(self) -> None:
        """Monitor until the source ends or SIGTERM or SIGINT arrives; SIGHUP reads the site file again.

        Raises
        ------
        MissingInputError, BadInputError
            The files of the source are missing or unusable.
        """
        with systemd.signals(self.ask_to_stop, self.ask_to_reload):
            try:
                self.start()
                self._loop()
                self.finish()
            finally:
                self.close()
        self.raise_failure()

    def _loop(self) -> None:
        """Evaluate blocks from the queue until it is closed and empty."""
        service = systemd.Service(self._clock())
        while not self.reader.queue.over:
            item = self.reader.queue.take(self._tick_s)
            now = self._clock()
            if self.reader.opened and service.tell_ready():
                self.tell_open()
            service.at_work(now)
            if item is not None:
                self.take(*item)
            self.step(now)
            if self._stopping and service.tell_stopping():
                self.stop_reading()
