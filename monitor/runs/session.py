"""From a block to whoever takes its results: what replay and daemon share, so that live is replay, bit for bit."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from drivers.base import SampleBlock
from monitor.config import Configuration
from monitor.core import Gap, Samples
from monitor.damage import AlarmState, Baseline
from monitor.pipeline import Pipeline, PipelineState, Result
from monitor.publish import Episode, Publisher, Quality, Summary, to_json, window_line
from monitor.runs.online_diagnosis import FINDING_KEYS, Watcher, WatcherState
from monitor.signals import Health


@dataclass(frozen=True, slots=True)
class SessionState:
    """All that a session knows; what is given is never changed any more."""

    pipeline: PipelineState
    summary: Summary
    quality: Quality
    watcher: WatcherState


class Session:
    """The pipeline, and everything that its results go to.

    Parameters
    ----------
    publishers : sequence of Publisher
        In the order in which they are told.
    files : (Path, Path or None), optional
        Structure or site file, and baseline, for the diagnoses that alarms ask for; none are made without.
    findings : Path
        Folder of these.
    """

    def __init__(
        self,
        config: Configuration,
        baseline: Baseline | None,
        publishers: Sequence[Publisher],
        files: tuple[Path, Path | None] | None,
        findings: Path,
    ) -> None:
        self.config = config
        self.pipeline = Pipeline(config, baseline)
        self.watcher = Watcher(config, files, findings)
        self._publishers = publishers
        self._summary, self._quality = Summary(), Quality()
        self._model_hz = config.model().modes().frequencies_hz.tolist()

    @property
    def windows(self) -> int:
        """Windows so far."""
        return self._summary.windows

    @property
    def dropped(self) -> int:
        """Samples repeated, late or not finite."""
        return self.pipeline.state.align.dropped

    @property
    def now_ns(self) -> int:
        """UTC of the data: just past the latest sample."""
        return self.pipeline.state.align.t_next_ns()

    @property
    def episodes(self) -> Sequence[Episode]:
        """Alarms so far, in the order in which they began."""
        return self._summary.alarms

    @property
    def state(self) -> SessionState:
        """What to restore to go on from here."""
        summary, quality = copy.deepcopy((self._summary, self._quality))
        return SessionState(self.pipeline.state, summary, quality, self.watcher.state)

    def restore(self, state: SessionState) -> None:
        """Go on from there."""
        self.pipeline.state = state.pipeline
        self._summary, self._quality = copy.deepcopy((state.summary, state.quality))
        self.watcher.restore(state.watcher)

    def push(self, block: SampleBlock, accepted: Callable[[list[Result]], None] = lambda _: None) -> list[Result]:
        """Take a block in and publish what it brings about.

        Parameters
        ----------
        accepted : callable
            Told the results before anybody else is.

        Raises
        ------
        BadInputError
            The pipeline refuses it; it is then as if it had never come.
        """
        results = self.pipeline.push(block)
        accepted(results)
        self._tell(self.watcher.saw(block))
        for result in results:
            self._publish(result)
        return results

    def finish(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Wait for the last findings, unless `stop` says otherwise, and publish them."""
        self._tell(self.watcher.finish(stop))

    def alter_alarm(self, change: Callable[[AlarmState], AlarmState]) -> None:
        """Apply an operator's wish (`monitor.damage.damage_index.alarm`: acknowledge, shelve, reset)."""
        state = self.pipeline.state
        self.pipeline.state = replace(state, alarm=change(state.alarm))

    def reconfigure(self, config: Configuration) -> None:
        """Go on with other thresholds; nothing else of the configuration may differ (`monitor.service.reload`)."""
        self.config = self.pipeline.config = config
        self.watcher.settings = config.watch

    def content(self, realtime_factor: float) -> dict[str, Any]:
        """summary.json: the run so far with its findings, and beside every alarm what a diagnosis of its time said."""
        self._summary.dropped_samples = self.dropped
        summary = self._summary.content(realtime_factor, self._model_hz)
        findings = self.watcher.found
        for alarm in summary["alarms"]:
            told = (
                f["says"]
                for f in findings
                if alarm["t_first_ns"] <= f["t_ns"]
                and (alarm["t_last_ns"] is None or f["from_ns"] <= alarm["t_last_ns"])
            )
            alarm["verdict"] = next(told, None) or None
        return {
            **summary,
            "findings": [{key: f[key] for key in FINDING_KEYS} for f in findings],
            "quality": self._quality.content(),
            "thresholds": self.config.alarm.model_dump(include={"significance", "min_loss", "alarm_loss"}),
        }

    def _tell(self, findings: Iterable[dict[str, Any]]) -> None:
        for finding in findings:
            for publisher in self._publishers:
                publisher.finding(finding)

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
            for publisher in self._publishers:
                publisher.health(result)
        else:
            self._summary.window(result)
            line = to_json(window_line(result))
            for publisher in self._publishers:
                publisher.window(result, line)
            self.watcher.window(result)
