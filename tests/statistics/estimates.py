"""Trials of the whole estimation on simulated records: errors over their bounds, and what the intervals hold.

    .venv/bin/python tests/statistics/estimates.py [BASELINES] [WINDOWS] [LEVEL_SPREAD]

Records of the paper's frame: ambient, 10 % sensor noise at 1000 Hz before the filter; baselines of 1200 s, windows of 400 s
that do not overlap.  The bounds are Cramer-Rao bounds of a 400 s record: of frequencies and damping for a general modal
model, of stiffness with masses known; the damage index adds the baseline's share.
"""

from __future__ import annotations

import multiprocessing
import sys
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from drivers.base import ACCELERATION
from monitor.baseline import Baseline, learn
from monitor.config import Configuration
from monitor.pipeline import Pipeline
from monitor.record import blocks_of
from monitor.reproduce import MASSES_KG
from monitor.results import WindowResult
from monitor.simulate import simulate

STIFFNESS = np.array([2909.4511, 1514.8507, 1897.6986])
BASELINE_S, WINDOW_S = 1200.0, 400.0
FREQUENCY_BOUND = np.array([0.88e-3, 0.50e-3, 0.47e-3])
DAMPING_BOUND = np.array([0.088, 0.050, 0.039])
STIFFNESS_BOUND = np.array([0.95e-3, 1.26e-3, 1.34e-3])


@dataclass(frozen=True)
class Errors:
    """Errors and stated standard deviations, shape (n_windows, 3) each; relative for frequency and damping."""

    frequency: np.ndarray
    frequency_std: np.ndarray
    damping: np.ndarray
    damping_std: np.ndarray
    ddi: np.ndarray
    ddi_std: np.ndarray
    skipped: int

    def report(self) -> str:
        """RMSE over bound, and the share of 95 % intervals that hold the truth."""
        index_bound = STIFFNESS_BOUND * np.sqrt(1.0 + WINDOW_S / BASELINE_S)
        lines = [f"{len(self.ddi)} windows, {self.skipped} skipped; modes or stories 1, 2, 3"]
        for name, bound in (("frequency", FREQUENCY_BOUND), ("damping", DAMPING_BOUND), ("ddi", index_bound)):
            error, std = getattr(self, name), getattr(self, f"{name}_std")
            rmse, held = np.sqrt((error**2).mean(axis=0)) / bound, self.coverage(name)
            stated = np.sqrt((std**2).mean(axis=0) / (error**2).mean(axis=0))
            lines.append(
                f"{name:<10} RMSE / bound {np.round(rmse, 3)}  95 % intervals hold {np.round(held, 3)}  "
                f"stated / actual deviation {np.round(stated, 3)}"
            )
        return "\n".join(lines)

    def coverage(self, name: str) -> np.ndarray:
        """Share of the intervals of +-1.96 standard deviations that hold the truth, shape (3,)."""
        return np.asarray((np.abs(getattr(self, name)) < 1.96 * getattr(self, f"{name}_std")).mean(axis=0))


def configuration(hop_s: float) -> Configuration:
    """The paper's frame with the true drawing."""
    return Configuration.model_validate(
        {
            "structure": {
                "kind": "shear_frame",
                "masses_kg": MASSES_KG.tolist(),
                "stiffness_n_per_m": STIFFNESS.tolist(),
            },
            "sensors": [{"channel": f"a{i}", "floor": i} for i in (1, 2, 3)],
            "processing": {"hop_s": hop_s},
        }
    )


def windows(
    duration_s: float, seed: list[int], spread: float, hop_s: float, healthy: Baseline | None
) -> list[WindowResult]:
    """Windows of one simulated record of the intact frame."""
    config = configuration(hop_s)
    motion = simulate(
        config.model(),
        duration_s=duration_s,
        rate_hz=1000.0,
        noise=0.1,
        level_spread=spread,
        seed=int(np.random.SeedSequence(seed).generate_state(1)[0]),
    )
    pipeline = Pipeline(config, healthy)
    results = [
        r for b in blocks_of(ACCELERATION, motion.floors, config.channels, 1000.0, 0, 10_000) for r in pipeline.push(b)
    ]
    return [r for r in results if isinstance(r, WindowResult)]


def one_baseline(task: tuple[int, int, float, int]) -> list[WindowResult]:
    """A baseline and its windows."""
    number, n_windows, spread, seed = task
    with threadpool_limits(limits=1):
        calm = windows(BASELINE_S, [seed, number, 0], spread, 10.0, None)
        healthy, _ = learn(configuration(10.0), [r.modes for r in calm if r.modes is not None], np.ones(1), ())
        return windows(WINDOW_S * n_windows, [seed, number, 1], spread, WINDOW_S, healthy)


def trials(n_baselines: int, n_windows: int, spread: float, seed: int, processes: int = 2) -> Errors:
    """Run them all."""
    tasks = [(i, n_windows, spread, seed) for i in range(n_baselines)]
    if processes == 1:
        results = [r for task in tasks for r in one_baseline(task)]
    else:
        with multiprocessing.get_context("spawn").Pool(processes) as pool:
            results = [r for part in pool.imap_unordered(one_baseline, tasks) for r in part]
    modes = configuration(10.0).model().modes()
    c = configuration(10.0).model().damping_matrix()
    damping = np.diag(modes.shapes.T @ c @ modes.shapes) / (2.0 * np.sqrt(modes.eigenvalues))
    good = [r for r in results if r.modes is not None and r.damage is not None]
    f, z = modes.frequencies_hz, damping
    return Errors(
        frequency=np.array([r.modes.frequencies_hz / f - 1.0 for r in good if r.modes]),
        frequency_std=np.array([r.modes.frequencies_std_hz / f for r in good if r.modes]),
        damping=np.array([r.modes.damping_ratio / z - 1.0 for r in good if r.modes]),
        damping_std=np.array([r.modes.damping_std / z for r in good if r.modes]),
        ddi=np.array([r.damage.ddi for r in good if r.damage]),
        ddi_std=np.array([r.damage.ddi_std for r in good if r.damage]),
        skipped=len(results) - len(good),
    )


if __name__ == "__main__":
    arguments = [float(a) for a in sys.argv[1:]] + [100.0, 20.0, 0.0][len(sys.argv) - 1 :]
    print(trials(int(arguments[0]), int(arguments[1]), arguments[2], seed=20261121).report())
