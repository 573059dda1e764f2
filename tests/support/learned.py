"""A baseline learned from a structure of any kind, and windows judged against it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from monitor.config import Configuration
from monitor.core import ModalEstimate, WindowResult
from monitor.damage import Baseline, HealthyData, learn_baseline
from monitor.model import Model, simulate
from monitor.pipeline import Pipeline
from monitor.runs import calibrate, cut_into_blocks


def results_of(model: Model, settings: Configuration, healthy: Baseline | None, seed: int, duration_s: float):
    floors = simulate(model, duration_s=duration_s, rate_hz=128.0, noise=0.05, seed=seed).floors
    pipeline = Pipeline(settings, healthy)
    values = floors @ settings.instrumented().sensor_matrix.T
    blocks = cut_into_blocks("/acceleration", values, settings.channels, 128.0, 0, 1280)
    return [r for b in blocks for r in pipeline.push(b) if isinstance(r, WindowResult)]


def learned(settings: Configuration, truth: Model, seed: int, duration_s: float) -> Baseline:
    judged = [r for r in results_of(truth, settings, None, seed, duration_s) if r.skipped is None]
    windows = calibrate.with_common_modes(judged, settings.selection.required_modes)
    return baseline_of(settings, windows)


def baseline_of(
    settings: Configuration, windows: Sequence[WindowResult | ModalEstimate], recordings: Sequence[dict] = ()
) -> Baseline:
    """Of the modes of windows, or of modes alone; windows without modes are left out."""
    found = [w for w in windows if isinstance(w, ModalEstimate) or w.modes is not None]
    return learn_baseline(
        settings.instrumented(),
        HealthyData(
            windows=[w if isinstance(w, ModalEstimate) else w.modes for w in found],
            rms_m_s2=np.array([1.0 if isinstance(w, ModalEstimate) else w.rms_m_s2 for w in found]),
            recordings=tuple(recordings),
        ),
        updating=settings.updating,
        compensation=settings.compensation,
    )[0]
