"""A baseline learned from a structure of any kind, and windows judged against it."""

from __future__ import annotations

import numpy as np

from monitor.config import Configuration
from monitor.core import WindowResult
from monitor.damage import Baseline, learn_baseline
from monitor.model.model import Model
from monitor.model.simulation import simulate
from monitor.pipeline import Pipeline
from monitor.runs import calibrate, cut_into_blocks


def configured(structure: dict, floors: tuple[int, ...], **tables: object) -> Configuration:
    sensors = [{"channel": f"a{i}", "floor": i} for i in floors]
    return Configuration.model_validate({"structure": structure, "sensors": sensors, **tables})


def results_of(model: Model, settings: Configuration, healthy: Baseline | None, seed: int, duration_s: float):
    floors = simulate(model, duration_s=duration_s, rate_hz=128.0, noise=0.05, seed=seed).floors
    pipeline = Pipeline(settings, healthy)
    values = floors @ settings.instrumented().sensor_matrix.T
    blocks = cut_into_blocks("/acceleration", values, settings.channels, 128.0, 0, 1280)
    return [r for b in blocks for r in pipeline.push(b) if isinstance(r, WindowResult)]


def learned(settings: Configuration, truth: Model, seed: int, duration_s: float) -> Baseline:
    judged = [r for r in results_of(truth, settings, None, seed, duration_s) if r.skipped is None]
    windows = calibrate.with_common_modes(judged, settings.selection.required_modes)
    return learn_baseline(
        settings.instrumented(),
        [r.modes for r in windows],
        np.array([r.rms_m_s2 for r in windows]),
        (),
        updating=settings.updating,
        compensation=settings.compensation,
    )[0]
