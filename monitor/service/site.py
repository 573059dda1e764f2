"""Monitoring of one site, driven by a thread that owns it (`monitor.service.schedule`), one of many where they share the process.

One thread reads the source, the owner evaluates, and one thread records.  Nothing else keeps state of the evaluation.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drivers.base import RecordingError, RecordingMissingError, SampleBlock, Source, SourceContext
from monitor.config import Configuration, configuration
from monitor.core import BadConfigurationError, BadInputError, MissingInputError, Work, Worker
from monitor.damage import AnyBaseline
from monitor.publish import EVENTS
from monitor.runs import EventRecordings, Session, ledger, load_healthy, longest_diagnosis_s
from monitor.service.component import Component, Every, Part, Way
from monitor.service.daemon_health import HealthLines, Vitals
from monitor.service.evaluation import DURABLE_S, Evaluation
from monitor.service.outlets import Outlet, make_outlets
from monitor.service.publication import Publication, SummaryFile
from monitor.service.recorded_blocks import RecordedBlocks
from monitor.service.reload import Reloading
from monitor.service.request_handler import RequestHandler
from monitor.service.site_files import END_S, Claim, SiteFiles
from monitor.service.site_store import SiteStore, store_of
from monitor.service.threads import BlockQueue, Reader

if TYPE_CHECKING:
    from monitor.publish import RerunPublisher

_log = logging.getLogger(__name__)

_STOP_S, _DRAIN_S = 1.5, 2.5
"""Deadlines after the stop signal: for the source to close, and for the queue to empty. [s; judgement]"""
_TIDY_S = 60.0
"""Interval at which closed months are packed and the budget of the folder is looked after. [s; judgement]"""
_LEAN_POLL_S = 1.0
"""Longest wait of a reader for a block where threads of many sites share the processor. [s; judgement: below `_STOP_S`]"""


class Site:
    """Owner of everything of one site: source, session, publishers, recorder, checkpoints and operators' requests.

    Who drives it calls `start`; then `take` with each block of the reader's queue, and `step` now and then, until the queue is
    over; `finish` then, unless something failed; and `close` in any case.

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
        self._clock, self._stopping, self._end_s = clock, False, float("inf")
        settings = configuration.load(path)
        folder = path.resolve().parent
        self.out = out = folder / settings.output.dir
        if source is None and settings.source is None:
            raise BadConfigurationError(f"{path}: source: missing; name a kind, as in deploy/*.toml")
        healthy_path = None if settings.site.baseline is None else folder / settings.site.baseline
        healthy = None if healthy_path is None else load_healthy(healthy_path, settings)
        make_outlets(path, settings, dry=True)
        self._vitals = Vitals(out)
        with ExitStack() as undo:
            # Before anything of this daemon can be seen from outside.
            self._claim = Claim(out, settings, undo)
            store = self._claim.store = store_of(settings, out, clock) if store is None else store
            if store is not None:
                store.open(wait=not lean)
                undo.callback(store.close, "released", END_S)
            self._files = files = SiteFiles(path, settings, healthy_path, out, self._vitals, clock, quiet_s, undo)
            view = _open_viewer(settings, healthy, viewer, undo)
            keep = partial(self._claim.keep, DURABLE_S)
            outlets = (*make_outlets(path, settings, keep=keep), *outlets)
            for outlet in outlets:
                undo.callback(outlet.close, END_S)
                if files.events.last is not None:
                    outlet.known_event(files.events.last)
            self._evaluation = Evaluation(settings, files, self._vitals, store, clock)
            self._publication = Publication(out, self._evaluation, files, view, outlets)
            self._summary = SummaryFile(out, self._publication, self._vitals, self._claim.holds, quiet_s, clock)
            self._reloading = Reloading(path, settings, out, outlets, files.chores)
            self._requests = RequestHandler(
                outlets, out / ledger.LEDGER, files.chores, files.keeper, files.history, clock
            )
            recordings = EventRecordings(out, settings.events, files.event_writer.do, self._requests.note_recording)
            blocks = RecordedBlocks(out / "recordings", files.recording, longest_diagnosis_s(settings))
            _warm_up(partial(warm, settings, healthy), files.health)
            known_ns = self._evaluation.resume(
                partial(
                    Session,
                    settings,
                    healthy,
                    (self._publication,) if view is None else (self._publication, view),
                    (path, healthy_path),
                    out / "findings" / f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}",
                    recordings=recordings,
                    store=blocks if lean and settings.recorder.enabled else None,
                )
            )
            if source is None:
                assert settings.source is not None
                about = SourceContext(settings.channels, folder, known_ns)
                source = configuration.make_source(settings.source, about)
            self._evaluation.reader = Reader(source, queue, _LEAN_POLL_S) if lean else Reader(source, queue)
            self._parts = self._parts_of(settings, recordings, view)
            files.health.begin(self._publication, self._requests, self.outputs)
            undo.pop_all()

    def _parts_of(
        self, settings: Configuration, recordings: EventRecordings, view: RerunPublisher | None
    ) -> tuple[Component, ...]:
        """List all parts in the order in which they step and close."""
        files, claim, requests, evaluation = self._files, self._claim, self._requests, self._evaluation
        reader, chores, now = evaluation.reader, files.chores, self._clock()
        claim.watch(chores, now)
        sync = Every(settings.recorder.flush_s, partial(chores.do, "sync", files.results.sync), now)
        tidy = Every(_TIDY_S, partial(chores.do, "storage", files.storage.tidy), -float("inf"))
        viewers = [] if view is None else [Part("viewer", view, None, view.close)]
        parts: list[Component] = [
            Part("settings", None, lambda _: self._reloading.step(self.session, requests)),
            Part("source", reader, None, lambda _: reader.stop(0.1)),  # it has ended already, except after an error
            Part("recorder", files.recording, None, files.recording.close),
            Part("ledger.jsonl", requests, lambda _: evaluation.apply(requests), lambda _: requests.close()),
            Part("diagnoses", None, None, self.session.online_diagnosis.close),
            Part("events", recordings),
            Part("pages of events", files.event_writer, None, files.event_writer.close),
            Part("ledger", None, None, chores.settle),  # the last line of health names the ledger's last line
            files.health,
            self._summary,
            Part("history", files.history, None, files.history.close),
            Part("results.jsonl", files.results, sync, files.line_writer.close),
            Part(EVENTS, files.events, None, files.close_lines),
            *(Part(type(o).__name__, o, None, o.close) for o in reversed(self._publication.outlets)),
            Part("checkpoint", files.keeper),
            *viewers,
            Part("storage", files.storage, tidy, chores.close),
        ]
        if (store := claim.store) is not None:
            end = lambda timeout_s: store.close("ended" if reader.ended else "released", timeout_s)  # noqa: E731
            parts.append(Part("store", store, None, end))
        return (*parts, claim)

    @property
    def reader(self) -> Reader:
        """Reader of the source."""
        return self._evaluation.reader

    @property
    def session(self) -> Session:
        """Session that evaluates."""
        return self._evaluation.session

    @property
    def settings(self) -> Configuration:
        """Settings by which it goes on at present."""
        return self._reloading.settings

    def start(self) -> None:
        """Publish the state and begin to read the source."""
        self._publication.publish_state()
        self._vitals.look_at_disk()
        self.reader.start()

    def health(self, span: dict[str, Any] | None) -> None:
        """Write and publish a line of health, with the sensors' health of a span if one ended."""
        self._files.health.tell(span)

    def tell_open(self) -> None:
        """Write the line of health that says that the source is open."""
        self.health(None)

    def take(self, block: SampleBlock, arrived_s: float) -> None:
        """Evaluate and publish a block of the queue; once the time to end is up, it is counted only."""
        if self._clock() < self._end_s - (END_S - _DRAIN_S):
            self._evaluation.take(block, arrived_s)
        else:
            self._vitals.unprocessed += 1

    def step(self, now: float) -> None:
        """Have every part do what is due at `now`, s; raise the loss of the output folder or of its copy."""
        for part in self._parts:
            part.step(now)

    def ask_to_stop(self) -> None:
        """Set the deadlines by which the site ends; a signal handler may call this."""
        self._stopping, self._end_s = True, self._clock() + END_S

    def ask_to_reload(self) -> None:
        """Have the site file read again by a later `step`; a signal handler may call this."""
        self._reloading.ask()

    def stop_reading(self) -> None:
        """Close the source within its deadline; what has arrived can still be taken."""
        self.reader.stop(max(0.0, self._end_s - (END_S - _STOP_S) - self._clock()))

    def finish(self) -> None:
        """Keep what the next run goes on from; after the end of the data, wait for the last findings instead."""
        files = self._files
        files.chores.do("lock", self._claim.holds)
        files.chores.settle(DURABLE_S)
        if self._claim.lost is not None:
            return
        self._requests.finish(self.session, DURABLE_S)
        if self.reader.ended:
            self._summary.write()  # a diagnosis may take minutes
            self.session.finish(self._is_stopping)
            files.keeper.forget()
        else:
            files.keeper.save(self.session)

    def _is_stopping(self) -> bool:
        """Return whether the site was asked to stop; write health when it is due, for a site that waits is not silent."""
        self._files.health.step(self._clock())
        return self._stopping

    def raise_failure(self) -> None:
        """Raise the loss of the output folder, or the error that ended reading for good, if there is one.

        InUseError or MissingInputError tell that another daemon may have the folder, or that it was removed; MissingInputError
        and BadInputError are those of the source's files.
        """
        if self._claim.lost is not None:
            raise self._claim.lost
        failure = self.reader.failure
        if isinstance(failure, RecordingMissingError):
            raise MissingInputError(str(failure)) from failure
        if isinstance(failure, RecordingError):
            raise BadInputError(str(failure)) from failure
        if failure is not None:
            raise failure

    def outputs(self) -> list[tuple[str, Way]]:
        """List every part that may be blocked, with its name: source, recorder, outlets, viewer, checkpoint, history, files."""
        return [(part.name, part.way) for part in self._parts if part.way is not None]

    def close(self) -> None:
        """Close everything before the deadline; what hangs does not use up the time of the others, for each has half of it.

        An error of one part is raised once all others are closed.
        """
        self._end_s = min(self._end_s, self._clock() + END_S)
        with ExitStack() as closing:
            for part in reversed(self._parts):
                closing.callback(self._close, part)

    def _close(self, part: Component) -> None:
        part.close(max(0.0, self._end_s - self._clock()) / 2.0)


def _warm_up(warm: Callable[[], object], health: HealthLines) -> None:
    """Compile what a window needs, so that no window waits for it; meanwhile lines of health say that the daemon starts.

    What is not compiled now is compiled when it is needed.
    """
    worker = Worker[Callable[[], object]]("warm-up", Work(lambda job: job()))
    worker.start()
    worker.put(warm)
    is_warm = False
    while not is_warm:
        is_warm = worker.settle(max(health.quiet_s, _LEAN_POLL_S))  # not at once: it would take the compiler's time
        health.tell_start()
    worker.ask_to_end()
    if worker.failed is not None:
        _log.warning("not all is compiled before the first window: %s", worker.failed)


def _open_viewer(
    settings: Configuration, healthy: AnyBaseline | None, is_served: bool, undo: ExitStack
) -> RerunPublisher | None:
    """Open the viewer of a site, if it has one; its library is loaded only where one is served."""
    if (serve := settings.output.address) is None:
        return None
    if not is_served:
        _log.warning("output.serve: no viewer is served here; 'view' draws the recordings, and 'run' serves")
        return None
    from monitor.runs import open_viewer

    view = open_viewer(settings, healthy, file=None, serve=serve, lossless=False, on_warning=_log.warning)
    if view is not None:
        undo.callback(view.close, END_S)
    return view
