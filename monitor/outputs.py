"""From a block to whoever takes its results: what replay and daemon share, so that live is replay, bit for bit."""

from __future__ import annotations

import copy
import json
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from drivers.base import SampleBlock
from monitor import watch
from monitor.alarm import AlarmState
from monitor.baseline import Baseline
from monitor.config import Configuration
from monitor.health import Health
from monitor.pipeline import Pipeline, PipelineState, Result
from monitor.publish.lines import to_json, window_line
from monitor.publish.rerun_scene import Scene
from monitor.publish.rerun_view import RerunPublisher
from monitor.publish.summary import Episode, Quality, Summary
from monitor.results import Gap, Samples, WindowResult
from monitor.worker import Diagnoser, Recent

_MOST_FINDINGS = 1000
_FINDING_KEYS = ("id", "t_ns", "from_ns", "reason", "verdict", "says", "causes")


class Publisher:
    """Takes results; what a kind of publisher has no use for passes by."""

    def samples(self, samples: Samples) -> None:
        """Conditioned samples."""

    def gap(self, gap: Gap) -> None:
        """Samples are missing."""

    def window(self, result: WindowResult, line: str) -> None:
        """Everything said about a window; `line` is its line of results.jsonl."""

    def health(self, health: Health) -> None:
        """The sensors in a span."""

    def finding(self, finding: dict[str, Any]) -> None:
        """A diagnosis is there."""


class View(Publisher):
    """The Rerun view as a publisher."""

    def __init__(self, view: RerunPublisher) -> None:
        self.view = view

    def samples(self, samples: Samples) -> None:
        """Draw them."""
        self.view.samples(samples)

    def gap(self, gap: Gap) -> None:
        """Mark it."""
        self.view.gap(gap)

    def window(self, result: WindowResult, line: str) -> None:
        """Draw it."""
        self.view.window(result)

    def health(self, health: Health) -> None:
        """Draw it."""
        self.view.health(health)

    def finding(self, finding: dict[str, Any]) -> None:
        """Show what it says."""
        self.view.finding(finding)


@dataclass(frozen=True, slots=True)
class WatcherState:
    """Diagnoses: which episode is watched, what is known, and what is still to be made."""

    episode: watch.WatchState
    t_ns: int
    found: tuple[str, ...]
    """Findings, each as JSON."""
    pending: tuple[watch.Request, ...]
    asked: int


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
        for finding in self.watcher.saw(block):
            for publisher in self._publishers:
                publisher.finding(finding)
        for result in results:
            self._publish(result)
        return results

    def alter_alarm(self, change: Callable[[AlarmState], AlarmState]) -> None:
        """Apply an operator's wish (`monitor.alarm`: acknowledge, shelve, reset)."""
        state = self.pipeline.state
        self.pipeline.state = replace(state, alarm=change(state.alarm))

    def reconfigure(self, config: Configuration) -> None:
        """Go on with other thresholds; nothing else of the configuration may differ (`monitor.reload`)."""
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
            "findings": [{key: f[key] for key in _FINDING_KEYS} for f in findings],
            "quality": self._quality.content(),
            "thresholds": self.config.alarm.model_dump(include={"significance", "min_loss", "alarm_loss"}),
        }

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


class Watcher:
    """Asks for a diagnosis where the results call for one."""

    def __init__(self, config: Configuration, files: tuple[Path, Path | None] | None, folder: Path) -> None:
        self.settings, self._window_s = config.watch, config.processing.window_s
        self.longest_s = max(self.settings.longest_s, 2.0 * self._window_s)
        """Length of data that a diagnosis may be given."""
        self._recent = Recent(self.longest_s)
        self._state, self._t_ns = watch.WatchState(), 0
        self.found: deque[dict[str, Any]] = deque(maxlen=_MOST_FINDINGS)
        """The latest findings."""
        self._diagnoser = Diagnoser(*files, folder, self.settings.time_limit_s) if files is not None else None

    @property
    def state(self) -> WatcherState:
        """What to restore; blocks are to be remembered again besides."""
        found = tuple(json.dumps({key: f[key] for key in _FINDING_KEYS}) for f in self.found)
        pending, asked = ((), 0) if self._diagnoser is None else (self._diagnoser.pending, self._diagnoser.asked)
        return WatcherState(self._state, self._t_ns, found, pending, asked)

    def restore(self, state: WatcherState) -> None:
        """Go on from there; what was being diagnosed is asked for anew, of the blocks remembered."""
        self._state, self._t_ns = state.episode, state.t_ns
        self.found.extend(json.loads(text) for text in state.found)
        if self._diagnoser is not None:
            self._diagnoser.asked = state.asked - len(state.pending)
            for request in state.pending:
                self._ask(request)

    def remember(self, block: SampleBlock) -> None:
        """Keep a block for a diagnosis."""
        self._recent.push(block)

    def saw(self, block: SampleBlock) -> list[dict[str, Any]]:
        """Keep a block for a diagnosis; findings that became ready."""
        if self._diagnoser is None:
            return []
        self.remember(block)
        found = self._diagnoser.poll()
        self.found += found
        return found

    def window(self, result: WindowResult) -> None:
        """Follow the results."""
        self._t_ns = result.t_end_ns
        self._state, request = watch.step(self._state, result, self.settings, self._window_s)
        self._ask(request)

    def finish(self, stop: Callable[[], bool] = lambda: False) -> list[dict[str, Any]]:
        """Wait for the last findings, unless `stop` says otherwise."""
        self._ask(watch.finish(self._state, self._t_ns, self.settings, self._window_s))
        found = [] if self._diagnoser is None else self._diagnoser.wait(stop)
        self.found += found
        return found

    def close(self, timeout_s: float = 5.0) -> None:
        """End what still runs; waits no longer than `timeout_s`."""
        if self._diagnoser is not None:
            self._diagnoser.close(timeout_s)

    def _ask(self, request: watch.Request | None) -> None:
        if request is not None and self._diagnoser is not None:
            self._diagnoser.ask(request, self._recent.between(request.from_ns, request.to_ns))


def scene(config: Configuration, baseline: Baseline | None) -> Scene:
    """What the viewer needs to know of the site."""
    heights = config.structure.story_heights_m
    n = max(len(config.structure.masses_kg), len(config.structure.stiffness_n_per_m))
    return Scene(
        name=config.site.name or config.structure.name or "structure",
        channels=config.channels,
        sensor_floor=tuple(s.floor for s in config.sensors),
        story_heights_m=np.ones(n) if heights is None else np.array(heights),
        baseline_frequencies_hz=None if baseline is None else baseline.frequencies_hz,
        has_baseline=baseline is not None,
        alarm_loss=config.alarm.alarm_loss,
        model=config.model() if baseline is None else baseline.model,
        cutoff_hz=config.processing.cutoff_hz,
        misfit_asks=config.watch.misfit,
    )
