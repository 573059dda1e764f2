"""Learns the healthy modes of a structure without a model from recordings, in two passes over them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from monitor.config import Configuration
from monitor.core import BadInputError, WindowResult, sha256
from monitor.damage import ModalBaseline, learn_modal_baseline
from monitor.identification import tracking
from monitor.model import Modes
from monitor.pipeline import Pipeline
from monitor.runs.baselines import modal_origin
from monitor.runs.calibrate import (
    covariate_units,
    warn_of_clock,
    warn_of_confounding,
    warn_of_missing_modes,
    why_not_learned,
    with_common_modes,
)
from monitor.runs.recordings import OnProgress, OnWarning, Progress, file_names, push_block, read_blocks

_COMMON_SHARE = 0.5
"""Share of the looks in which a mode must be found by itself to become one that is looked for. [ratio; judgement: what is learned
is decided by the share of the windows in which it is found then]"""


def calibrate_modes(
    paths: list[Path],
    config: Configuration,
    *,
    on_warning: OnWarning = lambda _: None,
    on_progress: OnProgress = lambda _: None,
) -> ModalBaseline:
    """Learn the healthy modes from recordings.

    The first pass chooses the modes of each window by themselves, and takes those that come again and again.  The second finds
    these in each window, as every later window is evaluated, and learns from that.

    Raises
    ------
    MissingInputError, BadInputError
        If a recording cannot be used, or no window can be identified.
    """
    first = Pipeline(config)
    results, _ = _windows(paths, config, first, on_warning, on_progress)
    reference = common_modes(first.state.track, config.selection.max_modes)
    if reference is None:
        skipped = [r.skipped.mend for r in results if r.skipped is not None]
        because = f", the last because: {skipped[-1]}" if skipped else "; record for longer"
        raise BadInputError(f"{file_names(paths)}: no mode is found again and again{because}")
    second = Pipeline(config, reference=reference)
    results, progress = _windows(paths, config, second, lambda _: None, on_progress)
    reasons = [why for r in results if (why := why_not_learned(r))]
    good = [r for r in results if not why_not_learned(r)]
    if not good:
        raise BadInputError(f"{file_names(paths)}: no window could be identified, the last because: {reasons[-1]}")
    if reasons:
        on_warning(f"{len(reasons)} of {len(results)} windows were left out, the last: {reasons[-1]}")
    kept = with_common_modes(good, config.selection.required_modes)
    progress.require_periods([r.modes for r in kept if r.modes is not None], paths)
    warn_of_missing_modes(good, kept, on_warning)
    assert progress.first is not None
    baseline = learn_modal_baseline(
        config.channels,
        modal_origin(config),
        [r.modes for r in kept if r.modes is not None],
        np.array([r.rms_m_s2 for r in kept]),
        tuple({"file": p.name, "sha256": sha256(p)} for p in paths),
        (progress.first.t_ns, second.state.align.t_next_ns()),
        [r.covariates for r in kept if r.modes is not None],
        covariate_units(config),
        config.compensation,
        motion=[r.motion for r in kept if r.motion is not None],
    )
    warn_of_clock(second, on_warning)
    warn_of_confounding(baseline, on_warning)
    return replace(baseline, clock_ratio=second.state.align.clock.ratio)


def common_modes(state: tracking.TrackState, most: int) -> Modes | None:
    """Take the tracked modes that were found in most looks, at most `most`, by frequency; None where there are none."""
    looks = max((t.hits + t.misses for t in state.tracks), default=0.0)
    often = sorted((t for t in state.tracks if t.hits >= _COMMON_SHARE * looks), key=lambda t: -t.hits)[:most]
    if not often:
        return None
    often.sort(key=lambda t: t.ln_f)
    shapes = np.nan_to_num(np.array([t.shape for t in often]))
    shapes = shapes / shapes[np.arange(len(often)), np.abs(shapes).argmax(axis=1)][:, None]
    return Modes((2.0 * np.pi * np.exp([t.ln_f for t in often])) ** 2, shapes.real.T)


def _windows(
    paths: list[Path], config: Configuration, pipeline: Pipeline, on_warning: OnWarning, on_progress: OnProgress
) -> tuple[list[WindowResult], Progress]:
    """Push recordings through a pipeline; return its windows, and how far it came."""
    progress, results = Progress(on_progress), list[WindowResult]()
    for block in read_blocks(paths, config, on_warning):
        progress.add(block)
        results += [r for r in push_block(pipeline, block, paths) if isinstance(r, WindowResult)]
    progress.require_window(pipeline, len(results), paths)
    return results, progress
