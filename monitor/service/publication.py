"""What is told of a site: the results of its session, its state, and its summary."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from monitor.core import Gap, UserError, WindowResult
from monitor.damage import Assessment
from monitor.events import Event
from monitor.publish import Publisher, current_alarm_line, episode_content, to_json
from monitor.runs import duration_s, page_of, write_event_page
from monitor.service.daemon_health import Vitals, plain
from monitor.service.evaluation import Evaluation
from monitor.service.outlets import Outlet
from monitor.service.site_files import SiteFiles
from monitor.signals import Health

if TYPE_CHECKING:
    from monitor.publish import RerunPublisher

_log = logging.getLogger(__name__)

_LATEST = 50
"""Number of the latest alarms of which the history learns at each window. [1; cost]"""


class Publication(Publisher):
    """Results of the session, on their way into the files, the viewer and the outlets.

    What a previous run wrote already, or what it told as present, is not told again.
    """

    def __init__(
        self,
        out: Path,
        evaluation: Evaluation,
        files: SiteFiles,
        view: RerunPublisher | None,
        outlets: Sequence[Outlet],
    ) -> None:
        self._out, self.evaluation, self.files, self._view, self.outlets = out, evaluation, files, view, outlets
        self._said: Assessment | None = None

    def window(self, result: WindowResult, line: str) -> None:
        """Write and publish the result of a window, unless a previous run did so."""
        present, history = self.publish_state(), self.files.history
        session = self.evaluation.session
        history.episodes([episode_content(e, session.story_names) for e in session.episodes[-_LATEST:]])
        if result.index in self.files.keeper.written:
            return
        history.window(json.loads(line) | {"state": present.state.value})
        self.files.results.write_window(line, result.t_end_ns)
        for outlet in self.outlets:
            outlet.window(result, line)

    def event(self, event: Event, line: str) -> None:
        """Write and publish what is told of an event, unless a previous run did so."""
        if event.revision is None:
            if self.files.keeper.resuming:
                return
        elif not self.files.events.write_event(event.id, event.revision, line):
            return
        else:
            # After the job that writes its recording, in the same thread.
            self.files.event_writer.do(f"page {event.id}", partial(self._write_page, event.id, line))
        for outlet in self.outlets:
            outlet.event(event, line)

    def gap(self, gap: Gap) -> None:
        """Store and publish a gap in the data."""
        self.files.history.gap(gap.t_ns, gap.duration_s, gap.reason)
        if not self.files.keeper.resuming:
            for outlet in self.outlets:
                outlet.gap(gap)

    def state(self, assessment: Assessment) -> None:
        """Publish the present state of the structure; a past one is none to tell as the present one."""
        if not self.files.keeper.resuming:
            self._said = assessment
            for outlet in self.outlets:
                outlet.state(assessment)

    def health(self, health: Health) -> None:
        """Write and publish the sensors' health together with the daemon's own health."""
        span = plain(health)
        self.files.history.health(span)
        if not self.files.keeper.resuming:  # before, the source is not open yet, and its clocks are the present ones
            clocks = self.evaluation.reader.source.health().clocks
            if self._view is not None:
                self._view.clocks(health.t_end_ns, clocks)
            measured = tuple((c.node, 1.0 + 1e-6 * c.drift_ppm, 1e-6 * c.drift_std_ppm) for c in clocks)
            self.evaluation.session.clocks = measured
        self.files.health.tell(span)

    def finding(self, finding: dict[str, Any]) -> None:
        """Store and publish the finding of a diagnosis."""
        self.files.history.finding(finding)
        for outlet in self.outlets:
            outlet.finding(finding)

    def publish_state(self) -> Assessment:
        """Publish the present state where it is not what was published last, and return it."""
        present = self.evaluation.present
        if present != self._said:
            self.state(present)
            if self._view is not None:
                self._view.state(present)
        return present

    def _write_page(self, id: str, line: str) -> None:
        try:
            write_event_page(self._out, json.loads(line), page_of(self._out, id))
        except Exception as error:  # noqa: BLE001 - the thread goes on to write the recordings of later events
            unexpected = not isinstance(error, UserError | OSError)
            _log.error("%s: the page of event %s is not written: %s", self._out, id, error, exc_info=unexpected)


class SummaryFile:
    """File summary.json, written at least every `quiet_s`, and when an alarm or the age of the data changes the state."""

    name = "summary.json"

    def __init__(
        self,
        out: Path,
        publication: Publication,
        vitals: Vitals,
        is_allowed: Callable[[], bool],
        quiet_s: float,
        clock: Callable[[], float],
    ) -> None:
        self._path, self._publication, self._vitals = out / self.name, publication, vitals
        self.way, self._is_allowed, self._quiet_s, self._clock = publication.files.chores, is_allowed, quiet_s, clock
        self._begun_s = self._told_s = clock()
        self._told: tuple[object, bool] = [], False

    def step(self, now: float) -> None:
        """Write it if it is due at `now`, s."""
        if now - self._told_s >= self._quiet_s or self._told != self._tells:
            self.write()

    def close(self, timeout_s: float) -> None:
        """Write it for the last time."""
        self.write()

    @property
    def _tells(self) -> tuple[object, bool]:
        evaluation = self._publication.evaluation
        return evaluation.episodes, evaluation.is_late

    def write(self) -> None:
        """Have it written, if the folder is still this site's, and tell it."""
        self._told_s, self._told = self._clock(), self._tells
        evaluation, vitals = self._publication.evaluation, self._vitals
        session, progress = evaluation.session, evaluation.progress
        seconds = duration_s(progress.first, progress.last)
        content = session.content(seconds / max(self._told_s - self._begun_s, 1e-9))
        content |= {"refused_blocks": vitals.refused, "unprocessed_blocks": vitals.unprocessed}
        pipeline = session.pipeline
        content["latency_ms"] = vitals.latency()
        content["alarm"] = current_alarm_line(
            pipeline.state.alarm, pipeline.quantities.parts, pipeline.quantities.names
        )
        content = plain(content | evaluation.present.content)
        self.way.write(self._path, to_json(content) + "\n", self._is_allowed)
        for outlet in self._publication.outlets:
            outlet.summary(content)
