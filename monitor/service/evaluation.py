"""What comes of a block of a site's source, and what the site knows by it at present."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial

from drivers.base import SampleBlock
from drivers.recorder import unfit
from monitor.config import Configuration, configuration
from monitor.core import BadInputError, Level, WindowResult, utc
from monitor.damage import Assessment, outdated
from monitor.events import Event
from monitor.pipeline import Result
from monitor.runs import Progress, Session
from monitor.service.daemon_health import Vitals
from monitor.service.request_handler import RequestHandler
from monitor.service.site_files import SiteFiles
from monitor.service.site_store import SiteStore
from monitor.service.threads import Reader

DURABLE_S = 0.5
"""Longest wait for the disk before a change of an alarm is announced. [s; judgement]"""
_LATE_S = 30.0
"""Shortest delay of data by the wall clock from which the state is no present one. [s; judgement]"""


class Evaluation:
    """Session of a site, what has come for it, and the present state of the structure.

    `reader` is set when the source is known, which depends on what the session was resumed from.
    """

    reader: Reader
    session: Session

    def __init__(
        self,
        settings: Configuration,
        files: SiteFiles,
        vitals: Vitals,
        store: SiteStore | None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._files, self._vitals, self._store, self._clock = files, vitals, store, clock
        self._bounds = configuration.make_bounds(settings.source)
        self._hop_s = settings.processing.hop_s
        self.progress = Progress(lambda _: None)
        self._data_s: float | None = None  # no data have come yet: what a checkpoint knows is no present state
        self._block_s = 0.0
        self._alarm: object = None

    def resume(self, begin: Callable[[], Session]) -> int:
        """Begin a session where the previous run stopped; return the end of the samples processed then (UTC, ns)."""

        def new() -> Session:
            self.session = begin()
            return self.session

        return self._files.keeper.resume(new, self._files.history.window)

    def take(self, block: SampleBlock, arrived_s: float) -> None:
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
        self.progress.add(block)
        if self.session.windows > before:
            self._vitals.published(arrived_s)
        self._files.keeper.took(self.session, block)

    def _record(self, block: SampleBlock, known_ns: int, results: Sequence[Result]) -> None:
        """Record an accepted block; a block that changes an alarm is on the disk before the change is announced.

        While motion is strong, or may be, every block goes to the disk at once, and nothing waits for that.
        `known_ns` is the end of the data before it: a block without a new sample is no sign that data come.
        """
        if self.session.now_ns != known_ns:
            self._data_s, self._block_s = self._clock(), block.n_samples / block.sample_rate_hz
        self._files.recording.write(block, at_once=self.session.may_be_strong)
        alarms = [(r.alarm.active, r.alarm.conditions) for r in results if isinstance(r, WindowResult)]
        exceeded = any(isinstance(r, Event) and r.exceeded for r in results)
        if exceeded or any(alarm != self._alarm for alarm in alarms):
            self._alarm = alarms[-1] if alarms else self._alarm
            self._files.recording.flush(DURABLE_S)
            if self._store is not None:
                self._store.settle(DURABLE_S)

    def apply(self, requests: RequestHandler) -> None:
        """Apply the operators' requests that wait; they are timed by the clock of data that have come."""
        requests.step(self.session, timed=self.progress.first is not None)

    @property
    def age_s(self) -> float | None:
        """Time since the latest data were taken, s; None before the first of this run."""
        return None if self._data_s is None else max(0.0, self._clock() - self._data_s)

    @property
    def is_late(self) -> bool:
        """Whether the next block is overdue by more than two hops and `_LATE_S`: none waits, and the source has not ended."""
        if self._files.keeper.resuming or self.reader.ended or len(self.reader.queue):
            return False
        if self.age_s is None:  # of an earlier run alone
            return self.session.windows > 0
        return self.age_s > self._block_s + max(2.0 * self._hop_s, _LATE_S)

    @property
    def present(self) -> Assessment:
        """The present state of the structure: that of the session, outdated once data are late."""
        present = self.session.present
        if not self.is_late:
            return present
        lasting = "" if self.age_s is None else f" (for {_span(self.age_s)})"
        return outdated(present, f"no data since {utc(self.session.now_ns)} UTC{lasting}")

    @property
    def episodes(self) -> list[tuple[int, Level, bool]]:
        """The alarm episodes: story, highest level, and whether it lasts."""
        return [(loss.story, loss.level, loss.t_last_ns is None) for loss in self.session.episodes]


def _span(seconds: float) -> str:
    """Write a span in seconds up to two minutes, in minutes up to two hours, then in hours."""
    limits = ((120.0, 1.0, "s"), (7200.0, 60.0, "min"), (float("inf"), 3600.0, "h"))
    return next(f"{seconds / unit:.0f} {name}" for limit, unit, name in limits if seconds < limit)
