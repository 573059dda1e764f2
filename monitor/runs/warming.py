"""Compilation of the functions that a window needs, before the first window needs them."""

from __future__ import annotations

import numpy as np

from drivers.base import ACCELERATION
from monitor.config import Configuration
from monitor.core import Reading, WindowResult
from monitor.damage import AlarmSettings, AnyBaseline, Baseline, Expected, alarm, smallest_detectable_loss
from monitor.model import Model, ShearFrame, simulate
from monitor.pipeline import Pipeline
from monitor.runs.synthetic_recording import cut_into_blocks

_NOISE = 0.03
"""Noise of the simulated sensors over the RMS of the motion, so that no channel counts as dead. [ratio; judgement]"""
_RATIO = 1.25
"""Rate of the simulated samples over that of the windows; not whole, so that samples are interpolated. [ratio; judgement]"""
_FRAME_HZ = 2.0
"""Lowest frequency of the frame that stands for a structure without a model. [Hz; judgement: within any band in use]"""
_FRAME = {
    "structure": {
        "kind": "shear_frame",
        "masses_kg": [0.3253, 0.3514, 0.3129],
        "stiffness_n_per_m": [2909.4511, 1514.8507, 1897.6986],
        "damping_ratio": 0.01,
    },
    "sensors": [{"channel": f"a{floor}", "floor": floor} for floor in (1, 2, 3)],
}
"""Structure for a machine whose site file does not exist yet. [SI; the three-story frame of the README]"""


def _model(config: Configuration, baseline: AnyBaseline | None) -> Model:
    """Return the site's model, or a frame with a floor for each channel where there is none."""
    if isinstance(baseline, Baseline):
        return baseline.model
    if config.has_model:
        return config.model()
    n = len(config.floor_sensors)
    # The lowest frequency of a shear frame is near that of a single floor over its number.
    stiffness = (2.0 * np.pi * _FRAME_HZ * n) ** 2
    return Model(ShearFrame(np.ones(n), np.full(n, stiffness), 0.01))


def warm_up(config: Configuration | None = None, baseline: AnyBaseline | None = None) -> int:
    """Push simulated samples through pipelines of a site's settings, by default of a small frame; count the windows judged.

    What a window needs is compiled by that, with and without refinement, or loaded where an earlier process compiled it
    (`monitor.core.compiled`): half a minute of one processor the first time, about a second later.  The functions that alarms
    need are compiled only with a baseline.
    """
    config = Configuration.model_validate(_FRAME) if config is None else config
    p = config.processing
    rate_hz = _RATIO * p.rate_hz
    motion = simulate(_model(config, baseline), duration_s=p.window_s + 2.0 * p.hop_s, rate_hz=rate_hz, noise=_NOISE)
    # What sensors at degrees of freedom see; how they are mounted compiles nothing else.
    seen = np.eye(motion.floors.shape[1]) if not config.has_model else config.instrumented().sensor_matrix
    samples = motion.floors @ seen.T
    blocks = list(cut_into_blocks(ACCELERATION, samples, config.channels, rate_hz, 0, round(rate_hz)))
    judged = 0
    for is_refined in {config.refinement.enabled, False}:
        refinement = config.refinement.model_copy(update={"enabled": is_refined})
        pipeline = Pipeline(config.model_copy(update={"refinement": refinement}), baseline)
        results = [result for block in blocks for result in pipeline.push(block)]
        judged += sum(isinstance(r, WindowResult) and r.skipped is None for r in results)
    if baseline is not None:
        _warm_up_later()
    return judged


def _warm_up_later() -> None:
    """Compile what the second reading of other data than the first needs, and what is known after weeks of service."""
    state, reading, settings = alarm.start(2, 1.0), Reading(np.zeros(2), np.eye(2)), AlarmSettings()
    for t_s in (1, 2):
        state, _ = alarm.step(state, reading, t_s * 1_000_000_000, settings)
    smallest_detectable_loss(reading, state.history, settings, alarm.tests_of(reading, beside_others=True))
    Expected(np.eye(2), np.zeros(2), 1.0, np.zeros((2, 2)), 0.0).beside_others(np.zeros(2), np.eye(2))
