"""Cost of the covariates' law in a hop: the same windows of 400 s every 10 s, with a baseline that has a law and without, and
with one that knows besides what the stories do together.

Run: ``python -m tests.benchmarks.covariates [HOURS]``.  CPU time of the process, one thread of linear algebra; the level wanders,
so that the law's uncertainty changes as it does outdoors.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from drivers.base import ACCELERATION
from monitor.core import WindowResult
from monitor.pipeline import Pipeline
from monitor.runs import cut_into_blocks
from tests.benchmarks.hops import with_common_changes
from tests.statistics import storm
from tests.statistics.estimates import configuration
from tests.support.campaign import words
from tests.support.simulated import ambient

RATE_HZ = 100.0
HOUR_HOPS = 360
"""Hops of the hour in which the smallest detectable loss grows with the data: its simulations are then made anew."""


def main() -> None:
    """Print the CPU time of a hop of each kind, and what is added to the same hop without a law, in the first hour and after."""
    (hours,) = words(1.0)
    config = configuration(10.0)
    baseline = storm.calibrated([1.0] * 9, storm.SHAPES["issue"], 1)
    seconds = round(3600 * hours)
    floors = ambient(config.model(), float(seconds), RATE_HZ, 2, level_spread=0.2)
    blocks = list(cut_into_blocks(ACCELERATION, floors, config.channels, RATE_HZ, 0, round(10 * RATE_HZ)))
    law = baseline.law
    assert law is not None
    kinds = {"with the law": law, "with common changes": with_common_changes(law), "without": None}
    pipelines = {name: Pipeline(config, replace(baseline, law=kind)) for name, kind in kinds.items()}
    spent: dict[str, list[float]] = {name: [] for name in pipelines}
    order = list(pipelines)
    for block in blocks:
        order.append(order.pop(0))  # none is always the one whose data others drove out of the caches
        for name in order:
            pipeline = pipelines[name]
            begun = time.process_time()
            results = [r for r in pipeline.push(block) if isinstance(r, WindowResult) and r.damage is not None]
            if results:
                spent[name].append(time.process_time() - begun)
    ms = {name: 1e3 * np.array(times[10:]) for name, times in spent.items()}
    first = np.arange(len(ms["without"])) < HOUR_HOPS
    for stretch, hops in {"first hour": first, "after": ~first}.items():
        if not hops.any():
            continue
        none = ms["without"][hops]
        for name, times in ms.items():
            added, more = times[hops] - none, in_words(times[hops], none)
            print(f"{stretch}, {name}: {more}; added: {in_words(added, none)}")


def in_words(times: np.ndarray, base: np.ndarray) -> str:
    """Median, mean and 95th percentile, each with its share of the hops without a law."""
    figures = {"median": np.median, "mean": np.mean, "95 %": lambda x: np.quantile(x, 0.95)}
    said = (f"{k} {f(times):.2f} ms ({100 * f(times) / f(base):.0f} %)" for k, f in figures.items())
    return f"{times.size} hops, " + ", ".join(said)


if __name__ == "__main__":
    with threadpool_limits(limits=1):
        main()
