"""Many sites spread over processes, one a core: a process that dies or hangs is started again, and its sites go on.

Each process is ``python -m monitor.service.host_worker``; it says that it is ready and at work as a service says it to systemd.
"""

from __future__ import annotations

import contextlib
import logging
import os
import select
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from monitor.service import systemd
from monitor.service.host_metrics import WorkersMetrics

_log = logging.getLogger(__name__)

_TICK_S = 0.2
"""Longest wait for a word of a process. [s; judgement]"""
_RETRY_S = (0.5, 20.0)
"""First and longest pause before a process that died is started again. [s; judgement: its sites go on within half a minute]"""
_STEADY_S = 10.0
"""Time after which a process that died had been well, so that another is started at once. [s; judgement: longer than a start]"""
_SILENT_S = 120.0
"""Time without a word after which a process counts as hung, and is ended. [s; judgement: a window takes milliseconds]"""
_END_S = 70.0
"""Time in which the processes end after the stop signal, longer than they take themselves; others are killed. [s; judgement]"""


@dataclass(eq=False)
class Worker:
    """One process and what is known of it."""

    number: int
    places: Sequence[Path]
    listener: socket.socket
    process: subprocess.Popen[bytes] | None = None
    begun_s: float = 0.0
    heard_s: float = 0.0
    due_s: float = float("-inf")
    """When it is started, if it does not run."""
    pause_s: float = 0.0
    is_ready: bool = False
    is_over: bool = False
    """Whether all its sources have ended."""
    port: int | None = None
    """Port of its metrics on the loopback address."""


class HostWorkers:
    """Monitoring service of many sites in several processes.

    Parameters
    ----------
    places : sequence of Path
        Site files, which are dealt out in turn, and folders, whose files are dealt out by their names.
    metrics : (str, int), optional
        Host and port of the endpoint for Prometheus.
    share : (int, int)
        Number of the share of sites that `Host` takes first, from 1, and the number of shares.

    Raises
    ------
    MissingInputError
        The port of the metrics cannot be opened.
    """

    def __init__(
        self,
        places: Sequence[Path],
        workers: int,
        metrics: tuple[str, int] | None = None,
        *,
        standby: bool = False,
        share: tuple[int, int] = (1, 1),
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clock, self._count = clock, workers
        self._options = ["standby" if standby else "alone", *map(str, share)]
        folders, files = [p for p in places if p.is_dir()], [p for p in places if not p.is_dir()]
        self._scratch = tempfile.TemporaryDirectory(prefix="shm-host-", ignore_cleanup_errors=True)
        dealt = [(k, [*files[k::workers], *folders]) for k in range(workers)]
        self.workers = [Worker(k, mine, self._listen(k)) for k, mine in dealt if mine]
        self._stopping = False
        self._end_s = float("inf")
        self._reload_requested = False
        self._is_asked = metrics is not None
        self.metrics = None if metrics is None else WorkersMetrics(metrics, self._ports)

    def run(self) -> None:
        """Run the processes until SIGTERM or SIGINT arrives, or, where only files are named, until all sources have ended."""
        with systemd.signals(self._ask_to_stop, self._ask_to_reload):
            try:
                self._loop()
            finally:
                for worker in self.workers:
                    if worker.process is not None and worker.process.poll() is None:
                        worker.process.kill()
                        worker.process.wait()
                    worker.listener.close()
                if self.metrics is not None:
                    self.metrics.close(1.0)
                self._scratch.cleanup()

    def _ports(self) -> dict[int, int | None]:
        return {worker.number: worker.port for worker in self.workers if not worker.is_over}

    def _listen(self, number: int) -> socket.socket:
        """Open the socket at which a process says that it is at work."""
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        listener.bind(f"{self._scratch.name}/{number}")
        listener.setblocking(False)
        return listener

    def _ask_to_stop(self) -> None:
        self._stopping, self._end_s = True, self._clock() + _END_S

    def _ask_to_reload(self) -> None:
        self._reload_requested = True

    def _loop(self) -> None:
        """Start, hear and replace the processes until all have ended."""
        service = systemd.Service(self._clock())
        while True:
            heard, _, _ = select.select([worker.listener for worker in self.workers], [], [], _TICK_S)
            now = self._clock()
            for worker in self.workers:
                if worker.listener in heard:
                    self._hear(worker, now)
                self._look_after(worker, now)
            service.at_work(now)
            if all(worker.is_ready or worker.is_over for worker in self.workers):
                service.tell("READY")
            if self._reload_requested:
                self._reload_requested = False
                self._send(signal.SIGHUP)
            if self._stopping and service.tell("STOPPING"):
                self._send(signal.SIGTERM)
            if all(worker.is_over for worker in self.workers):
                return
            if now >= self._end_s:
                _log.error("processes that did not end within %.0f s are killed", _END_S)
                return

    def _send(self, number: int) -> None:
        for worker in self.workers:
            if worker.process is not None:
                worker.process.send_signal(number)

    def _hear(self, worker: Worker, now: float) -> None:
        """Take what a process says."""
        with contextlib.suppress(BlockingIOError):
            while True:
                word = worker.listener.recv(4096).decode("ascii", "replace")
                worker.heard_s = now
                worker.is_ready = worker.is_ready or word == "READY=1"
                if word.startswith("X_METRICS_PORT="):
                    worker.port = int(word.partition("=")[2])

    def _look_after(self, worker: Worker, now: float) -> None:
        """Start a process that is due, end one that hangs, and note one that has ended."""
        if worker.is_over:
            return
        if worker.process is None:
            if self._stopping:
                worker.is_over = True
            elif now >= worker.due_s:
                self._start(worker, now)
            return
        code = worker.process.poll()
        if code is None:
            if now - worker.heard_s > _SILENT_S and not self._stopping:
                _log.error("process %d of the host is silent for %.0f s; it is ended", worker.number, _SILENT_S)
                worker.process.kill()
            return
        worker.process, worker.port = None, None
        if code == 0 or self._stopping:
            worker.is_over = True
            return
        worker.pause_s = 0.0 if now - worker.begun_s > _STEADY_S else worker.pause_s
        worker.due_s = now + worker.pause_s
        _log.error("process %d of the host died (%d); started again in %.1f s", worker.number, code, worker.pause_s)
        worker.pause_s = min(max(_RETRY_S[0], 2.0 * worker.pause_s), _RETRY_S[1])

    def _start(self, worker: Worker, now: float) -> None:
        command = [sys.executable, "-m", "monitor.service.host_worker", str(worker.number), str(self._count)]
        command += ["metrics" if self._is_asked else "no-metrics", *self._options, *map(str, worker.places)]
        environment = {name: text for name, text in os.environ.items() if name != "WATCHDOG_PID"}
        environment |= {"NOTIFY_SOCKET": f"{self._scratch.name}/{worker.number}"}
        environment |= {"WATCHDOG_USEC": str(round(_SILENT_S * 0.5e6))}
        worker.begun_s = worker.heard_s = now
        try:
            worker.process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                env=environment,
                start_new_session=True,  # a signal from the keyboard is the parent's to pass on
            )
        except OSError as error:
            worker.due_s = now + _RETRY_S[1]
            _log.error("process %d of the host cannot be started: %s", worker.number, error.strerror or error)
