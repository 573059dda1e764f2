"""Cost of the covariates' law in a hop: the same windows of 400 s every 10 s, with a baseline that has a law and without, and
with one that knows besides what the stories do together.

Run: ``python -m tests.benchmarks.covariates [HOURS]``.  CPU time of the process, one thread of linear algebra; the level wanders,
so that the law's uncertainty changes as it does outdoors.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from drivers.base import ACCELERATION
from monitor.core.results import WindowResult
from monitor.damage.common_change import CommonChange
from monitor.model.simulation import simulate
from monitor.pipeline import Pipeline
from monitor.runs.synthetic_recording import cut_into_blocks
from tests.statistics import storm
from tests.statistics.estimates import configuration

RATE_HZ = 100.0


def main() -> None:
    """Print the median CPU time of a hop of each kind."""
    hours = float(sys.argv[1]) if len(sys.argv) > 1 else 1.0
    config = configuration(10.0)
    baseline = storm.calibrated([1.0] * 9, storm.SHAPES["issue"], 1)
    seconds = round(3600 * hours)
    floors = simulate(
        config.model(), duration_s=float(seconds), rate_hz=RATE_HZ, noise=0.1, level_spread=0.2, seed=2
    ).floors
    blocks = list(cut_into_blocks(ACCELERATION, floors, config.channels, RATE_HZ, 0, round(10 * RATE_HZ)))
    law = baseline.law
    assert law is not None
    white = np.linalg.solve(law.mixing, [0.01, 0.015, 0.008])
    common = CommonChange(1440.0 * (np.eye(3) + np.outer(white, white)), 1440)
    kinds = {"with the law": law, "with common changes": replace(law, common=common), "without": None}
    pipelines = {name: Pipeline(config, replace(baseline, law=kind)) for name, kind in kinds.items()}
    spent: dict[str, list[float]] = {name: [] for name in pipelines}
    for block in blocks:
        for name, pipeline in pipelines.items():
            begun = time.process_time()
            results = [r for r in pipeline.push(block) if isinstance(r, WindowResult) and r.damage is not None]
            if results:
                spent[name].append(time.process_time() - begun)
    for name, times in spent.items():
        ms = 1e3 * np.array(times[10:])
        print(f"{name}: {ms.size} hops, median {np.median(ms):.2f} ms, mean {ms.mean():.2f} ms")


if __name__ == "__main__":
    with threadpool_limits(limits=1):
        main()
