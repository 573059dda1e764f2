"""Ambient motion of simulated frames, the windows that a pipeline sees of it, and the baseline that is learned from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from drivers.base import ACCELERATION
from monitor.config import Configuration
from monitor.core import Array, Window, WindowResult
from monitor.damage import Baseline, HealthyData, learn_baseline
from monitor.model import ExcitationKind, Model, ShearFrame, simulate
from monitor.pipeline import Pipeline
from monitor.runs import cut_into_blocks
from monitor.signals import SegmentDesign, WindowGrid, transform, windows

PAPER_FRAME = ShearFrame(np.array([0.3253, 0.3514, 0.3129]), np.array([2909.4511, 1514.8507, 1897.6986]), 0.01)


def seeded(*numbers: int) -> int:
    """A seed for each combination of numbers."""
    return int(np.random.SeedSequence(numbers).generate_state(1)[0])


def ambient(
    model: Model, seconds: float, rate_hz: float, seed: int, *, loss: Any = 0.0, noise: float = 0.1, lead_s: float = 0.0,
    level_spread: float = 0.0, excitation: ExcitationKind = "ambient",
) -> Array:  # fmt: skip
    """Accelerations of the floors, shape (n, floors), after `lead_s` of the same motion; `loss` is each story's relative loss."""
    if np.any(loss):
        model = model.with_stiffness(model.structure.stiffness_n_per_m * (1.0 - np.asarray(loss)))
    length_s = seconds + lead_s
    motion = simulate(
        model, duration_s=length_s, rate_hz=rate_hz, excitation=excitation, noise=noise, level_spread=level_spread, seed=seed
    )  # fmt: skip
    return motion.floors[round(lead_s * rate_hz) :]


def windows_of(
    pipeline: Pipeline, floors: Array, rate_hz: float, *, t0_ns: int = 0, first: int = 0, size: int = 10_000
) -> list[WindowResult]:
    """Push a record, whose first sample has the number `first`, through a pipeline."""
    blocks = cut_into_blocks(ACCELERATION, floors, pipeline.config.channels, rate_hz, t0_ns, size, first=first)
    return [r for block in blocks for r in pipeline.push(block) if isinstance(r, WindowResult)]


def learned(
    config: Configuration, windows: Sequence[WindowResult], *, level_of: Pipeline | None = None,
    units: Mapping[str, str] | None = None, span_ns: tuple[int, int] = (0, 0), motion: bool = False,
) -> Baseline:  # fmt: skip
    """Learn the baseline of windows, with a law of the covariates in `units`, or of the level that a pipeline saw."""
    good = [r for r in windows if r.modes is not None]
    rms, weights, units = np.ones(1), None, units or {}
    if level_of is not None:
        rms, weights = np.array([r.rms_m_s2 for r in good], dtype=float), level_of.level_weights
        units = {"level": "dB"}
    healthy = HealthyData(
        windows=[r.modes for r in good if r.modes is not None],
        rms_m_s2=rms,
        span_ns=span_ns,
        covariates=[{name: r.covariates[name] for name in units} for r in good] if units else [],
        units=units,
        motion=[r.motion for r in good if r.motion is not None] if motion else [],
    )
    return learn_baseline(
        config.instrumented(),
        healthy,
        updating=config.updating,
        compensation=config.compensation,
        drift_weights=weights,
    )[0]


def segments_of(samples: Array, rate_hz: float, n: int, n_bins: int) -> tuple[Array, float]:
    """Transforms of half-overlapping segments of n samples, shape (segments, bins, channels), and the step of the bins, Hz."""
    design = SegmentDesign(rate_hz, n, n_bins)
    parts = [transform(design, samples[k : k + n]) for k in range(0, len(samples) - n + 1, n // 2)]
    return np.stack(parts), design.step_hz


def whole_window(samples: Array, rate_hz: float, block_n: int, n_lags: int) -> Window:
    """One window of all samples."""
    grid = WindowGrid(rate_hz, len(samples), block_n, n_lags)
    _, (item,) = windows.step(grid, windows.start(grid, samples.shape[1], index=0), samples, 0)
    assert isinstance(item, Window)
    return item
