"""Recordings through the pipeline: replay writes results, calibrate learns a baseline."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivers.base import ACCELERATION, RecordingError, RecordingMissingError, SampleBlock
from drivers.mcap_file import McapWriter, read_recordings
from monitor.baseline import Baseline, learn
from monitor.config import Configuration
from monitor.errors import BadInputError, MissingInputError
from monitor.files import sha256, write_atomically
from monitor.pipeline import Pipeline
from monitor.publish.lines import LinesFile, to_json, window_line
from monitor.publish.rerun_view import RerunPublisher, Scene
from monitor.publish.summary import Summary
from monitor.results import Gap, Samples, WindowResult
from monitor.updating import Update

OnWarning = Callable[[str], None]
OnProgress = Callable[[float], None]


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a replay came to."""

    summary: dict[str, Any]
    last: WindowResult | None


@contextmanager
def user_errors() -> Iterator[None]:
    """Turn a driver's errors into the commands'."""
    try:
        yield
    except RecordingMissingError as error:
        raise MissingInputError(str(error)) from error
    except RecordingError as error:
        raise BadInputError(str(error)) from error


def blocks(paths: list[Path], config: Configuration, on_warning: OnWarning) -> Iterator[SampleBlock]:
    """All blocks of the recordings in time order.

    Raises
    ------
    MissingInputError, BadInputError
    """
    with user_errors():
        yield from read_recordings(paths, topic_map=config.topics or None, on_warning=on_warning)


def _duration_s(first: SampleBlock | None, last: SampleBlock | None) -> float:
    if first is None or last is None:
        return 0.0
    return (last.t_ns - first.t_ns) * 1e-9 + last.n_samples / last.sample_rate_hz


class _Progress:
    """Follows the data's time, to say when there was too little of it."""

    def __init__(self, on_progress: OnProgress) -> None:
        self.first: SampleBlock | None = None
        self.last: SampleBlock | None = None
        self._tell = on_progress

    def saw(self, block: SampleBlock) -> None:
        if block.topic == ACCELERATION:
            self.first = self.first or block
            self.last = block
            self._tell(_duration_s(self.first, block))

    def demand(self, config: Configuration, windows: int, paths: list[Path]) -> None:
        """Raise BadInputError if not even one window came about."""
        if windows == 0:
            duration, names = _duration_s(self.first, self.last), ", ".join(map(str, paths))
            raise BadInputError(
                f"{names}: {duration:.1f} s of data, but one window takes {config.processing.window_s:g} s; "
                "record longer or set a shorter window_s under [processing]"
            )


def scene(config: Configuration, baseline: Baseline | None) -> Scene:
    """What the viewer needs to know of the site."""
    heights = config.structure.story_heights_m
    n = len(config.structure.masses_kg)
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
    on_warning: OnWarning = lambda _: None,
    on_progress: OnProgress = lambda _: None,
) -> Outcome:
    """Run recordings through the pipeline and write results.jsonl, results.mcap, live.rrd and summary.json.

    Parameters
    ----------
    speed : float, optional
        Times real time; as fast as possible when None.

    Raises
    ------
    MissingInputError, BadInputError
        Too short for one window, missing channels, unreadable files.
    """
    pipeline, progress = Pipeline(config, baseline), _Progress(on_progress)
    source = blocks(paths, config, on_warning)
    first = next(source, None)  # bad input shows before any output is begun
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise MissingInputError(f"{out}: cannot be made: {error.strerror}") from error
    summary, last = Summary(len(config.structure.masses_kg)), None
    lines = LinesFile(out / "results.jsonl")
    results = McapWriter(out / "results.mcap")
    view = RerunPublisher(scene(config, baseline), file=out / "live.rrd", serve=None, lossless=True)
    began = time.monotonic()
    try:
        while first is not None:
            progress.saw(first)
            if speed is not None:
                _wait(began, _duration_s(progress.first, first) / speed)
            for result in pipeline.push(first):
                if isinstance(result, Samples):
                    view.samples(result)
                elif isinstance(result, Gap):
                    summary.gap(result)
                    view.gap(result)
                else:
                    summary.window(result)
                    line = to_json(window_line(result))
                    lines.write(line)
                    results.write_json("/results", result.t_end_ns, line)
                    view.window(result)
                    last = result
            first = next(source, None)
        progress.demand(config, summary.windows, paths)
    except BaseException:
        lines.abandon()
        results.abort()
        view.abort()
        raise
    lines.close()
    results.close()
    view.close(timeout_s=120.0)
    if view.failed is not None:
        on_warning(f"{out / 'live.rrd'} was not written: {view.failed}")
    state = pipeline.state.align
    summary.dropped_samples = 0 if state is None else state.dropped
    if summary.dropped_samples:
        on_warning(f"{summary.dropped_samples} samples were repeated, late or not finite and were dropped")
    elapsed = max(time.monotonic() - began, 1e-9)
    factor = _duration_s(progress.first, progress.last) / elapsed
    content = summary.content(factor, config.model().modes().frequencies_hz.tolist())
    write_atomically(out / "summary.json", to_json(content) + "\n")
    return Outcome(content, last)


def _wait(began: float, due_s: float) -> None:
    time.sleep(max(0.0, began + due_s - time.monotonic()))


def calibrate(
    paths: list[Path],
    config: Configuration,
    *,
    on_warning: OnWarning = lambda _: None,
    on_progress: OnProgress = lambda _: None,
) -> tuple[Baseline, Update]:
    """The healthy baseline from recordings.

    Raises
    ------
    MissingInputError, BadInputError
    """
    pipeline, progress = Pipeline(config), _Progress(on_progress)
    good: list[WindowResult] = []
    reasons: list[str] = []
    for block in blocks(paths, config, on_warning):
        progress.saw(block)
        for result in pipeline.push(block):
            if isinstance(result, WindowResult):
                good += [result] if result.skipped is None else []
                reasons += [result.skipped.reason] if result.skipped is not None else []
    progress.demand(config, len(good) + len(reasons), paths)
    if not good:
        raise BadInputError(f"no window could be identified, the last because: {reasons[-1]}")
    if reasons:
        on_warning(f"{len(reasons)} of {len(good) + len(reasons)} windows were left out, the last: {reasons[-1]}")
    assert pipeline.state.run is not None
    grid = pipeline.state.run.grid
    step = grid.hop_n // grid.block_n
    recordings = tuple({"file": p.name, "sha256": sha256(p)} for p in paths)
    windows = [(r.index * step, r.modes) for r in good if r.modes is not None]
    rms = np.array([r.rms_m_s2 for r in good])
    return learn(config, windows, rms, recordings)
