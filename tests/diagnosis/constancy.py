"""``python -m tests.diagnosis.constancy N [--world W] [--seed S]``: has a cause the same size in disjoint ranges?

A line for every cause of every trial: its size over its standard deviation by the model alone, over ranges of frequency and
of level, and the probability that it is none; see docs/decisions/0100, 0101 and 0104.
"""

from __future__ import annotations

import argparse

import numpy as np
from threadpoolctl import threadpool_limits

from monitor.diagnosis.constancy import LinearFit
from monitor.diagnosis.parameter_uncertainty import sizes
from monitor.inference import gather
from monitor.runs import diagnose
from tests.hidden import judge, trial, worlds


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
    fit, lines = LinearFit.of(found.posterior, found.final_fit), []
    for i, effect in enumerate(found.final_fit.effects):
        first, key = found.final_fit.coordinates_of(i).start, (effect.name, effect.location)
        for j, size in enumerate(sizes(effect), start=first):
            if size is None:
                continue
            alone = abs(size) / np.sqrt(fit.covariance[j, j])
            ranges = (
                f"{abs(size) / common.std:.1f} over {of} (Q {common.statistic:.0f} for {common.rank},"
                f" chance of none {common.chance_of_none(size):.1e})"
                for of, common in zip(("frequency", "level"), fit.common_sizes(j), strict=True)
            )
            what = "true" if key in true and plan.kind != "outside" else "in kind" if key in true else "false"
            lines.append(
                f"{seed} {name}: {effect.name} {effect.location}, {what}, {'stated' if key in stated else 'not stated'}:"
                f" alone {alone:.1f}, {', '.join(ranges)}"
            )
    return lines


def main() -> None:
    """Print the lines of a world's trials."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.diagnosis.constancy", description="Are causes alike everywhere?"
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
