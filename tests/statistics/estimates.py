"""Trials of the whole estimation on simulated records: errors over their bounds, and what the intervals hold.

    .venv/bin/python -m tests.statistics.estimates [BASELINES] [WINDOWS] [LEVEL_SPREAD] [SEED] [PROCESSES] [PLOTS_DIRECTORY]

Records of the paper's frame: ambient, 10 % sensor noise at 1000 Hz before the filter; baselines of 1200 s, windows of 400 s
that do not overlap.  The bounds are Cramer-Rao bounds of a 400 s record: of frequencies and damping for a general modal
model, of stiffness with masses known; the damage index adds the baseline's share.  `subspace` is the estimate before
its refinement; stiffness is updated with the true masses, without a baseline.
"""

from __future__ import annotations

import multiprocessing
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from drivers.base import ACCELERATION
from monitor.config import Configuration
from monitor.core import ModalEstimate, StiffnessEstimate, WindowResult
from monitor.damage import Baseline, damage_index, learn_baseline
from monitor.identification import RefinementSettings
from monitor.model import simulate
from monitor.pipeline import Pipeline
from monitor.runs import cut_into_blocks
from monitor.runs.paper_tables import MASSES_KG

STIFFNESS = np.array([2909.4511, 1514.8507, 1897.6986])
BASELINE_S, WINDOW_S = 1200.0, 400.0
FREQUENCY_BOUND = np.array([0.88e-3, 0.50e-3, 0.47e-3])
DAMPING_BOUND = np.array([0.088, 0.050, 0.039])
STIFFNESS_BOUND = np.array([0.95e-3, 1.26e-3, 1.34e-3])
INDEX_BOUND = STIFFNESS_BOUND * np.sqrt(1.0 + WINDOW_S / BASELINE_S)


@dataclass(frozen=True)
class Estimates:
    """One quantity over all windows; relative for frequency, damping and stiffness."""

    error: np.ndarray
    """Shape (n_windows, 3): estimate less truth."""
    std: np.ndarray
    """Same shape: the stated standard deviation."""
    bound: np.ndarray
    """Shape (3,): the least standard deviation there can be."""

    @property
    def z(self) -> np.ndarray:
        """Error over the stated standard deviation, shape (n_windows, 3)."""
        return np.asarray(self.error / self.std)

    @property
    def efficiency(self) -> np.ndarray:
        """RMSE over bound, shape (3,)."""
        return np.asarray(np.sqrt((self.error**2).mean(axis=0)) / self.bound)

    @property
    def coverage(self) -> np.ndarray:
        """Share of the intervals of +-1.96 standard deviations that hold the truth, shape (3,)."""
        return np.asarray((np.abs(self.z) < 1.96).mean(axis=0))

    @property
    def kurtosis(self) -> np.ndarray:
        """Of z, shape (3,); 3 for a normal distribution."""
        centred = self.z - self.z.mean(axis=0)
        return np.asarray((centred**4).mean(axis=0) / (centred**2).mean(axis=0) ** 2)


@dataclass(frozen=True)
class Trials:
    """What came of all windows."""

    estimates: dict[str, Estimates]
    """By name: frequency, damping, stiffness, ddi; with `subspace` before it, of the estimate before its refinement."""
    windows: int
    skipped: int
    """Windows without exactly the three modes and a damage index."""
    refined: int

    def report(self) -> str:
        """A line for every quantity."""
        lines = [
            f"{self.windows} windows, {self.skipped} skipped, {self.refined} refined; modes or stories 1, 2, 3",
            f"{'':<20} RMSE / bound       95 % hold, %       stated / actual    kurtosis of z     |z| > 3, > 4",
        ]
        for name, e in self.estimates.items():
            stated = np.sqrt((e.std**2).mean(axis=0) / (e.error**2).mean(axis=0))
            beyond = " ".join(f"{100.0 * (np.abs(e.z) > limit).mean():.3f} %" for limit in (3.0, 4.0))
            figures = [
                " ".join(f"{x:{form}}" for x in values)
                for values, form in (
                    (e.efficiency, "5.3f"),
                    (100.0 * e.coverage, "5.2f"),
                    (stated, "5.3f"),
                    (e.kurtosis, "4.2f"),
                )
            ]
            lines.append(f"{name:<20} " + "  ".join([*figures, beyond]))
        return "\n".join(lines)


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


def windows(duration_s: float, seed: list[int], spread: float, pipelines: list[Pipeline]) -> list[list[WindowResult]]:
    """Windows of one simulated record of the intact frame, as each of the pipelines sees them."""
    config = pipelines[0].config
    motion = simulate(
        config.model(),
        duration_s=duration_s,
        rate_hz=1000.0,
        noise=0.1,
        level_spread=spread,
        seed=int(np.random.SeedSequence(seed).generate_state(1)[0]),
    )
    blocks = list(cut_into_blocks(ACCELERATION, motion.floors, config.channels, 1000.0, 0, 10_000))
    return [[r for b in blocks for r in p.push(b) if isinstance(r, WindowResult)] for p in pipelines]


def calibrated(number: int, spread: float, seed: int) -> Baseline:
    """A baseline from a record of its own."""
    config = configuration(10.0)
    (calm,) = windows(BASELINE_S, [seed, number, 0], spread, [Pipeline(config)])
    return learn_baseline(
        config.instrumented(),
        [r.modes for r in calm if r.modes is not None],
        np.ones(1),
        (),
        updating=config.updating,
        compensation=config.compensation,
    )[0]


def one_baseline(task: tuple[int, int, float, int]) -> tuple[list[WindowResult], list[WindowResult]]:
    """Windows judged against a baseline of their own, and the same windows by subspace identification alone."""
    number, n_windows, spread, seed = task
    with threadpool_limits(limits=1):
        config = configuration(WINDOW_S)
        bare = config.model_copy(update={"refinement": RefinementSettings(enabled=False)})
        pipelines = [Pipeline(config, calibrated(number, spread, seed)), Pipeline(bare)]
        judged, subspace = windows(WINDOW_S * n_windows, [seed, number, 1], spread, pipelines)
        return judged, subspace


def trials(n_baselines: int, n_windows: int, spread: float, seed: int, processes: int = 2) -> Trials:
    """Run them all."""
    tasks = [(i, n_windows, spread, seed) for i in range(n_baselines)]
    if processes == 1:
        parts = [one_baseline(task) for task in tasks]
    else:
        with multiprocessing.get_context("spawn").Pool(processes) as pool:
            parts = list(pool.imap_unordered(one_baseline, tasks))
    judged, subspace = ([r for part in parts for r in part[side]] for side in (0, 1))
    good = [r for r in judged if r.modes is not None and r.damage is not None]
    config = configuration(WINDOW_S)
    modes = [r.modes for r in good if r.modes is not None]
    known = [damage_index.step(m, config.model(), None, np.eye(3), config.updating)[0] for m in modes]
    index = Estimates(
        np.array([r.damage.ddi for r in good if r.damage]),
        np.array([r.damage.ddi_std for r in good if r.damage]),
        INDEX_BOUND,
    )
    before = [r for r in subspace if r.modes is not None and r.stiffness is not None]
    alone = _compared([r.modes for r in before if r.modes], [r.stiffness for r in before if r.stiffness])
    return Trials(
        _compared(modes, known) | {"ddi": index} | {f"subspace {name}": e for name, e in alone.items()},
        len(judged),
        len(judged) - len(good),
        sum(m.refined for m in modes),
    )


def _compared(modes: list[ModalEstimate], stiffness: list[StiffnessEstimate]) -> dict[str, Estimates]:
    """Estimates against the truth."""
    model = configuration(WINDOW_S).model()
    truth = model.modes()
    f = truth.frequencies_hz
    damping = np.diag(truth.shapes.T @ model.damping_matrix() @ truth.shapes) / (2.0 * np.sqrt(truth.eigenvalues))
    return {
        "frequency": Estimates(
            np.array([m.frequencies_hz / f - 1.0 for m in modes]),
            np.array([m.frequencies_std_hz / f for m in modes]),
            FREQUENCY_BOUND,
        ),
        "damping": Estimates(
            np.array([m.damping_ratio / damping - 1.0 for m in modes]),
            np.array([m.damping_std / damping for m in modes]),
            DAMPING_BOUND,
        ),
        "stiffness": Estimates(
            np.array([k.stiffness_n_per_m / STIFFNESS - 1.0 for k in stiffness]),
            np.array([np.sqrt(np.diag(k.covariance)) / STIFFNESS for k in stiffness]),
            STIFFNESS_BOUND,
        ),
    }


def main(arguments: list[str]) -> None:
    """Print the table and draw it where a directory is named."""
    values = arguments + ["100", "20", "0", "20261121", "2"][len(arguments) :]
    spread = float(values[2])
    found = trials(int(values[0]), int(values[1]), spread, seed=int(values[3]), processes=int(values[4]))
    print(found.report())
    if len(values) > 5:
        from tests.statistics import plots

        plots.write(found.estimates, spread, Path(values[5]))


if __name__ == "__main__":
    main(sys.argv[1:])
