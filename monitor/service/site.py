"""Monitoring of one site, driven by a thread that owns it: `monitor.service.daemon` drives one, `monitor.service.host` many.

One thread reads the source, the owner evaluates, and one thread records.  Nothing else keeps state of the evaluation.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drivers.base import RecordingError, RecordingMissingError, SampleBlock, Source, SourceContext
from drivers.recorder import unfit
from monitor.config import Configuration, configuration
from monitor.core import (
    BadConfigurationError,
    BadInputError,
    Gap,
    Level,
    MissingInputError,
    UserError,
    WindowResult,
    utc,
)
from monitor.damage import AnyBaseline, Assessment, outdated
from monitor.events import Event
from monitor.pipeline import Result
from monitor.publish import EVENTS, Publisher, current_alarm_line, episode_content, to_json
from monitor.runs import (
    EventRecordings,
    Progress,
    Session,
    duration_s,
    ledger,
    load_healthy,
    longest_diagnosis_s,
    page_of,
    write_event_page,
)
from monitor.service import restart
from monitor.service.appended_lines import AppendedLines
from monitor.service.daemon_health import Vitals, Way, failures, plain
from monitor.service.history import History
from monitor.service.lease import FolderLease, Lease
from monitor.service.outlets import Outlet, make_outlets
from monitor.service.recorded_blocks import RecordedBlocks
from monitor.service.reload import Reloaded, reread
from monitor.service.request_handler import RequestHandler
from monitor.service.site_store import SiteStore, store_of
from monitor.service.storage import EventsFile, ResultsFile, Storage
from monitor.service.threads import BlockQueue, Chores, Reader, Recording, background
from monitor.signals import Health

if TYPE_CHECKING:
    from monitor.publish import RerunPublisher

_log = logging.getLogger(__name__)

_STOP_S, _DRAIN_S, _END_S = 1.5, 2.5, 4.5
"""Deadlines after the stop signal: for the source to close, for the queue to empty, and for everything else to end."""
_DURABLE_S = 0.5
"""Longest wait for the disk before a change of an alarm is announced."""
_TIDY_S = 60.0
"""Interval at which closed months are packed and the budget of the folder is looked after. [s; judgement]"""
_CHECK_S = 1.0
"""Interval at which the outputs are asked whether they fail, so that a line of health tells a failure soon, and at which the lock
is looked at. [s; judgement]"""
_LATE_S = 30.0
"""Shortest delay of data by the wall clock from which the state is no present one. [s; judgement]"""
_LATEST = 50
_LEAN_POLL_S = 1.0
"""Longest wait of a reader for a block where threads of many sites share the processor. [s; judgement: below `_STOP_S`]"""
_HEALTH_FILE_BYTES = 16 << 20


class Site(Publisher):
    """Everything of one site: source, session, publishers, recorder, checkpoints and operators' requests.

    The owner calls `start`; then `take` with each block of the reader's queue, and `step` now and then, until the queue is over;
    `finish` then, unless something failed; and `close` in any case.

    A given source is read in place of the one that the file names; given outlets are closed before its own.  Lines of health
    follow each other after `quiet_s` while no data arrive, and summaries at the earliest.  `warm` compiles what the windows of
    a configuration and its baseline need.  A `lean` site spares memory and processor for others in the process: a diagnosis
    reads its data from the recordings, where these are written, and the reader looks up less often.  Rerun viewers are served
    by `viewer`, where the site file says so.  `store` is the copy of the output folder in object storage, not yet open, by
    default that of the site file.  Until it is known whether another monitor is at work, a lean site does not start, and any
    other waits.

    MissingInputError tells that a file is missing, or that the output folder cannot be written; BadInputError that the
    baseline file is unusable; BadConfigurationError that the site file is invalid, the baseline another structure's, or that
    another daemon writes into the output folder or its copy.
    """

    def __init__(
        self,
        path: Path,
        source: Source | None = None,
        outlets: Sequence[Outlet] = (),
        *,
        clock: Callable[[], float] = time.monotonic,
        quiet_s: float = 10.0,
        queue: BlockQueue[SampleBlock] | None = None,
        warm: Callable[[Configuration, AnyBaseline | None], object],
        lean: bool = False,
        viewer: bool = True,
        store: SiteStore | None = None,
    ) -> None:
        self._clock, self._quiet_s, self._warm, self._served, self._lean = clock, quiet_s, warm, viewer, lean
        self.settings = settings = configuration.load(path)
        folder = path.resolve().parent
        if source is None and settings.source is None:
            raise BadConfigurationError(f"{path}: source: missing; name a kind, as in deploy/*.toml")
        healthy_path = None if settings.site.baseline is None else folder / settings.site.baseline
        healthy = None if healthy_path is None else load_healthy(healthy_path, settings)
        make_outlets(path, settings, dry=True)
        self.out = folder / settings.output.dir
        self._vitals, self._progress = Vitals(self.out), Progress(lambda _: None)
        self._begun_s = self._health_s = self._summary_s = self._sync_s = self._checked_s = self._held_s = self._clock()
        self._tidied_s = float("-inf")
        self._failed: set[str] = set()
        self._said: Assessment | None = None
        self._data_s: float | None = None  # no data have come yet: what a checkpoint knows is no present state
        self._block_s, self._was_late = 0.0, False
        self._path, self._stopping, self._end_s = path, False, float("inf")
        self._reload_requested = self._rereading = False
        self._reloaded: Reloaded | None = None
        self._lost: UserError | None = None
        self._alarm: object = None
        self._told_episodes: list[tuple[int, Level, bool]] = []
        with ExitStack() as undo:
            # Before anything of this daemon can be seen from outside.
            restart.make_private(self.out / "state", self.out)
            self._lease: Lease = FolderLease(self.out)
            self._lease.acquire()
            undo.callback(self._lease.release)
            restart.note_site(self.out / "state", settings)
            self._store = store_of(settings, self.out, clock) if store is None else store
            if self._store is not None:
                self._store.open(wait=not lean)
                undo.callback(self._store.close, "released", _END_S)
            self._open_parts(undo, healthy_path, healthy)
            self._outlets: tuple[Outlet, ...] = (*make_outlets(path, settings), *outlets)
            for outlet in self._outlets:
                undo.callback(outlet.close, _END_S)
                if self._events.last is not None:
                    outlet.known_event(self._events.last)
            self._requests = RequestHandler(
                self._outlets, self.out / ledger.LEDGER, self._chores, self._keeper, self._history, clock
            )
            self._warm_up(healthy)
            known_ns = self._keeper.resume(self._new_session, self._history.window)
            if source is None:
                assert settings.source is not None
                source = configuration.make_source(settings.source, SourceContext(settings.channels, folder, known_ns))
            self.reader = Reader(source, queue, _LEAN_POLL_S) if self._lean else Reader(source, queue)
            self._bounds = configuration.make_bounds(settings.source)
            undo.pop_all()

    def _open_parts(self, undo: ExitStack, healthy_path: Path | None, healthy: AnyBaseline | None) -> None:
        """Open the files, the viewer and the threads behind them; `undo` closes them again."""
        settings = self.settings
        # Lines are written by a thread that waits for no fsync, so that health.jsonl can say that the others wait for one.
        self._chores, self._line_writer = Chores(), Chores("lines")
        self._event_writer = Chores("events")  # a page takes a second or two, for which no other file waits
        for chores in (self._chores, self._line_writer, self._event_writer):
            undo.callback(chores.close, _END_S)
        later = self._line_writer.do
        try:
            results, by_month = self.out / "results.jsonl", settings.output.pack_months
            self._lines = ResultsFile(results, by_month=by_month, run=partial(later, "results.jsonl"))
            undo.callback(self._lines.close)
            health = self.out / "health.jsonl"
            self._health_lines = AppendedLines(health, _HEALTH_FILE_BYTES, partial(later, "health.jsonl"))
            undo.callback(self._health_lines.close)
            self._events = EventsFile(self.out / EVENTS, partial(later, EVENTS))
            undo.callback(self._events.close)
            self._tell_start()
            self._recording = Recording(self.out / "recordings", settings.recorder)
            undo.callback(self._recording.close, _END_S)
            self._storage = Storage(self.out, settings.output, self._recording)
            self._keeper = restart.Checkpointer(self.out, settings, healthy_path, self._recording, self._lines)
            restart.note_baseline(self.out, self._path, healthy_path)
        except OSError as error:
            named = "" if error.filename is None else f"{error.filename}: "
            raise MissingInputError(f"{self.out}: cannot be written: {named}{error.strerror}") from error
        serve = settings.output.address
        if serve is not None and not self._served:
            _log.warning("output.serve: no viewer is served here; 'view' draws the recordings, and 'run' serves")
        self._view = None if serve is None or not self._served else _open_viewer(settings, healthy, serve)
        if self._view is not None:
            undo.callback(self._view.close, _END_S)
        publishers = (self,) if self._view is None else (self, self._view)
        findings = self.out / "findings" / f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}"
        self._event_recordings = EventRecordings(
            self.out, settings.events, self._event_writer.do, lambda *noted: self._requests.note_recording(*noted)
        )
        store = None
        if self._lean and settings.recorder.enabled:
            store = RecordedBlocks(self.out / "recordings", self._recording, longest_diagnosis_s(settings))
        files = self._path, healthy_path
        self._begin = partial(
            Session, settings, healthy, publishers, files, findings, recordings=self._event_recordings, store=store
        )
        spans = settings.processing.hop_s, settings.health.span_s
        self._history = History(self.out / "state" / "history.db", settings.state, *spans)
        undo.callback(self._history.close, _END_S)

    def _warm_up(self, healthy: AnyBaseline | None) -> None:
        """Compile what a window needs, so that no window waits for it; meanwhile lines of health say that the daemon starts."""

        def work() -> None:
            try:
                self._warm(self.settings, healthy)
            except Exception:  # noqa: BLE001 - what is not compiled now is compiled when it is needed
                _log.warning("not all is compiled before the first window", exc_info=True)

        thread = background(work, "warm-up")
        thread.start()
        while thread.is_alive():
            thread.join(self._quiet_s)
            self._tell_start()

    def _new_session(self) -> Session:
        """Begin a new session and make it the current one."""
        self.session = self._begin()
        return self.session

    def start(self) -> None:
        """Publish the state and begin to read the source."""
        self._publish_state()
        self._vitals.look_at_disk()
        self.reader.start()

    def tell_open(self) -> None:
        """Write the line of health that says that the source is open."""
        self.health(None)

    def take(self, block: SampleBlock, arrived_s: float) -> None:
        """Evaluate and publish a block of the queue; once the time to end is up, it is counted only."""
        if self._clock() < self._end_s - (_END_S - _DRAIN_S):
            self._process(block, arrived_s)
        else:
            self._vitals.unprocessed += 1

    def step(self, now: float) -> None:
        """Reload settings, apply requests, and write health, results and the summary when they are due at `now`, s."""
        self._reload()
        self._requests.step(self.session, timed=self._progress.first is not None)
        if self._is_late != self._was_late:
            self._was_late = not self._was_late
            self._health_s = self._summary_s = float("-inf")  # told everywhere at once
        if now - self._health_s >= self._quiet_s or self._failures_changed(now):
            self.health(None)
        if now - self._sync_s >= self.settings.recorder.flush_s:
            self._sync_s = now
            self._chores.do("sync", self._lines.sync)
        if now - self._held_s >= _CHECK_S:
            self._held_s = now
            self._chores.do("lock", self._holds)
        if now - self._tidied_s >= _TIDY_S:
            self._tidied_s = now
            self._chores.do("storage", self._storage.tidy)
        if now - self._summary_s >= self._quiet_s or self._told_episodes != self._episodes():
            self._write_summary()
        if self._lost is not None:
            raise self._lost
        if self._store is not None and self._store.lost is not None:
            raise self._store.lost

    def _holds(self) -> bool:
        """Look whether the output folder is still this site's, and note its loss (in a thread that may wait for the disk)."""
        try:
            self._lease.renew()
        except UserError as error:
            self._lost = error
            if self._store is not None:
                self._store.lost = error  # the copy keeps what the folder had
        return self._lost is None

    def ask_to_stop(self) -> None:
        """Set the deadlines by which the site ends; a signal handler may call this."""
        self._stopping, self._end_s = True, self._clock() + _END_S

    def ask_to_reload(self) -> None:
        """Have the site file read again by a later `step`; a signal handler may call this."""
        self._reload_requested = True

    def stop_reading(self) -> None:
        """Close the source within its deadline; what has arrived can still be taken."""
        self.reader.stop(max(0.0, self._end_s - (_END_S - _STOP_S) - self._clock()))

    def finish(self) -> None:
        """Keep what the next run goes on from; after the end of the data, wait for the last findings instead."""
        self._chores.do("lock", self._holds)
        self._chores.settle(_DURABLE_S)
        if self._lost is not None:
            return
        self._requests.finish(self.session, _DURABLE_S)
        if self.reader.ended:
            self._write_summary()  # a diagnosis may take minutes
            self.session.finish(self._is_stopping)
            self._keeper.forget()
        else:
            self._keeper.save(self.session)

    def _is_stopping(self) -> bool:
        """Return whether the site was asked to stop; write health when it is due, for a site that waits is not silent."""
        if self._clock() - self._health_s >= self._quiet_s:
            self.health(None)
        return self._stopping

    def raise_failure(self) -> None:
        """Raise the loss of the output folder, or the error that ended reading for good, if there is one.

        InUseError or MissingInputError tell that another daemon may have the folder, or that it was removed; MissingInputError
        and BadInputError are those of the source's files.
        """
        if self._lost is not None:
            raise self._lost
        if isinstance(self.reader.failure, RecordingMissingError):
            raise MissingInputError(str(self.reader.failure)) from self.reader.failure
        if isinstance(self.reader.failure, RecordingError):
            raise BadInputError(str(self.reader.failure)) from self.reader.failure
        if self.reader.failure is not None:
            raise self.reader.failure

    def window(self, result: WindowResult, line: str) -> None:
        """Write and publish the result of a window, unless a previous run did so."""
        present = self._publish_state()
        self._history.episodes([episode_content(e) for e in self.session.episodes[-_LATEST:]])
        if result.index in self._keeper.written:
            return
        self._history.window(json.loads(line) | {"state": present.state.value})
        self._lines.write_window(line, result.t_end_ns)
        for outlet in self._outlets:
            outlet.window(result, line)

    def event(self, event: Event, line: str) -> None:
        """Write and publish what is told of an event, unless a previous run did so."""
        if event.revision is None:
            if self._keeper.resuming:
                return
        elif not self._events.write_event(event.id, event.revision, line):
            return
        else:
            # After the job that writes its recording, in the same thread.
            self._event_writer.do(f"page {event.id}", partial(self._write_page, event.id, line))
        for outlet in self._outlets:
            outlet.event(event, line)

    def _write_page(self, id: str, line: str) -> None:
        """Write the page of an event beside its recording (in the thread of events)."""
        try:
            write_event_page(self.out, json.loads(line), page_of(self.out, id))
        except Exception as error:  # noqa: BLE001 - the thread goes on to write the recordings of later events
            unexpected = not isinstance(error, UserError | OSError)
            _log.error("%s: the page of event %s is not written: %s", self.out, id, error, exc_info=unexpected)

    def gap(self, gap: Gap) -> None:
        """Store and publish a gap in the data."""
        self._history.gap(gap.t_ns, gap.duration_s, gap.reason)
        if self._keeper.resuming:
            return
        for outlet in self._outlets:
            outlet.gap(gap)

    def state(self, assessment: Assessment) -> None:
        """Publish the present state of the structure."""
        if self._keeper.resuming:  # a past state is none to tell as the present one
            return
        self._said = assessment
        for outlet in self._outlets:
            outlet.state(assessment)

    def health(self, health: Health | None) -> None:
        """Write and publish the sensors' health together with the daemon's own health."""
        span: dict[str, Any] | None = None
        if health is not None:
            span = plain(health)
            self._history.health(span)
            if not self._keeper.resuming:  # before, the source is not open yet, and its clocks are the present ones
                clocks = self.reader.source.health().clocks
                if self._view is not None:
                    self._view.clocks(health.t_end_ns, clocks)
                self.session.clocks = tuple((c.node, 1.0 + 1e-6 * c.drift_ppm, 1e-6 * c.drift_std_ppm) for c in clocks)
        if self._keeper.resuming:
            if self._clock() - self._health_s >= self._quiet_s:
                self._tell_start()
            return
        self._publish_state()
        self._health_s = self._checked_s = self._clock()
        self._line_writer.do("free space", self._vitals.look_at_disk)
        line = self._vitals.line(span, self.reader, self._recording.health(), self.outputs())
        line |= {"ledger_head": self._requests.head, "data_age_s": self._age_s}
        line["web"] = next((outlet.url for outlet in self._outlets if outlet.url), None)
        for name in line["failed"].keys() - self._failed:
            _log.warning("blocked: %s: %s", name, line["failed"][name])
        self._failed = set(line["failed"])
        self._health_lines.write(json.dumps(line, allow_nan=False))
        for outlet in self._outlets:
            outlet.health_line(line)

    def finding(self, finding: dict[str, Any]) -> None:
        """Store and publish the finding of a diagnosis."""
        self._history.finding(finding)
        for outlet in self._outlets:
            outlet.finding(finding)

    def _tell_start(self) -> None:
        """Write a line of health that says that the daemon is starting."""
        self._health_s = self._clock()
        self._health_lines.write(json.dumps(self._vitals.line(None, None, None, ()), allow_nan=False))

    def _process(self, block: SampleBlock, arrived_s: float) -> None:
        """Evaluate a block, record it if it was accepted, then publish the results.

        In this order a replay of the recordings repeats the run exactly.
        """
        self._vitals.received(block)
        reason = unfit(block)
        if reason is None and self._bounds is not None:
            reason = self._bounds.refusal(block)
        if reason is not None:
            self._vitals.refuse(reason)
            return
        before = self.session.windows
        try:
            self.session.push(block, partial(self._record, block, self.session.now_ns))
        except BadInputError as error:
            self._vitals.refuse(str(error))
            return
        self._progress.add(block)
        if self.session.windows > before:
            self._vitals.published(arrived_s)
        self._keeper.took(self.session, block)

    def _record(self, block: SampleBlock, known_ns: int, results: Sequence[Result]) -> None:
        """Record an accepted block; a block that changes an alarm is on the disk before the change is announced.

        While motion is strong, or may be, every block goes to the disk at once, and nothing waits for that.
        `known_ns` is the end of the data before it: a block without a new sample is no sign that data come.
        """
        if self.session.now_ns != known_ns:
            self._data_s, self._block_s = self._clock(), block.n_samples / block.sample_rate_hz
        self._recording.write(block, at_once=self.session.may_be_strong)
        alarms = [(r.alarm.active, r.alarm.conditions) for r in results if isinstance(r, WindowResult)]
        exceeded = any(isinstance(r, Event) and r.exceeded for r in results)
        if exceeded or any(alarm != self._alarm for alarm in alarms):
            self._alarm = alarms[-1] if alarms else self._alarm
            self._recording.flush(_DURABLE_S)
            if self._store is not None:
                self._store.settle(_DURABLE_S)

    def _reread(self) -> None:
        """Read the site file again (in a thread that may wait for the disk)."""
        try:
            self._reloaded = reread(self._path, self.settings, self._outlets, self.out)
            self._requests.read_head()
        finally:
            self._rereading = False

    def _reload(self) -> None:
        """Have the site file read again where that was asked for, and continue with its thresholds once it has been read."""
        if self._rereading:
            return
        if (reloaded := self._reloaded) is not None:
            self._reloaded = None
            reloaded.apply()
            self.settings = reloaded.settings
            self.session.reconfigure(self.settings)
        elif self._reload_requested:
            self._reload_requested, self._rereading = False, True
            self._chores.do("reload", self._reread)

    def _failures_changed(self, now: float) -> bool:
        """Return whether other outputs fail than the latest line of health says; they are asked every `_CHECK_S`."""
        if now - self._checked_s < _CHECK_S:
            return False
        self._checked_s = now
        return failures(self.outputs()).keys() != self._failed

    @property
    def _present(self) -> Assessment:
        """The present state of the structure: that of the session, outdated once data are late."""
        present = self.session.present
        if not self._is_late:
            return present
        lasting = "" if self._age_s is None else f" (for {_span(self._age_s)})"
        return outdated(present, f"no data since {utc(self.session.now_ns)} UTC{lasting}")

    @property
    def _age_s(self) -> float | None:
        """Time since the latest data were taken, s; None before the first of this run."""
        return None if self._data_s is None else max(0.0, self._clock() - self._data_s)

    @property
    def _is_late(self) -> bool:
        """Whether the next block is overdue by more than two hops and `_LATE_S`: none waits, and the source has not ended."""
        if self._keeper.resuming or self.reader.ended or len(self.reader.queue):
            return False
        if self._age_s is None:  # of an earlier run alone
            return self.session.windows > 0
        return self._age_s > self._block_s + max(2.0 * self.settings.processing.hop_s, _LATE_S)

    def _publish_state(self) -> Assessment:
        """Publish the present state where it is not what was published last, and return it."""
        present = self._present
        if present != self._said:
            self.state(present)
            if self._view is not None:
                self._view.state(present)
        return present

    def _episodes(self) -> list[tuple[int, Level, bool]]:
        """List the alarm episodes: story, highest level, and whether it lasts."""
        return [(loss.story, loss.level, loss.t_last_ns is None) for loss in self.session.episodes]

    def _write_summary(self) -> None:
        self._summary_s = self._clock()
        seconds = duration_s(self._progress.first, self._progress.last)
        content = self.session.content(seconds / max(self._summary_s - self._begun_s, 1e-9))
        v = self._vitals
        content |= {"refused_blocks": v.refused, "unprocessed_blocks": v.unprocessed, "latency_ms": v.latency()}
        pipeline = self.session.pipeline
        content["alarm"] = current_alarm_line(pipeline.state.alarm, pipeline.quantities.parts)
        content |= self._present.content
        self._told_episodes, content = self._episodes(), plain(content)
        self._chores.write(self.out / "summary.json", to_json(content) + "\n", self._holds)
        for outlet in self._outlets:
            outlet.summary(content)

    def outputs(self) -> list[tuple[str, Way]]:
        """List every part beside the main thread with its name: source, recorder, outlets, viewer, checkpoint, history, files."""
        own: dict[str, Way | None] = {
            "source": self.reader,
            "recorder": self._recording,
            "viewer": self._view,
            "checkpoint": self._keeper,
            "history": self._history,
            "store": self._store,
            "ledger.jsonl": self._requests,
            "storage": self._storage,
            "results.jsonl": self._lines,
            EVENTS: self._events,
            "events": self._event_recordings,
            "pages of events": self._event_writer,
            "health.jsonl": self._health_lines,
            "summary.json": self._chores,
        }
        return [(n, way) for n, way in own.items() if way is not None] + [(type(o).__name__, o) for o in self._outlets]

    def close(self) -> None:
        """Close everything before the deadline; what hangs does not use up the time of the others."""
        self._end_s = min(self._end_s, self._clock() + _END_S)
        self.reader.stop(0.1)  # it has ended already, except after an error
        self._recording.close(self._share_s())
        self._requests.close()
        self.session.online_diagnosis.close(self._share_s())
        self._event_writer.close(self._share_s())
        self._chores.settle(self._share_s())  # the last line of health names the ledger's last line
        self.health(None)
        self._write_summary()
        self._history.close(self._share_s())
        self._line_writer.close(self._share_s())
        for lines in (self._lines, self._events, self._health_lines):
            self._chores.do(f"close {id(lines)}", lines.close)
        for outlet in reversed(self._outlets):
            outlet.close(self._share_s())
        if self._view is not None:
            self._view.close(self._share_s())
        self._chores.close(self._share_s())
        if self._store is not None:
            self._store.close("ended" if self.reader.ended else "released", self._share_s())
        self._lease.release()

    def _share_s(self) -> float:
        """Return the time that the next part may take to close, s: half of the remaining time, so that the others have some."""
        return max(0.0, self._end_s - self._clock()) / 2.0


def _span(seconds: float) -> str:
    """Write a span in seconds up to two minutes, in minutes up to two hours, then in hours."""
    limits = ((120.0, 1.0, "s"), (7200.0, 60.0, "min"), (float("inf"), 3600.0, "h"))
    return next(f"{seconds / unit:.0f} {name}" for limit, unit, name in limits if seconds < limit)


def _open_viewer(settings: Configuration, healthy: AnyBaseline | None, serve: tuple[str, int]) -> RerunPublisher | None:
    """Open the viewer of a site; its library is loaded only where one is served."""
    from monitor.runs import open_viewer

    return open_viewer(settings, healthy, file=None, serve=serve, lossless=False, on_warning=_log.warning)
