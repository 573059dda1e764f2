"""Recordings through the pipeline, with results as files."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from drivers.base import SampleBlock
from drivers.mcap_file import McapWriter
from monitor import watch
from monitor.baseline import Baseline
from monitor.calibrate import calibrate
from monitor.config import Configuration
from monitor.errors import MissingInputError
from monitor.files import demand_place, write_atomically
from monitor.pipeline import Pipeline, Result
from monitor.publish.lines import LinesFile, to_json, window_line
from monitor.publish.rerun_scene import Scene
from monitor.publish.rerun_view import RerunPublisher
from monitor.publish.summary import Summary
from monitor.recordings import OnProgress, OnWarning, Progress, blocks, duration_s, pushed
from monitor.results import Gap, Samples, WindowResult
from monitor.worker import Diagnoser, Recent

__all__ = ["RESULT_FILES", "calibrate", "replay", "scene"]

RESULT_FILES = ("results.jsonl", "results.mcap", "live.rrd", "summary.json")
"""What `replay` leaves in its folder."""


class _Outputs:
    """The files of a replay; each takes its final name when it is whole, and none before the last window."""

    def __init__(self, out: Path, scene: Scene, serve: tuple[str, int] | None) -> None:
        for name in RESULT_FILES:
            demand_place(out / name)
        self._lines = LinesFile(out / "results.jsonl")
        self._results = McapWriter(out / "results.mcap")
        self.out = out
        self.view = RerunPublisher(scene, file=out / "live.rrd", serve=serve, lossless=True)

    def window(self, result: WindowResult) -> None:
        line = to_json(window_line(result))
        self._lines.write(line)
        self._results.write_json("/results", result.t_end_ns, line)
        self.view.window(result)

    def close(self, summary: dict[str, Any], findings: list[dict[str, Any]]) -> None:
        try:
            for finding in findings:
                self._results.write_json("/findings", finding["t_ns"], to_json(finding))
            self._lines.close()
            self._results.close()
            write_atomically(self.out / "summary.json", to_json(summary) + "\n")
        except OSError as error:
            raise MissingInputError(f"{self.out}: cannot be written: {error.strerror}") from error
        self.view.close(timeout_s=120.0)

    def abandon(self) -> None:
        self._lines.abandon()
        self._results.abort()
        self.view.abort()


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
    )


def replay(
    paths: list[Path],
    config: Configuration,
    baseline: Baseline | None,
    out: Path,
    *,
    speed: float | None = None,
    serve: tuple[str, int] | None = None,
    files: tuple[Path, Path | None] | None = None,
    on_warning: OnWarning = lambda _: None,
    on_progress: OnProgress = lambda _: None,
) -> dict[str, Any]:
    """Run recordings through the pipeline, write `RESULT_FILES` and return the content of summary.json.

    Parameters
    ----------
    speed : float, optional
        Times real time; as fast as possible when None.
    serve : (str, int), optional
        Address and port where Rerun viewers may join meanwhile.
    files : (Path, Path or None), optional
        Structure and baseline file, for the diagnoses that alarms ask for; none are made without.

    Raises
    ------
    MissingInputError, BadInputError
        Too short for one window, missing channels, unreadable files.
    """
    pipeline, progress = Pipeline(config, baseline), Progress(on_progress)
    source = blocks(paths, config, on_warning)
    block = next(source, None)  # bad input shows before any output is begun
    outputs = _Outputs(out, scene(config, baseline), serve)
    summary = Summary()
    watcher = _Watcher(config, files, out / "findings")
    began = time.monotonic()
    try:
        while block is not None:
            progress.saw(block)
            watcher.saw(block)
            if speed is not None:
                _wait(began, duration_s(progress.first, block) / speed)
            for result in pushed(pipeline, block, paths):
                _publish(result, summary, outputs, watcher)
            block = next(source, None)
        progress.demand(pipeline, summary.windows, paths)
        summary.dropped_samples = pipeline.state.align.dropped
        factor = duration_s(progress.first, progress.last) / max(time.monotonic() - began, 1e-9)
        findings = watcher.finish()
        content = _with_findings(summary.content(factor, config.model().modes().frequencies_hz.tolist()), findings)
        outputs.close(content, findings)
    except BaseException:
        outputs.abandon()
        raise
    finally:
        watcher.close()
    _tell_losses(outputs, findings, summary, on_warning)
    return content


def _publish(result: Result, summary: Summary, outputs: _Outputs, watcher: _Watcher) -> None:
    """Hand a result to whoever takes it."""
    if isinstance(result, Samples):
        outputs.view.samples(result)
    elif isinstance(result, Gap):
        summary.gap(result)
        outputs.view.gap(result)
    else:
        summary.window(result)
        outputs.window(result)
        watcher.window(result)


def _tell_losses(outputs: _Outputs, findings: list[dict[str, Any]], summary: Summary, on_warning: OnWarning) -> None:
    """What went wrong on the way without ending the replay."""
    for finding in findings:
        if "error" in finding:
            on_warning(f"finding {finding['id']} ({finding['reason']}) came to nothing: {finding['error']}")
    if outputs.view.failed is not None:
        on_warning(f"{outputs.out / 'live.rrd'} was not written: {outputs.view.failed}")
    if summary.dropped_samples:
        on_warning(f"{summary.dropped_samples} samples were repeated, late or not finite and were dropped")


class _Watcher:
    """Asks for a diagnosis where the results call for one."""

    def __init__(self, config: Configuration, files: tuple[Path, Path | None] | None, folder: Path) -> None:
        self._settings, self._window_s = config.watch, config.processing.window_s
        self._recent = Recent(max(self._settings.longest_s, 2.0 * self._window_s))
        self._state, self._t_ns = watch.WatchState(), 0
        self._found: list[dict[str, Any]] = []
        self._diagnoser = Diagnoser(*files, folder, self._settings.time_limit_s) if files is not None else None

    def saw(self, block: SampleBlock) -> None:
        if self._diagnoser is not None:
            self._recent.push(block)
            self._found += self._diagnoser.poll()

    def window(self, result: WindowResult) -> None:
        self._t_ns = result.t_end_ns
        self._state, request = watch.step(self._state, result, self._settings, self._window_s)
        self._ask(request)

    def finish(self) -> list[dict[str, Any]]:
        """All findings, once the last one is there."""
        self._ask(watch.finish(self._state, self._t_ns, self._settings, self._window_s))
        if self._diagnoser is not None:
            self._found += self._diagnoser.wait()
        return self._found

    def close(self) -> None:
        if self._diagnoser is not None:
            self._diagnoser.close()

    def _ask(self, request: watch.Request | None) -> None:
        if request is not None and self._diagnoser is not None:
            self._diagnoser.ask(request, self._recent.between(request.from_ns, request.to_ns))


def _with_findings(summary: dict[str, Any], findings: list[dict[str, Any]]) -> dict[str, Any]:
    """summary.json with the findings, and beside every alarm what a diagnosis of its time said."""
    keys = ("id", "t_ns", "from_ns", "reason", "verdict", "says", "causes")
    for alarm in summary["alarms"]:
        told = (
            f["says"]
            for f in findings
            if alarm["t_first_ns"] <= f["t_ns"] and (alarm["t_last_ns"] is None or f["from_ns"] <= alarm["t_last_ns"])
        )
        alarm["verdict"] = next(told, None) or None
    return {**summary, "findings": [{key: f[key] for key in keys} for f in findings]}


def _wait(began: float, due_s: float) -> None:
    time.sleep(max(0.0, began + due_s - time.monotonic()))
