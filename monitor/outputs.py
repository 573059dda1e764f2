"""From a block to whoever takes its results: what replay and daemon share, so that live is replay, bit for bit."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from drivers.base import SampleBlock
from monitor import watch
from monitor.alarm import AlarmState
from monitor.baseline import Baseline
from monitor.config import Configuration
from monitor.health import Health
from monitor.pipeline import Pipeline, Result
from monitor.publish.lines import to_json, window_line
from monitor.publish.rerun_scene import Scene
from monitor.publish.rerun_view import RerunPublisher
from monitor.publish.summary import Summary
from monitor.results import Gap, Samples, WindowResult
from monitor.worker import Diagnoser, Recent

_MOST_FINDINGS = 1000


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

    def push(self, block: SampleBlock) -> list[Result]:
        """Take a block in and publish what it brings about.

        Raises
        ------
        BadInputError
            The pipeline refuses it; it is then as if it had never come.
        """
        results = self.pipeline.push(block)
        self.watcher.saw(block)
        for result in results:
            self._publish(result)
        return results

    def alter_alarm(self, change: Callable[[AlarmState], AlarmState]) -> None:
        """Apply an operator's wish (`monitor.alarm`: acknowledge, shelve, reset)."""
        state = self.pipeline.state
        self.pipeline.state = replace(state, alarm=change(state.alarm))

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
        keys = ("id", "t_ns", "from_ns", "reason", "verdict", "says", "causes")
        return {
            **summary,
            "findings": [{key: f[key] for key in keys} for f in findings],
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
        self._settings, self._window_s = config.watch, config.processing.window_s
        self._recent = Recent(max(self._settings.longest_s, 2.0 * self._window_s))
        self._state, self._t_ns = watch.WatchState(), 0
        self.found: deque[dict[str, Any]] = deque(maxlen=_MOST_FINDINGS)
        """The latest findings."""
        self._diagnoser = Diagnoser(*files, folder, self._settings.time_limit_s) if files is not None else None

    def saw(self, block: SampleBlock) -> None:
        """Keep a block for a diagnosis."""
        if self._diagnoser is not None:
            self._recent.push(block)
            self.found += self._diagnoser.poll()

    def window(self, result: WindowResult) -> None:
        """Follow the results."""
        self._t_ns = result.t_end_ns
        self._state, request = watch.step(self._state, result, self._settings, self._window_s)
        self._ask(request)

    def finish(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Wait for the last finding, unless `stop` says otherwise."""
        self._ask(watch.finish(self._state, self._t_ns, self._settings, self._window_s))
        if self._diagnoser is not None:
            self.found += self._diagnoser.wait(stop)

    def close(self, timeout_s: float = 5.0) -> None:
        """End what still runs; waits no longer than `timeout_s`."""
        if self._diagnoser is not None:
            self._diagnoser.close(timeout_s)

    def _ask(self, request: watch.Request | None) -> None:
        if request is not None and self._diagnoser is not None:
            self._diagnoser.ask(request, self._recent.between(request.from_ns, request.to_ns))


class Quality:
    """All spans of a run in one table."""

    def __init__(self) -> None:
        self._samples = self._gaps = self._overlaps = 0
        self._lost_s = self._seconds = 0.0
        self._channels: dict[str, dict[str, float]] = {}

    def add(self, health: Health) -> None:
        """Take a span in."""
        self._samples += health.samples
        self._gaps += health.gaps
        self._overlaps += health.overlaps
        self._lost_s += health.lost_s
        seconds = health.samples / health.rate_hz
        self._seconds += seconds
        for c in health.channels:
            total = self._channels.setdefault(c.channel, dict.fromkeys(("power", "spikes", "stuck_s", "clipped"), 0.0))
            total["power"] += c.rms_m_s2**2 * seconds
            total["spikes"] += c.spikes
            total["stuck_s"] += seconds if c.repeated == 1.0 else 0.0
            total["clipped"] += c.clipped * health.samples

    def content(self) -> dict[str, Any]:
        """Table for summary.json."""
        channels = {
            name: {
                "rms_m_s2": float(np.sqrt(c["power"] / self._seconds)),
                "spikes": int(c["spikes"]),
                "stuck_s": c["stuck_s"],
                "clipped_samples": round(c["clipped"]),
            }
            for name, c in self._channels.items()
        }
        wanted_s = self._seconds + self._lost_s
        return {
            "availability": self._seconds / wanted_s if wanted_s else None,
            "samples": self._samples,
            "gaps": self._gaps,
            "lost_s": self._lost_s,
            "overlaps": self._overlaps,
            "channels": channels,
        }


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
