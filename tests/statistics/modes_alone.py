"""Modes alone: how often an intact frame is announced as changed, and from which loss a changed one is.

    .venv/bin/python -m tests.statistics.modes_alone SEEDS [HOURS] [CALIBRATION_S]

Each seed calibrates with ambient motion (by default 2400 s, six windows of 400 s), then watches the intact frame for some hours,
and then the frame with a story of 10, 5 and 3 % less stiffness for half an hour each.  The modes and their number are chosen by
calibration; nothing of the model that simulates is told to the monitor.  Windows follow every 50 s.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

import numpy as np

from drivers.base import ACCELERATION
from monitor.config import Configuration
from monitor.core import Level, WindowResult
from monitor.damage import ModalBaseline, learn_modal_baseline
from monitor.model import simulate
from monitor.pipeline import Pipeline
from monitor.runs import cut_into_blocks
from monitor.runs.baselines import modal_origin
from monitor.runs.calibrate import covariate_units, with_common_modes
from monitor.runs.modal_calibration import common_modes
from tests.statistics.estimates import configuration

WINDOW_S, HOP_S, RATE_HZ, BURN_IN_S, T0_NS = 400.0, 50.0, 128.0, 5.0, 1_800_000_000_000_000_000
FRAME = configuration(WINDOW_S)
"""The frame that is simulated."""
SITE = Configuration.model_validate(
    {
        "structure": {"kind": "modal"},
        "sensors": [{"channel": name} for name in FRAME.channels],
        "processing": {"window_s": WINDOW_S, "hop_s": HOP_S},
    }
)
"""What the monitor is told."""


@dataclass
class Watched:
    """Windows of a run of the monitor."""

    windows: list[WindowResult]

    def announced(self, least: Level = Level.ADVISORY) -> int:
        """Count the episodes of this level and above."""
        high = [w.alarm.level.rank >= least.rank for w in self.windows]
        return sum(now and not before for before, now in zip([False, *high], high, strict=False))


def watch(pipeline: Pipeline, seconds: float, seed: int, loss: tuple[float, ...] = (), begin_s: float = 0.0) -> Watched:
    """Push ambient motion of the frame, with losses of its stories, through a pipeline."""
    model = FRAME.model()
    if loss:
        model = model.with_stiffness(model.structure.stiffness_n_per_m * (1.0 - np.array(loss)))
    motion = simulate(model, duration_s=seconds + BURN_IN_S, rate_hz=RATE_HZ, noise=0.1, seed=seed)
    floors, first = motion.floors[round(BURN_IN_S * RATE_HZ) :], round(begin_s * RATE_HZ)
    blocks = cut_into_blocks(ACCELERATION, floors, SITE.channels, RATE_HZ, T0_NS, 10_000, first=first)
    return Watched([r for block in blocks for r in pipeline.push(block) if isinstance(r, WindowResult)])


def calibrated(seconds: float, seed: int) -> ModalBaseline:
    """Learn the modes from ambient motion of the intact frame, as `calibrate` does."""
    first = Pipeline(SITE)
    watch(first, seconds, seed)
    reference = common_modes(first.state.track, SITE.selection.max_modes)
    assert reference is not None
    good = [w for w in watch(Pipeline(SITE, reference=reference), seconds, seed).windows if w.skipped is None]
    kept = with_common_modes(good, SITE.selection.required_modes)
    return learn_modal_baseline(
        SITE.channels,
        modal_origin(SITE),
        [w.modes for w in kept if w.modes is not None],
        np.array([w.rms_m_s2 for w in kept]),
        (),
        (T0_NS, T0_NS + round(seconds * 1e9)),
        [w.covariates for w in kept],
        covariate_units(SITE),
        SITE.compensation,
        motion=[w.motion for w in kept if w.motion is not None],
    )


def main(seeds: int, hours: float, calibration_s: float) -> None:
    """Print one line a seed, and the totals."""
    false, watched_h, found = 0, 0.0, dict.fromkeys((0.10, 0.05, 0.03), 0)
    for seed in range(seeds):
        baseline = calibrated(calibration_s, 10_000 + seed)
        healthy = watch(Pipeline(SITE, baseline), 3600.0 * hours, 20_000 + seed)
        n, skipped = healthy.announced(), sum(w.skipped is not None for w in healthy.windows)
        false, watched_h = false + n, watched_h + hours
        line = f"seed {seed}: {baseline.frequencies_hz.size} modes, {n} false, {len(healthy.windows)} windows, {skipped} skipped"
        for size in found:
            loss = tuple(size if j == seed % 3 else 0.0 for j in range(3))
            damaged = watch(Pipeline(SITE, baseline), 1800.0, 30_000 + seed, loss)
            is_found = damaged.announced(Level.WARNING) > 0
            found[size] += is_found
            line += f"; {100 * size:.0f} % of story {seed % 3 + 1}: {'announced' if is_found else 'not'}"
        print(line, flush=True)
        for w in healthy.windows:
            if w.alarm.level is not Level.NORMAL:
                print(f"   {w.t_end_ns}: {w.alarm.level}: {w.alarm.reason}", flush=True)
    shares = ", ".join(f"{100 * size:.0f} %: {n} of {seeds}" for size, n in found.items())
    print(f"{false} false announcements in {watched_h:.0f} h; announced within half an hour: {shares}")


if __name__ == "__main__":
    arguments = [float(a) for a in sys.argv[1:]] + [None, None, None][len(sys.argv) - 1 :]
    main(int(arguments[0] or 10), arguments[1] or 4.0, arguments[2] or 2400.0)
