"""Trials of the whole estimation on simulated records: errors over their bounds, and what the intervals hold.

    .venv/bin/python -m tests.statistics.estimates [BASELINES] [WINDOWS] [LEVEL_SPREAD] [SEED] [PROCESSES] [PLOTS_DIRECTORY]

Records of the paper's frame: ambient, 10 % sensor noise at 1000 Hz before the filter; baselines of 1200 s, windows of 400 s
that do not overlap.  The bounds are Cramer-Rao bounds of a 400 s record: of frequencies and damping for a general modal
model, of stiffness with masses known; the damage index adds the baseline's share.  `subspace` is the estimate before
its refinement; stiffness is updated with the true masses, without a baseline.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import erfc, sqrt
from pathlib import Path

import numpy as np

from monitor.config import Configuration
from monitor.core import ModalEstimate, StiffnessEstimate, WindowResult
from monitor.damage import damage_index
from monitor.identification import RefinementSettings
from monitor.pipeline import Pipeline
from monitor.runs import paper_tables
from tests.statistics import figures
from tests.support.campaign import each, words
from tests.support.frames import shear_frame
from tests.support.simulated import ambient, learned, seeded, windows_of

MASSES = paper_tables.MASSES_KG
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


def configuration(hop_s: float, **processing: float) -> Configuration:
    """The paper's frame with the true drawing."""
    return shear_frame(MASSES, STIFFNESS, processing={"hop_s": hop_s, **processing})


def one_baseline(
    number: int, n_windows: int, spread: float, seed: int
) -> tuple[list[WindowResult], list[WindowResult]]:
    """Windows judged against a baseline of a record of its own, and the same windows by subspace identification alone."""
    calm, config = configuration(10.0), configuration(WINDOW_S)

    def record(seconds: float, part: int) -> np.ndarray:
        return ambient(config.model(), seconds, 1000.0, seeded(seed, number, part), level_spread=spread)

    baseline = learned(calm, windows_of(Pipeline(calm), record(BASELINE_S, 0), 1000.0))
    bare = config.model_copy(update={"refinement": RefinementSettings(enabled=False)})
    floors = record(WINDOW_S * n_windows, 1)
    return windows_of(Pipeline(config, baseline), floors, 1000.0), windows_of(Pipeline(bare), floors, 1000.0)


def trials(
    n_baselines: int, n_windows: int, spread: float, seed: int, processes: int = 2, *, keep: bool = False
) -> Trials:
    """Run them all."""
    tasks = [(i, n_windows, spread, seed) for i in range(n_baselines)]
    parts = each(one_baseline, tasks, processes, keep=keep)
    judged, subspace = ([r for part in parts for r in part[side]] for side in (0, 1))
    good = [r for r in judged if r.modes is not None and r.damage is not None]
    config = configuration(WINDOW_S)
    modes = [r.modes for r in good if r.modes is not None]
    known = [damage_index.step(m, config.model(), None, np.eye(3), config.updating)[0] for m in modes]
    read = [r.damage for r in good if r.damage is not None]
    index = Estimates(np.array([d.ddi for d in read]), np.array([d.ddi_std for d in read]), INDEX_BOUND)
    before = [r for r in subspace if r.modes is not None and r.stiffness is not None]
    alone = _compared([r.modes for r in before if r.modes], [r.stiffness for r in before if r.stiffness])
    return Trials(
        _compared(modes, known) | {"ddi": index} | {f"subspace {name}": e for name, e in alone.items()},
        len(judged),
        len(judged) - len(good),
        sum(m.refined for m in modes),
    )


def _compared(modes: list[ModalEstimate], stiffness: list[StiffnessEstimate]) -> dict[str, Estimates]:
    """Estimates against the truth, relative to it."""
    model = configuration(WINDOW_S).model()
    truth = model.modes()
    f = truth.frequencies_hz
    damping = np.diag(truth.shapes.T @ model.damping_matrix() @ truth.shapes) / (2.0 * np.sqrt(truth.eigenvalues))
    rows = {
        "frequency": ([(m.frequencies_hz, m.frequencies_std_hz) for m in modes], f, FREQUENCY_BOUND),
        "damping": ([(m.damping_ratio, m.damping_std) for m in modes], damping, DAMPING_BOUND),
        "stiffness": (
            [(k.stiffness_n_per_m, np.sqrt(np.diag(k.covariance))) for k in stiffness],
            STIFFNESS,
            STIFFNESS_BOUND,
        ),
    }
    return {
        name: Estimates(np.array([x / true - 1.0 for x, _ in row]), np.array([std / true for _, std in row]), bound)
        for name, (row, true, bound) in rows.items()
    }


def draw(estimates: dict[str, Estimates], spread: float, folder: Path) -> None:
    """Errors over their bounds, and the tails of what the intervals leave out, as ``estimates-*-PERCENT.svg``."""
    percent = round(100.0 * spread)
    names = ("frequency", "damping", "stiffness", "ddi")
    with figures.figure(folder / f"estimates-efficiency-{percent}.svg") as (axes,):
        for label, prefix, colour in (("subspace alone", "subspace ", figures.RED), ("refined", "", figures.BLUE)):
            found = [(k, e) for k, name in enumerate(names) if (e := estimates.get(prefix + name)) is not None]
            x = [k + 0.2 * place for k, _ in found for place in (-1, 0, 1)]
            axes.plot(x, np.concatenate([e.efficiency for _, e in found]), "o", color=colour, label=label)
        axes.axhline(1.0, color=figures.GREY)
        axes.set_xticks(range(4), [*names[:3], "damage index"])
        axes.set(
            ylim=(0.9, 1.7),
            title=f"RMSE over the Cramer-Rao bound, level wandering by {percent} %; modes or stories 1 to 3",
        )
    with figures.figure(folder / f"estimates-tails-{percent}.svg") as (axes,):
        t = np.linspace(0.0, 4.4, 89)
        axes.plot(t, [erfc(x / sqrt(2.0)) for x in t], color=figures.GREY, label="normal distribution")
        for name, colour in (("subspace stiffness", figures.RED), ("ddi", figures.BLUE)):
            z = np.abs(estimates[name].z).ravel()
            axes.plot(t, [(z > x).mean() or np.nan for x in t], color=colour, label=name)
        axes.set(yscale="log", ylim=(1e-5, 1.0), xlabel="error over its stated standard deviation")
        axes.set_title(f"share of errors beyond, all stories, level wandering by {percent} %")


def main() -> None:
    """Print the table and draw it where a directory is named."""
    n_baselines, n_windows, spread, seed, processes, folder = words(100, 20, 0.0, 20261121, 2, "")
    found = trials(n_baselines, n_windows, spread, seed, processes)
    print(found.report())
    if folder:
        draw(found.estimates, spread, Path(folder))


if __name__ == "__main__":
    main()
