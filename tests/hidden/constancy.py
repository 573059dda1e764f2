"""``python -m tests.hidden.constancy N [--world W] [--seed S]``: has a cause the same size in disjoint ranges of frequency?

A line for every cause of every trial: its size over its standard deviation by the model alone, and by the mixed equations with
ranges of frequency of equal efficient information and with classes of level; see docs/decisions/0100.

References
----------
C. R. Rao, Proc. Cambridge Phil. Soc. 44 (1948) 50 (score test); C. R. Henderson, Biometrics 31 (1975) 423 (mixed equations);
A. Gelman, Bayesian Analysis 1 (2006) 515 (half-Cauchy prior of a standard deviation).
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from monitor.diagnosis import Diagnosis
from monitor.inference import gather
from monitor.runs import diagnose
from tests.hidden import judge, trial, worlds

RANGES = 6
_SCALE = 3.0
"""Of the half-Cauchy prior of the deviation between ranges, over the standard deviation by the model."""
_NOTHING = 1e-6
"""Share of the largest eigenvalue below which a direction has no information."""


@dataclass(frozen=True, eq=False)
class Linear:
    """A fit near its end: whitened slopes and residual, and the covariance of all coordinates."""

    slopes: np.ndarray
    """Shape (rows, p)."""
    residual: np.ndarray
    covariance: np.ndarray
    """Inverse of the slopes' information and the prior's precision, shape (p, p)."""
    bins: np.ndarray
    """Index of every row's frequency."""
    classes: np.ndarray
    """Index of every row's class of level; of segments, after the classes, where an input was measured."""

    def efficient(self, j: int) -> np.ndarray:
        """Information of every row about coordinate j with all else refitted."""
        return np.asarray((self.slopes @ (self.covariance[:, j] / self.covariance[j, j])) ** 2)

    def ranges(self, j: int, n: int = RANGES) -> np.ndarray:
        """Number every row by one of n ranges of frequency that hold equal efficient information."""
        share = np.cumsum(np.bincount(self.bins, self.efficient(j)))
        middle = share - 0.5 * np.diff(share, prepend=0.0)
        numbers = np.minimum(n * middle / share[-1], n - 1).astype(int)
        return np.asarray(np.unique(numbers, return_inverse=True)[1])[self.bins]


def linear(found: Diagnosis) -> Linear:
    """Linearize the end of a diagnosis."""
    posterior, fit = found.posterior, found.final_fit
    prediction = posterior.predict(fit.x, fit.effects)
    slopes, residual, of_means = posterior.slope_rows(fit.x, fit.effects, prediction)
    k, n, c = prediction.spectra.shape[:3]
    bins, classes = np.repeat(np.tile(np.arange(n), k), c * c), np.repeat(np.arange(k), n * c * c)
    if of_means.size:  # real and imaginary parts of every segment
        s = len(posterior.observed.segments.values)
        bins = np.r_[bins, np.tile(np.repeat(np.arange(n), c), 2 * s)]
        classes = np.r_[classes, k + np.tile(np.repeat(np.arange(s), n * c), 2)]
    return Linear(slopes, np.r_[residual, of_means], fit.covariance, bins, classes)


@dataclass(frozen=True)
class Constancy:
    """Whether the size of a coordinate differs between blocks."""

    change: float
    """From the size by the model alone to the common size."""
    std: float
    """Of the common size."""
    statistic: float
    """Chi-squared with `rank` where no block differs."""
    rank: int


def constancy(fit: Linear, j: int, block: np.ndarray) -> Constancy:
    """Fit a deviation of coordinate j in every block, normal with a standard deviation that is averaged over."""
    parts = [fit.slopes[block == b] for b in range(block.max() + 1)]
    own = np.array([part[:, j] @ part for part in parts])
    score = np.array([fit.slopes[block == b, j] @ fit.residual[block == b] for b in range(len(parts))])
    spread = np.diag([part[:, j] @ part[:, j] for part in parts]) - own @ fit.covariance @ own.T
    values, vectors = np.linalg.eigh(spread)
    z, along = vectors.T @ score, vectors.T @ own @ fit.covariance[:, j]
    variance = fit.covariance[j, j]
    taus = np.sqrt(variance) * np.geomspace(1e-3, 1e4, 281)
    precision = np.maximum(values, 0.0) + taus[:, None] ** -2
    changes, variances = -(along * z / precision).sum(axis=1), variance + (along**2 / precision).sum(axis=1)
    known = values > _NOTHING * np.diag(spread).max()  # a deviation of all blocks alike is none
    values, z = values[known], z[known]
    total = values + (taus[:, None] * values) ** 2
    log_weight = -0.5 * (np.log(total) + z**2 / total).sum(axis=1) + np.log(taus)  # steps of the logarithm
    log_weight -= np.log1p(taus**2 / (_SCALE**2 * variance))
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    change = float(weight @ changes)
    std = float(np.sqrt(weight @ (variances + (changes - change) ** 2)))
    return Constancy(change, std, float((z**2 / values).sum()), int(known.sum()))


def of_trial(seed: int, name: str) -> list[str]:
    """Diagnose a trial; return a line for every cause that was fitted at last."""
    world = worlds.of(name)
    structure = world.structure(seed // trial.TRIALS_A_TRUTH, name)
    plan = world.draw(structure, name, seed)
    baseline = trial.calibrated(structure, seed // trial.TRIALS_A_TRUTH)[0]
    segments = gather(plan.recording(), baseline.config.front_end())
    found, _ = diagnose.diagnose_segments(segments, baseline.reference, baseline.config)
    stated = {(c.effect.name, c.effect.location) for c in found.causes}
    sealed = {"name": name, "hidden": [h.__dict__ for h in plan.hidden]}
    true = {judge.key(h) for h in sealed["hidden"]}.union(*(judge.tie(sealed, h) for h in sealed["hidden"]))
    fit, lines = linear(found), []
    for i, effect in enumerate(found.final_fit.effects):
        first, key = found.final_fit.coordinates_of(i).start, (effect.name, effect.location)
        for j, p in enumerate(effect.parameters, start=first):
            if p.absent is None:
                continue
            size = found.final_fit.x[j] - (p.coordinate(p.absent) if np.isfinite(p.absent) else 0.0)
            columns = [f"{abs(size) / np.sqrt(fit.covariance[j, j]):8.1f}"]
            for block in (fit.ranges(j), fit.classes):
                at = constancy(fit, j, block)
                columns.append(f"{abs(size + at.change) / at.std:8.1f} (Q {at.statistic:.0f} for {at.rank})")
            what = "true" if key in true and plan.kind != "outside" else "in kind" if key in true else "false"
            lines.append(
                f"{seed} {name}: {effect.name} {effect.location}, {what}, {'stated' if key in stated else 'not stated'}:"
                f" alone {columns[0]}, ranges {columns[1]}, classes {columns[2]}"
            )
    return lines


def main() -> None:
    """Print the lines of a world's trials."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.hidden.constancy", description="Are causes alike everywhere?"
    )
    parser.add_argument("n", type=int)
    parser.add_argument("--world", choices=worlds.WORLDS, default="outside")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    with threadpool_limits(limits=1):
        for seed, name in worlds.rounds(options.n, options.seed, worlds.WORLDS[options.world].NAMES):
            print("\n".join(of_trial(seed, name)), flush=True)


if __name__ == "__main__":
    main()
