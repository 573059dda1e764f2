"""Modes alone on records that differ: how many healthy ones are announced, and how many changed ones are.

    .venv/bin/python -m tests.statistics.scattered_records SEEDS [PROPELLER.npz]

Each seed learns from records of one simulated structure and judges others: as many healthy ones in one run, and in another as
many in which one mode's frequency is lower.  With a file of `healthy` and `damaged` runs, shape (runs, axes, samples), and their
`rate_hz`, three of the healthy runs are learned from at a time, and the other two and the damaged ones judged.
"""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np

from monitor.core import GAP, Array, BadInputError, Level
from monitor.pipeline import Pipeline
from tests.support.campaign import words
from tests.support.scattered import Scattered, calibrated, site, watched

SHAPES = ((1.0, 0.8, 0.45), (-0.8, 0.45, 1.0), (0.45, -1.0, 0.8))
CASES = {
    "15 records of 8 s, one channel, frequencies differ by 6 %": (
        Scattered((120.0, 310.0), damping=0.02, rate_hz=1000.0, scatter=0.12, damping_scatter=0.3, quiet=0.1),
        (15, 8.0, 8.0, 2.0),
        (0.0, -0.25),
    ),
    "8 records of 200 s, three channels, differ by 0.5 %": (
        Scattered((2.0, 5.5, 9.0), SHAPES, damping=0.012, rate_hz=50.0, scatter=0.01, damping_scatter=0.2),
        (8, 200.0, 100.0, 50.0),
        (0.0, -0.05, 0.0),
    ),
    "the same, do not differ": (
        Scattered((2.0, 5.5, 9.0), SHAPES, damping=0.012, rate_hz=50.0),
        (8, 200.0, 100.0, 50.0),
        (0.0, -0.02, 0.0),
    ),
    "10 records of 120 s, one channel, modes often missing": (
        Scattered((2.0, 5.5, 9.0), damping=0.012, rate_hz=50.0, scatter=0.01, quiet=0.15),
        (10, 120.0, 60.0, 30.0),
        (0.0, -0.06, 0.0),
    ),
}
"""Structure; number and length of the records, length of the windows and time between them; change of each frequency."""


def told(pipeline: Pipeline, records: list[Array], rate_hz: float) -> str:
    """Judge records one after the other, and say in how many of them, and of their windows, something was announced."""
    rows = watched(pipeline, records, rate_hz)
    rows = [[w for w in row if w.skipped is None or not w.skipped.reason.startswith(GAP)] for row in rows]
    high = [[w.alarm.level is not Level.NORMAL for w in row] for row in rows]
    skipped = sum(w.skipped is not None for row in rows for w in row)
    n = sum(map(len, rows))
    return f"{sum(map(any, high))} of {len(rows)} records, {sum(map(sum, high))} of {n} windows, {skipped} skipped"


def propeller(path: Path) -> None:
    """Print a line for each choice of runs, axes and windows."""
    with np.load(path) as file:
        rate_hz = float(file["rate_hz"])
        healthy, damaged = ([run.T.astype(float) for run in file[name]] for name in ("healthy", "damaged"))
    for window_s, axes in ((4.0, (0, 1, 2)), (2.0, (0, 1, 2)), (4.0, (0,))):
        config = site(len(axes), window_s, 1.0, rate_hz, refinement={"segment_s": 0.5}, tracking={"confirm_hits": 2})
        for learned in combinations(range(5), 3):
            runs = [run[:, list(axes)] for run in healthy]
            baseline = calibrated([runs[k] for k in learned], config, rate_hz)
            others = [runs[k] for k in range(5) if k not in learned], [run[:, list(axes)] for run in damaged]
            says = [told(Pipeline(config, baseline), group, rate_hz) for group in others]
            what = f"propeller, runs {learned}, axes {axes}, {window_s:g} s"
            print(f"{what}: healthy {says[0]}; damaged {says[1]}", flush=True)


def main() -> None:
    """Print one line a case and seed."""
    seeds, path = words(2, "")
    for name, (structure, (n, seconds, window_s, hop_s), change) in CASES.items():
        n_channels = len(structure.shapes[0]) if structure.shapes else 1
        config = site(n_channels, window_s, hop_s, structure.rate_hz)
        for seed in range(seeds):
            try:
                baseline = calibrated(structure.records(n, seconds, seed), config, structure.rate_hz)
            except BadInputError as error:
                print(f"{name}, seed {seed}: {error}", flush=True)
                continue
            says = [
                told(Pipeline(config, baseline), group, structure.rate_hz)
                for group in (
                    structure.records(n, seconds, 500 + seed),
                    structure.records(n, seconds, 900 + seed, change),
                )
            ]
            print(f"{name}, seed {seed}: healthy {says[0]}; changed {says[1]}", flush=True)
    if path:
        propeller(Path(path))


if __name__ == "__main__":
    main()
