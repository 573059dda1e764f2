"""The long-running service: one thread reads, this one evaluates, one records; nothing else remembers anything."""

from __future__ import annotations

import fcntl
import json
import logging
import os
import signal
import sys
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from drivers.base import RecordingError, RecordingMissingError, SampleBlock, Source, SourceContext
from drivers.recorder import unfit
from monitor import baseline, config, ledger, systemd
from monitor.appended import AppendedLines
from monitor.errors import BadConfigurationError, BadInputError, MissingInputError
from monitor.files import sha256, write_atomically
from monitor.health import Health
from monitor.outlets import Outlet, make_outlets
from monitor.outputs import Publisher, Session, View, scene
from monitor.publish.lines import to_json
from monitor.publish.requests import apply
from monitor.publish.rerun_view import RerunPublisher
from monitor.reader import Chores, Reader, Recording
from monitor.recordings import Progress, duration_s
from monitor.results import Gap, WindowResult
from monitor.vitals import Vitals, plain

_log = logging.getLogger(__name__)

_TICK_S = 0.2
_QUIET_S = 10.0
"""Without data, health is told this often; the summary is written no more often."""
_STOP_S, _DRAIN_S, _END_S = 1.5, 2.5, 4.5
"""From the signal on, the source is waited for until the first, the queue until the second, all the rest until the last."""
_HEALTH_FILE_BYTES = 16 << 20


class Daemon(Publisher):
    """One site.

    Parameters
    ----------
    path : Path
        Site file; its paths are relative to its folder.
    source : Source, optional
        In place of the one that the file names.
    outlets : sequence of Outlet, optional
        Besides those that the file names; closed in reverse order.

    Raises
    ------
    MissingInputError, BadConfigurationError
    """

    def __init__(self, path: Path, source: Source | None = None, outlets: Sequence[Outlet] = ()) -> None:
        self.settings = settings = config.load(path)
        folder = path.resolve().parent
        if source is None:
            if settings.source is None:
                raise BadConfigurationError(f"{path}: source: missing; name a kind, as in deploy/*.toml")
            source = config.make_source(settings.source, SourceContext(settings.channels, folder))
        healthy_path = None if settings.site.baseline is None else folder / settings.site.baseline
        healthy = None if healthy_path is None else baseline.load(healthy_path, settings)
        self.out = folder / settings.output.dir
        self._vitals, self._progress = Vitals(), Progress(lambda _: None)
        self._begun_s = self._health_s = self._summary_s = self._sync_s = time.monotonic()
        self._stopping, self._end_s = False, float("inf")
        self._outlets: tuple[Outlet, ...] = (*make_outlets(path, settings), *outlets)
        try:
            (self.out / "state").mkdir(parents=True, exist_ok=True)
            self._lock = _locked(self.out / "state" / "lock", self.out)
            self._lines = AppendedLines(self.out / "results.jsonl")
            self._health_lines = AppendedLines(self.out / "health.jsonl", _HEALTH_FILE_BYTES)
            enabled = settings.recorder.enabled
            self._recording = Recording(self.out / "recordings", settings.recorder) if enabled else None
            _note_baseline(self.out, path, healthy_path)
        except OSError as error:
            raise MissingInputError(f"{self.out}: cannot be written: {error.strerror}") from error
        address, publishers = settings.output.address, [self]
        self._view = (
            None
            if address is None
            else RerunPublisher(scene(settings, healthy), file=None, serve=address, lossless=False)
        )
        views = () if self._view is None else (View(self._view),)
        findings = self.out / "findings" / f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}"
        self._chores = Chores()
        self.session = Session(settings, healthy, (*publishers, *views), (path, healthy_path), findings)
        self.reader = Reader(source)

    def run(self) -> None:
        """Until the source ends or a signal comes.

        Raises
        ------
        MissingInputError, BadInputError
            The source's files are missing or unusable.
        """
        previous = {number: signal.signal(number, self._signal) for number in (signal.SIGTERM, signal.SIGINT)}
        try:
            self.reader.start()
            self._loop()
            if self.reader.ended:
                self.session.watcher.finish(lambda: self._stopping)
        finally:
            self._close()
            for number, handler in previous.items():
                signal.signal(number, handler)
        if isinstance(self.reader.failure, RecordingMissingError):
            raise MissingInputError(str(self.reader.failure)) from self.reader.failure
        if isinstance(self.reader.failure, RecordingError):
            raise BadInputError(str(self.reader.failure)) from self.reader.failure
        if self.reader.failure is not None:
            raise self.reader.failure

    def window(self, result: WindowResult, line: str) -> None:
        """Write and send it."""
        self._lines.write(line)
        for outlet in self._outlets:
            outlet.window(result, line)

    def gap(self, gap: Gap) -> None:
        """Send it."""
        for outlet in self._outlets:
            outlet.gap(gap)

    def health(self, health: Health | None) -> None:
        """Write and send it with the rest that there is to say."""
        self._health_s = time.monotonic()
        recorder = None if self._recording is None else self._recording.health()
        line = self._vitals.line(health, self.reader, recorder, self._failures())
        self._health_lines.write(json.dumps(line, allow_nan=False))
        for outlet in self._outlets:
            outlet.health(line)

    def _signal(self, number: int, _: object) -> None:
        self._stopping, self._end_s = True, time.monotonic() + _END_S
        signal.signal(number, signal.SIG_DFL)  # the next one ends at once

    def _loop(self) -> None:
        ready, told = False, False
        watchdog_s, barked_s = systemd.watchdog_s(), time.monotonic()
        while not self.reader.queue.over:
            item = self.reader.queue.take(_TICK_S)
            now = time.monotonic()
            if self.reader.opened and not ready:
                ready = True
                print("READY", file=sys.stderr, flush=True)
                systemd.notify("READY=1")
            if watchdog_s is not None and now - barked_s >= watchdog_s:
                barked_s = now
                systemd.notify("WATCHDOG=1")
            if item is not None and now < self._end_s - (_END_S - _DRAIN_S):
                self._take(*item)
            elif item is not None:
                self._vitals.unprocessed += 1
            self._now_and_then(now)
            if self._stopping and not told:
                told = True
                systemd.notify("STOPPING=1")
                self.reader.stop(max(0.0, self._end_s - (_END_S - _STOP_S) - time.monotonic()))

    def _take(self, block: SampleBlock, arrived_s: float) -> None:
        """Evaluate, publish, then record what was taken in: the recordings replayed are this run again."""
        self._vitals.received(block)
        reason = unfit(block)
        if reason is not None:
            self._vitals.refuse(reason)
            return
        before = self.session.windows
        try:
            self.session.push(block)
        except BadInputError as error:
            self._vitals.refuse(str(error))
            return
        self._progress.saw(block)
        if self.session.windows > before:
            self._vitals.published(arrived_s)
        if self._recording is not None:
            self._recording.write(block)

    def _serve(self, outlet: Outlet) -> None:
        """Apply what operators asked for, and note it in the ledger."""
        for request in outlet.take_requests():
            try:
                self.session.alter_alarm(partial(apply, request=request, t_ns=self.session.now_ns))
                says = f"{request.action} alarm of story {request.story}: {request.note}"
                ledger.record(self.out / "results.jsonl", {"says": says, "causes": []}, {}, request.who)
            except (ValueError, MissingInputError) as error:
                _log.warning("request of %s: %s", request.who, error)

    def _now_and_then(self, now: float) -> None:
        for outlet in self._outlets if self._progress.first is not None else ():  # wishes count from the data's time
            self._serve(outlet)
        if now - self._health_s >= _QUIET_S:
            self.health(None)
        if now - self._sync_s >= self.settings.recorder.flush_s:
            self._sync_s = now
            self._lines.flush()
            self._chores.do("sync", self._lines.sync)
        if now - self._summary_s >= _QUIET_S:
            self._write_summary()

    def _write_summary(self) -> None:
        self._summary_s = time.monotonic()
        seconds = duration_s(self._progress.first, self._progress.last)
        content = self.session.content(seconds / max(self._summary_s - self._begun_s, 1e-9))
        v = self._vitals
        content |= {"refused_blocks": v.refused, "unprocessed_blocks": v.unprocessed, "latency_ms": v.latency()}
        self._chores.do("summary", partial(_write, self.out / "summary.json", to_json(plain(content)) + "\n"))

    def _failures(self) -> dict[str, str]:
        """Which ways out are blocked, and why."""
        view = {"viewer": self._view.failed} if self._view is not None and self._view.failed else {}
        files = {"results.jsonl": self._lines.failed, "health.jsonl": self._health_lines.failed}
        outlets = {type(outlet).__name__: outlet.failed for outlet in self._outlets if outlet.failed}
        return {**view, **{name: why for name, why in files.items() if why}, **outlets}

    def _close(self) -> None:
        self._end_s = min(self._end_s, time.monotonic() + _END_S)
        self.reader.stop(0.1)  # it has ended, but for an error
        if self._recording is not None:
            self._recording.close(self._share_s())
        self.session.watcher.close(self._share_s())
        self.health(None)
        self._write_summary()
        for lines in (self._lines, self._health_lines):
            self._chores.do(f"close {id(lines)}", lines.close)
        for outlet in reversed(self._outlets):
            outlet.close(self._share_s())
        if self._view is not None:
            self._view.close(self._share_s())
        self._chores.close(self._share_s())
        os.close(self._lock)

    def _share_s(self) -> float:
        """How long one more may take to close: half of what is left, so that who hangs leaves time to the others."""
        return max(0.0, self._end_s - time.monotonic()) / 2.0


def _write(path: Path, text: str) -> None:
    """A file that may fail without harm."""
    try:
        write_atomically(path, text)
    except OSError as error:
        _log.warning("%s: %s", path, error.strerror)


def _locked(path: Path, out: Path) -> int:
    """A lock that ends with the process.

    Raises
    ------
    BadConfigurationError
        Another daemon holds it.
    """
    handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(handle)
        raise BadConfigurationError(f"{out}: another daemon writes here; name another dir under [output]") from error
    return handle


def _note_baseline(out: Path, site: Path, healthy: Path | None) -> None:
    """A line in the ledger when the reference for damage is not the one of the run before."""
    place = out / "state" / "baseline.json"
    now = {"baseline_sha256": None if healthy is None else sha256(healthy)}
    try:
        before = json.loads(place.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        before = None
    if before == now:
        return
    if before is not None:
        finding = {"says": "monitoring goes on from another baseline", "causes": []}
        ledger.record(out / "results.jsonl", finding, {"site": site, "baseline": healthy}, None)
    write_atomically(place, json.dumps(now) + "\n")
