"""Session: a pipeline with its summary, the diagnoses that its results request, and the publishers of its results.

A replay and the daemon run the same session, so that the daemon's results equal those of a replay bit for bit.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from drivers.base import SampleBlock
from monitor.config import Configuration
from monitor.core import Gap, Samples, WindowResult, rounded
from monitor.damage import (
    AlarmState,
    AnyBaseline,
    Assessment,
    Known,
    Loss,
    ModalBaseline,
    WindowFacts,
    assess,
    common_words,
    diagnosis_of,
    follow,
    hold,
    learned_ranges,
    modal_parts,
)
from monitor.events import Event, EventAlarm
from monitor.pipeline import Pipeline, PipelineState, Result
from monitor.publish import (
    Publisher,
    Quality,
    Summary,
    event_line,
    facts_of_line,
    reaches_between,
    to_json,
    window_line,
)
from monitor.runs.event_recordings import EventRecordings
from monitor.runs.online_diagnosis import FINDING_KEYS, BlockStore, OnlineDiagnosis, OnlineDiagnosisState
from monitor.signals import Health, HealthState, sensor_health


@dataclass(frozen=True, slots=True)
class SessionState:
    """State of a session for a checkpoint; no part of the state changes later."""

    pipeline: PipelineState
    summary: Summary
    quality: Quality
    watcher: OnlineDiagnosisState


class Session:
    """Session that pushes blocks of samples through the pipeline, and passes the results to publishers, in their order.

    No alarm is raised without a baseline.  The diagnoses that alarms request read `files`, the structure or site file and the
    baseline, and write into the folder `findings`; none is made without files, nor where there is no model.  They take their
    blocks from `store`, by default in memory.  `recordings` writes the samples of events, if it is given.  The state is that
    of the `whole` run, as of a recording, or the present one, as of a site.  No window that holds time `between` the
    recordings that are replayed (UTC in ns) is due, so the summary does not count it.
    """

    def __init__(
        self,
        config: Configuration,
        baseline: AnyBaseline | None,
        publishers: Sequence[Publisher],
        files: tuple[Path, Path | None] | None,
        findings: Path,
        *,
        whole: bool = False,
        recordings: EventRecordings | None = None,
        store: BlockStore | None = None,
        between: Sequence[tuple[int, int]] = (),
    ) -> None:
        self.config = config
        self.pipeline = Pipeline(config, baseline)
        self.online_diagnosis = OnlineDiagnosis(config, files if config.has_model else None, findings, store)
        self._publishers, self._recordings = publishers, recordings
        self._summary, self._quality = Summary(), Quality()
        self._model_hz = config.model().modes().frequencies_hz.tolist() if config.has_model else []
        self._baseline, self._whole, self._between = baseline, whole, tuple(between)
        self._assessment: Assessment | None = None
        self._aside_faults: tuple[tuple[str, str], ...] = ()
        self.clocks: tuple[tuple[str, float, float], ...] = ()
        """Each sensor node whose rate the driver measures: its name, its rate over the stated one, and its deviation."""
        self.events = 0
        """Number of times that something was told of an event."""
        self.stated: dict[int, WindowFacts] = {}
        """What an earlier run wrote of windows that are still to come again, by their indices; the summary counts it."""
        self.not_due = 0
        """Number of windows that hold time between recordings and say nothing."""

    @property
    def windows(self) -> int:
        """Number of windows that were due so far."""
        return self._summary.course.windows

    @property
    def story_names(self) -> tuple[str, ...]:
        """What people call the stories, or what else the alarms are about."""
        return self._known.names

    @property
    def dropped(self) -> int:
        """Number of samples dropped because they were repeated, late or not finite."""
        return self.pipeline.state.align.dropped

    @property
    def now_ns(self) -> int:
        """Time of the data, one sampling period after the latest sample, UTC in ns."""
        return self.pipeline.state.align.t_next_ns()

    @property
    def may_be_strong(self) -> bool:
        """Whether the motion of an event goes on, or may have begun."""
        return self.pipeline.state.events.may_be_strong

    @property
    def episodes(self) -> Sequence[Loss]:
        """Alarm episodes so far, in the order in which they began."""
        return self._summary.course.losses

    @property
    def assessment(self) -> Assessment:
        """The state of the structure: of the whole run or the present one."""
        return self._assess(self._whole)

    @property
    def present(self) -> Assessment:
        """The present state of the structure."""
        return self._assess(whole=False)

    @property
    def state(self) -> SessionState:
        """State for a checkpoint."""
        summary, quality = copy.deepcopy((self._summary, self._quality))
        return SessionState(self.pipeline.state, summary, quality, self.online_diagnosis.state)

    def restore(self, state: SessionState) -> None:
        """Continue from a checkpoint."""
        self.pipeline.state = state.pipeline
        self._summary, self._quality = copy.deepcopy((state.summary, state.quality))
        self.online_diagnosis.restore(state.watcher)

    def push(self, block: SampleBlock, accepted: Callable[[list[Result]], None] = lambda _: None) -> list[Result]:
        """Evaluate a block of samples, publish the results, and return them.

        `accepted` is called with the results before any publisher takes them, except where the block came before.  Raises
        BadInputError if the pipeline refuses the block; the state of the session is then unchanged.
        """
        going = bool(self.pipeline.state.events.strong)  # what this block ends is saved below, so it is kept until then
        known = self.pipeline.state.known
        results = self.pipeline.push(block)
        if not results and self.pipeline.state.known is known:  # it came before: it is not recorded again either
            return []
        accepted(results)
        if self._recordings is not None:
            self._recordings.push(block, active=going or bool(self.pipeline.state.events.strong))
        self._publish_findings(self.online_diagnosis.push(block))
        for result in results:
            self._publish(result)
        return results

    @property
    def longest_s(self) -> float:
        """Length of data before a checkpoint that a diagnosis or an event after it may need."""
        reach_s = 0.0 if self._recordings is None else self._recordings.reach_s
        return max(self.online_diagnosis.longest_s, reach_s)

    def keep_block(self, block: SampleBlock) -> None:
        """Keep a block from before a checkpoint, which a diagnosis or an event after it may need."""
        self.online_diagnosis.keep_block(block)
        if self._recordings is not None:
            self._recordings.push(block, active=True)

    def finish(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Publish events that the end of the data cuts, and the last findings, waited for unless `stop` returns True."""
        for event in self.pipeline.finish():
            self._publish(event)
        self._publish_findings(self.online_diagnosis.finish(stop))

    def alter_alarm(self, change: Callable[[AlarmState], AlarmState]) -> None:
        """Apply an operator's request to the alarm (`monitor.damage.alarm`: acknowledge, shelve, reset)."""
        state = self.pipeline.state
        self.pipeline.state = replace(state, alarm=change(state.alarm))

    def alter_events(self, change: Callable[[tuple[EventAlarm, ...]], tuple[EventAlarm, ...]]) -> None:
        """Apply an operator's request to the alarms of events (`monitor.events.alarm`: acknowledge)."""
        state = self.pipeline.state
        self.pipeline.state = replace(state, events=replace(state.events, alarms=change(state.events.alarms)))

    def reconfigure(self, config: Configuration) -> None:
        """Continue with other thresholds; the rest of the configuration must be equal (`monitor.service.reload`)."""
        self.config = self.pipeline.config = config
        self.__dict__.pop("_known", None)  # it holds thresholds of the configuration
        self.online_diagnosis.settings = config.watch

    def content(self, realtime_factor: float) -> dict[str, Any]:
        """Return the content of summary.json: the run so far, its alarms with their verdicts, and its findings.

        `realtime_factor` is the length of the data over the run time of the evaluation.
        """
        self._summary.dropped_samples = self.dropped
        findings = self.online_diagnosis.findings
        summary = self._summary.content(realtime_factor, self._model_hz, self.story_names)
        for alarm, loss in zip(summary["alarms"], self.episodes, strict=True):
            alarm["verdict"] = diagnosis_of(loss, findings, self.story_names)
        return {
            **self.assessment.content,
            **summary,
            "known": asdict(self._known_now),
            "contact": self.config.site.contact,
            "baseline_frequencies_hz": self._baseline_hz(),
            "covariates_learned": {
                name: learned._asdict()
                for name, learned in learned_ranges(None if self._baseline is None else self._baseline.law).items()
            },
            "event_alarms": [
                {"id": a.id, "condition": a.condition.value, "exceeded": list(a.exceeded), "by": a.acknowledged_by}
                for a in self.pipeline.state.events.alarms
            ],
            "common_change": common_words(self.pipeline.law),
            "findings": [{key: f.get(key) for key in FINDING_KEYS} for f in findings],
            "quality": self._quality.content(),
            "thresholds": self.config.alarm.model_dump(
                include={"false_announcements_per_year", "min_loss", "alarm_loss"}
            ),
        }

    def _assess(self, whole: bool) -> Assessment:
        _, present = hold(self.pipeline.state.alarm, 0)
        findings = self.online_diagnosis.findings
        run, window_s = self.pipeline.state.run, self.config.processing.window_s
        first_ns = None if run is None else run.t0_ns + round(window_s * 1e9)
        exceeded = [a.says for a in self.pipeline.state.events.alarms if a.unacknowledged]
        return assess(
            self._summary.course,
            self._known_now,
            findings,
            standing=present.active,
            exceeded=exceeded,
            clocks=self.clocks,
            first=(window_s, first_ns),
            whole=whole,
        )

    @cached_property
    def _about(self) -> dict[str, str]:
        """Collect what the page of an event needs of the site's files."""
        processing = self.config.processing.model_dump_json()
        name = self.config.site.name or self.config.structure.name
        return {"site": to_json(self.pipeline.site.content()), "processing": processing, "name": name}

    @property
    def _known_now(self) -> Known:
        """What the state depends on and no window changes, with the channels that the stream has beside those in use."""
        witnesses = [s.channel for s in self.config.witnesses]
        aside = tuple(dict.fromkeys((*witnesses, *self.pipeline.state.beside.names)))
        return replace(self._known, aside=aside, aside_faults=self._aside_faults) if aside else self._known

    @cached_property
    def _known(self) -> Known:
        """Collect what the state depends on and no window changes; the model is built for it, so once."""
        c, b = self.config, self._baseline
        modes = b.frequencies_hz.size if isinstance(b, ModalBaseline) else 0
        return Known(
            names=c.story_names if c.has_model else modal_parts(modes),
            has_baseline=b is not None,
            alarm_loss=c.alarm.alarm_loss,
            misfit=c.watch.misfit,
            level_range_m_s2=None if b is None else b.level_range_m_s2,
            baseline_doubts=() if b is None else b.doubts,
            unwatched=c.unwatched,
            accepted=tuple((e.name, e.location) for e in c.model().effects) if c.has_model else (),
            channels=c.channels,
            clock_ratio=1.0 if b is None else b.clock_ratio,
            n_modes=None if c.has_model else modes,
        )

    def _baseline_hz(self) -> dict[int, float]:
        """Return the natural frequencies at calibration, Hz, by the modes' numbers from 1."""
        b = self._baseline
        if b is None:
            return {}
        numbers = range(b.frequencies_hz.size) if isinstance(b, ModalBaseline) else b.model_mode
        return {k + 1: rounded(hz) for k, hz in zip(numbers, b.frequencies_hz, strict=True)}

    def _publish_findings(self, findings: Iterable[dict[str, Any]]) -> None:
        for finding in findings:
            self._publish_state()
            for publisher in self._publishers:
                publisher.finding(finding)

    def _publish_state(self) -> None:
        present = self.present
        if present != self._assessment:
            self._assessment = present
            for publisher in self._publishers:
                publisher.state(present)

    def _publish(self, result: Result) -> None:
        if isinstance(result, Samples):
            for publisher in self._publishers:
                publisher.samples(result)
        elif isinstance(result, Gap):
            self._summary.gap(result)
            for publisher in self._publishers:
                publisher.gap(result)
        elif isinstance(result, Health):
            self._quality.add(result)
            self._note_faults(result)
            for publisher in self._publishers:
                publisher.health(result)
        elif isinstance(result, Event):
            self.events += 1
            recording = None if self._recordings is None else self._recordings.save(result, self._about)
            if self._recordings is not None and recording is None and result.revision is not None:
                full = "its samples are not kept: [events] keep_gb is full"
                result = replace(result, note="; ".join(filter(None, (result.note, full))))
            line = to_json(event_line(result, recording))
            self._publish_state()
            for publisher in self._publishers:
                publisher.event(result, line)
        else:
            content = window_line(result)
            self._count(result, facts_of_line(content))
            self._publish_state()
            line = to_json(content)
            for publisher in self._publishers:
                publisher.window(result, line)
            self.online_diagnosis.window(result)

    def _note_faults(self, health: Health) -> None:
        """Note the faults, in the latest span, of channels that enter no estimate."""
        names = self.pipeline.state.beside.names
        if not names:
            return
        span = HealthState(spans=(health,))
        found = sensor_health.check(span, health.t_ns, health.t_end_ns, self.config.health)
        found |= {c.channel: "gives no numbers" for c in health.channels if c.lost == 1.0}
        self._aside_faults = tuple((name, found[name].partition(" (")[0]) for name in names if name in found)

    def _count(self, result: WindowResult, facts: WindowFacts) -> None:
        """Count a window in the summary, unless it was not due."""
        window_s, known = self.config.processing.window_s, self._known
        if result.skipped is not None and reaches_between(result.t_end_ns, window_s, self._between):
            self.not_due += 1
            return
        for index in sorted(i for i in self.stated if i < result.index):  # their samples were lost with that run
            self._summary.course = follow(self._summary.course, self.stated.pop(index), known)
        self._summary.window(result, facts, known, self.stated.pop(result.index, None))
