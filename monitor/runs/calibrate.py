"""Learns the healthy baseline from recordings, in one pass over them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from drivers.base import SampleBlock
from drivers.mcap_file import recording_info
from monitor.config import Configuration
from monitor.core import BadInputError, WindowResult, sha256
from monitor.damage import Baseline, Observation, Update, learn_baseline, second_solutions
from monitor.diagnosis import contradicted
from monitor.inference import Segments, gather
from monitor.pipeline import Pipeline
from monitor.runs import diagnose
from monitor.runs.recordings import OnProgress, OnWarning, Progress, file_names, push_block, read_blocks

_COMMON_MODE_SHARE = 0.9
"""Share of the windows in which a mode must be identified to belong to the baseline."""
_MAX_LEARNED_S = 40_000.0
"""Greatest length of the healthy data from which the reference of diagnoses is learned, s: 4000 segments of 20 s."""
_SHORT_RECORDINGS_BYTES = 40_000_000
_HOUR_NS = 3_600_000_000_000


def calibrate(
    paths: list[Path],
    config: Configuration,
    *,
    on_warning: OnWarning = lambda _: None,
    on_progress: OnProgress = lambda _: None,
) -> tuple[Baseline, Update]:
    """Learn the healthy baseline, and the reference of later diagnoses, from recordings.

    Returns
    -------
    Baseline
        Healthy baseline.
    Update
        Result of the model updating.

    Raises
    ------
    MissingInputError, BadInputError
        If a recording cannot be used, or no window can be identified.
    """
    pipeline, progress = Pipeline(config), Progress(on_progress)
    good: list[WindowResult] = []
    reasons: list[str] = []

    def pass_to_pipeline() -> Iterator[SampleBlock]:
        """Yield the blocks after the pipeline has evaluated them."""
        for block in read_blocks(paths, config, on_warning):
            progress.add(block)
            for result in push_block(pipeline, block, paths):
                if isinstance(result, WindowResult):
                    good.extend([result] if result.skipped is None else [])
                    reasons.extend([result.skipped.mend] if result.skipped is not None else [])
            yield block

    segments = _gather_hourly(pass_to_pipeline(), config, _learned_share(paths, config))
    progress.require_window(pipeline, len(good) + len(reasons), paths)
    if not good:
        raise BadInputError(f"{file_names(paths)}: no window could be identified, the last because: {reasons[-1]}")
    if reasons:
        on_warning(f"{len(reasons)} of {len(good) + len(reasons)} windows were left out, the last: {reasons[-1]}")
    good = _with_common_modes(good)
    recordings = tuple({"file": p.name, "sha256": sha256(p)} for p in paths)
    windows = [r.modes for r in good if r.modes is not None]
    rms = np.array([r.rms_m_s2 for r in good])
    assert progress.first is not None
    span_ns = (progress.first.t_ns, pipeline.state.align.t_next_ns())
    temperatures = [r.temperature for r in good if r.modes is not None]
    baseline, fit = learn_baseline(
        config.instrumented(),
        windows,
        rms,
        recordings,
        span_ns,
        temperatures,
        updating=config.updating,
        temperature=config.temperature,
    )
    _warn_of_ambiguities(baseline, config, good[-1], on_warning)
    if segments is None:
        on_warning("too short for a diagnosis to learn from; 'diagnose' will not take this baseline")
        return baseline, fit
    reference = diagnose.learn_healthy_prior(segments, config)
    if reference.error is not None:
        on_warning(contradicted(reference.error))
    return replace(baseline, reference=reference), fit


def _learned_share(paths: list[Path], config: Configuration) -> float:
    """Compute the share of every hour from which the reference is learned, so that memory stays bounded."""
    if sum(p.stat().st_size for p in paths) < _SHORT_RECORDINGS_BYTES:
        return 1.0
    seconds = sum(recording_info(p, topic_map=config.topics or None).duration_s for p in paths)
    return min(1.0, _MAX_LEARNED_S / seconds)


def _gather_hourly(blocks: Iterator[SampleBlock], config: Configuration, share: float) -> Segments | None:
    """Gather the segments in the first `share` of every hour; None if there are too few.

    All blocks are read, also those outside these segments.
    """
    refused: list[BadInputError] = []

    def beginnings_of_hours() -> Iterator[SampleBlock]:
        begun = 0
        try:
            for block in blocks:
                begun = begun or block.t_ns
                if (block.t_ns - begun) % _HOUR_NS < share * _HOUR_NS:
                    yield block
        except BadInputError as error:
            refused.append(error)
            raise

    try:
        return gather(beginnings_of_hours(), config.front_end())
    except BadInputError:
        if refused:
            raise
        return None


def _with_common_modes(windows: list[WindowResult]) -> list[WindowResult]:
    """Select the modes identified in at least `_COMMON_MODE_SHARE` of the windows, and the windows with all these modes."""
    seen = Counter(int(k) for w in windows if w.modes is not None for k in w.modes.model_mode)
    common = frozenset(k for k, count in seen.items() if count >= _COMMON_MODE_SHARE * len(windows))
    kept = [replace(w, modes=w.modes.only(common)) for w in windows if w.modes is not None]
    return [w for w in kept if w.modes is not None and w.modes.model_mode.size == len(common)]


def _warn_of_ambiguities(baseline: Baseline, config: Configuration, last: WindowResult, on_warning: OnWarning) -> None:
    """Warn of stories without influence on the modes, and of other stiffnesses that explain the same frequencies."""
    unidentified = last.damage.unidentified if last.damage is not None else ()
    if unidentified:
        on_warning(
            f"the modes say next to nothing about {', '.join(config.story_names[j - 1] for j in unidentified)}: damage there "
            "cannot be judged; more sensors or more modes would help"
        )
    if config.updating.use_shapes:
        return
    z = baseline.z - baseline.misfit
    target = Observation(z, np.eye(z.size), np.zeros((1, z.size)), baseline.model_mode, (), baseline.log)
    for other in second_solutions(baseline.model, config.instrumented().sensor_matrix, target, config.updating):
        on_warning(
            f"the same frequencies also follow from stiffnesses {', '.join(f'{k:.1f}' for k in other)} N/m: frequencies "
            "alone cannot tell which is true; set use_shapes = true under [updating]"
        )
