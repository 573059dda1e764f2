"""Recordings through the pipeline: replay writes results, calibrate learns a baseline."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from drivers.base import ACCELERATION, RecordingError, RecordingMissingError, SampleBlock
from drivers.mcap_file import McapWriter, read_recordings
from monitor.baseline import Baseline, learn
from monitor.config import Configuration
from monitor.errors import BadInputError, MissingInputError
from monitor.files import demand_place, sha256, write_atomically
from monitor.pipeline import Pipeline, Result
from monitor.publish.lines import LinesFile, to_json, window_line
from monitor.publish.rerun_scene import Scene
from monitor.publish.rerun_view import RerunPublisher
from monitor.publish.summary import Summary
from monitor.results import Gap, Samples, WindowResult
from monitor.second_solutions import second_solutions
from monitor.updating import Observation, Update

OnWarning = Callable[[str], None]
OnProgress = Callable[[float], None]


_COMMON = 0.9
"""A mode belongs to the baseline when this share of the windows shows it."""

RESULT_FILES = ("results.jsonl", "results.mcap", "live.rrd", "summary.json")
"""What `replay` leaves in its folder."""


def blocks(paths: list[Path], config: Configuration, on_warning: OnWarning) -> Iterator[SampleBlock]:
    """All blocks of the recordings in time order.

    Raises
    ------
    MissingInputError, BadInputError
    """
    try:
        yield from read_recordings(paths, topic_map=config.topics or None, on_warning=on_warning)
    except RecordingMissingError as error:
        raise MissingInputError(str(error)) from error
    except RecordingError as error:
        raise BadInputError(str(error)) from error


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

    def demand(self, pipeline: Pipeline, windows: int, paths: list[Path]) -> None:
        """Raise BadInputError if not even one window came about."""
        if windows:
            return
        state, window_s = pipeline.state.align, pipeline.config.processing.window_s
        usable = state.n_run / state.rate_hz
        lost = f" ({state.dropped} samples were repeated, late or not finite)" if state.dropped else ""
        raise BadInputError(
            f"{_names(paths)}: {usable:.1f} s of usable data without a gap{lost}, but one window takes {window_s:g} s; "
            "record longer or set a shorter window_s under [processing]"
        )


def _names(paths: list[Path]) -> str:
    return ", ".join(map(str, paths))


def _pushed(pipeline: Pipeline, block: SampleBlock, paths: list[Path]) -> list[Result]:
    """The pipeline's results; what it refuses is said of the recordings."""
    try:
        return pipeline.push(block)
    except BadInputError as error:
        raise BadInputError(f"{_names(paths)}: {error}") from error


class _Outputs:
    """The files of a replay; each takes its final name when it is whole, and none before the last window."""

    def __init__(self, out: Path, scene: Scene, serve: tuple[str, int] | None) -> None:
        for name in RESULT_FILES:
            demand_place(out / name)
        self._lines = LinesFile(out / "results.jsonl")
        self._results = McapWriter(out / "results.mcap")
        self._out = out
        self.view = RerunPublisher(scene, file=out / "live.rrd", serve=serve, lossless=True)

    def window(self, result: WindowResult) -> None:
        line = to_json(window_line(result))
        self._lines.write(line)
        self._results.write_json("/results", result.t_end_ns, line)
        self.view.window(result)

    def close(self, summary: dict[str, Any]) -> None:
        try:
            self._lines.close()
            self._results.close()
            write_atomically(self._out / "summary.json", to_json(summary) + "\n")
        except OSError as error:
            raise MissingInputError(f"{self._out}: cannot be written: {error.strerror}") from error
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

    Raises
    ------
    MissingInputError, BadInputError
        Too short for one window, missing channels, unreadable files.
    """
    pipeline, progress = Pipeline(config, baseline), _Progress(on_progress)
    source = blocks(paths, config, on_warning)
    block = next(source, None)  # bad input shows before any output is begun
    outputs = _Outputs(out, scene(config, baseline), serve)
    summary = Summary()
    began = time.monotonic()
    try:
        while block is not None:
            progress.saw(block)
            if speed is not None:
                _wait(began, _duration_s(progress.first, block) / speed)
            for result in _pushed(pipeline, block, paths):
                if isinstance(result, Samples):
                    outputs.view.samples(result)
                elif isinstance(result, Gap):
                    summary.gap(result)
                    outputs.view.gap(result)
                else:
                    summary.window(result)
                    outputs.window(result)
            block = next(source, None)
        progress.demand(pipeline, summary.windows, paths)
        summary.dropped_samples = pipeline.state.align.dropped
        factor = _duration_s(progress.first, progress.last) / max(time.monotonic() - began, 1e-9)
        content = summary.content(factor, config.model().modes().frequencies_hz.tolist())
        outputs.close(content)
    except BaseException:
        outputs.abandon()
        raise
    if outputs.view.failed is not None:
        on_warning(f"{out / 'live.rrd'} was not written: {outputs.view.failed}")
    if summary.dropped_samples:
        on_warning(f"{summary.dropped_samples} samples were repeated, late or not finite and were dropped")
    return content


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
        for result in _pushed(pipeline, block, paths):
            if isinstance(result, WindowResult):
                good += [result] if result.skipped is None else []
                reasons += [result.skipped.reason] if result.skipped is not None else []
    progress.demand(pipeline, len(good) + len(reasons), paths)
    if not good:
        raise BadInputError(f"{_names(paths)}: no window could be identified, the last because: {reasons[-1]}")
    if reasons:
        on_warning(f"{len(reasons)} of {len(good) + len(reasons)} windows were left out, the last: {reasons[-1]}")
    good = _with_common_modes(good)
    recordings = tuple({"file": p.name, "sha256": sha256(p)} for p in paths)
    windows = [r.modes for r in good if r.modes is not None]
    rms = np.array([r.rms_m_s2 for r in good])
    assert progress.first is not None
    span_ns = (progress.first.t_ns, pipeline.state.align.t_next_ns())
    temperatures = [r.temperature for r in good if r.modes is not None]
    baseline, fit = learn(config, windows, rms, recordings, span_ns, temperatures)
    _tell_doubts(baseline, config, good[-1], on_warning)
    return baseline, fit


def _with_common_modes(windows: list[WindowResult]) -> list[WindowResult]:
    """The windows with those modes alone that nearly all of them show, without the few that do not."""
    seen = Counter(int(k) for w in windows if w.modes is not None for k in w.modes.model_mode)
    common = frozenset(k for k, count in seen.items() if count >= _COMMON * len(windows))
    kept = [replace(w, modes=w.modes.only(common)) for w in windows if w.modes is not None]
    return [w for w in kept if w.modes is not None and w.modes.model_mode.size == len(common)]


def _tell_doubts(baseline: Baseline, config: Configuration, last: WindowResult, on_warning: OnWarning) -> None:
    """What these sensors and modes cannot tell, said before anybody relies on it."""
    unidentified = last.damage.unidentified if last.damage is not None else ()
    if unidentified:
        on_warning(
            f"the modes say next to nothing about story {', '.join(map(str, unidentified))}: damage there "
            "cannot be judged; more sensors or more modes would help"
        )
    if config.updating.use_shapes:
        return
    z = baseline.z - baseline.misfit
    target = Observation(z, np.eye(z.size), np.zeros((1, z.size)), baseline.model_mode, (), baseline.log)
    for other in second_solutions(baseline.model, config.sensor_matrix(), target, config.updating):
        on_warning(
            f"the same frequencies also follow from stiffnesses {', '.join(f'{k:.1f}' for k in other)} N/m: frequencies "
            "alone cannot tell which is true; set use_shapes = true under [updating]"
        )
