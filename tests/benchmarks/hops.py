"""Cost of a hop beside that in another checkout: the same windows of 400 s every 10 s, block by block in turn.

    python -m tests.benchmarks.hops OTHER_CHECKOUT [HOURS]

Each kind runs in a process of its own, with this file and the modules of its checkout, on one thread of linear algebra, and
tells its CPU time of each hop; the kinds take every block in an order of chance.  So whatever the machine does meanwhile, it
does to all of them.  Baselines are of one healthy hour; the level of motion wanders.
"""

from __future__ import annotations

import inspect
import os
import random
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

HERE = Path(__file__).resolve().parents[2]
RATE_HZ, HOUR_S, HOP_S = 100.0, 3600, 10
KINDS = {
    "law": "with the law",
    "together": "with common changes",
    "no_events": "with common changes, no events looked for",
    "none": "without",
}
"""What the baseline of a checkout knows of covariates."""


def worker(kind: str, samples: Path) -> None:
    """Push the block whose number comes on standard input, and write the CPU time of its hop, s; 0 where none was judged."""
    import monitor.damage
    from drivers.base import ACCELERATION
    from monitor.core import WindowResult
    from monitor.damage import learn_baseline
    from monitor.pipeline import Pipeline
    from monitor.runs import cut_into_blocks
    from tests.statistics.estimates import configuration

    config, floors = configuration(float(HOP_S)), np.load(samples)
    blocks = list(cut_into_blocks(ACCELERATION, floors, config.channels, RATE_HZ, 0, round(HOP_S * RATE_HZ)))
    n_healthy = HOUR_S // HOP_S
    pipeline = Pipeline(config)
    results = [r for b in blocks[:n_healthy] for r in pipeline.push(b) if isinstance(r, WindowResult)]
    good = [r for r in results if r.modes is not None]
    windows, rms, span_ns = [r.modes for r in good], np.array([r.rms_m_s2 for r in good]), (0, HOUR_S * 10**9)
    known = config.instrumented(), windows, rms, ()
    if hasattr(monitor.damage, "HealthyData"):
        healthy = monitor.damage.HealthyData(
            windows=windows,
            rms_m_s2=rms,
            span_ns=span_ns,
            covariates=[r.covariates for r in good],
            units={"level": "dB"},
        )
        more = {"updating": config.updating, "compensation": config.compensation}
        baseline = learn_baseline(config.instrumented(), healthy, drift_weights=pipeline.level_weights, **more)[0]
    elif "compensation" in inspect.signature(learn_baseline).parameters:
        seen = [r.covariates for r in good], {"level": "dB"}, pipeline.level_weights
        more = {"updating": config.updating, "compensation": config.compensation}
        baseline = learn_baseline(*known, span_ns, *seen, **more)[0]
    else:  # before there was one law of all covariates
        baseline = learn_baseline(*known, updating=config.updating, temperature=config.temperature)[0]
    if kind == "none" and hasattr(baseline, "law"):
        baseline = replace(baseline, law=None)
    if kind == "no_events":
        config = config.model_copy(update={"events": config.events.model_copy(update={"enabled": False})})
    if kind in ("together", "no_events"):
        baseline = replace(baseline, law=with_common_changes(baseline.law))
    pipeline = Pipeline(config, baseline)
    print("ready", flush=True)
    for line in sys.stdin:
        begun = time.process_time()
        judged = [r for r in pipeline.push(blocks[n_healthy + int(line)]) if isinstance(r, WindowResult)]
        spent = time.process_time() - begun
        print(spent if any(r.damage is not None for r in judged) else 0.0, flush=True)


def with_common_changes(law: Any) -> Any:
    """A law that knows besides what the stories do together."""
    from monitor.damage.common_change import nothing_learned

    white = np.linalg.solve(law.mixing, [0.01, 0.015, 0.008])
    square = 1440.0 * (np.eye(3) + np.outer(white, white))
    return replace(law, common=replace(nothing_learned(3), square=square, windows=1440))


def begin(checkout: Path, kind: str, samples: Path) -> subprocess.Popen[str]:
    """Start the process of a kind in a checkout, and wait until it is ready."""
    environment = os.environ | {"PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(Path(__file__).resolve()), "--worker", kind, str(samples)]
    process = subprocess.Popen(
        command, cwd=checkout, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    if process.stdout.readline().strip() != "ready":
        sys.exit(f"{kind} does not run in {checkout}")
    return process


def ask(process: subprocess.Popen[str], block: int) -> float:
    """Have a process push a block, and return its CPU time, s."""
    process.stdin.write(f"{block}\n")
    process.stdin.flush()
    return float(process.stdout.readline())


def row(name: str, seconds: np.ndarray, base: np.ndarray) -> str:
    """Median, mean and 95th percentile of a hop, each with its distance from the other checkout's."""
    said = []
    for word, figure in {"median": np.median, "mean": np.mean, "95 %": lambda x: np.quantile(x, 0.95)}.items():
        said.append(f"{word} {1e3 * figure(seconds):.2f} ms ({100 * figure(seconds) / figure(base) - 100:+.0f} %)")
    return f"{name}: {', '.join(said)}"


def main() -> None:
    """Print what a hop costs of each kind, in the first hour and after."""
    from tests.statistics.estimates import configuration
    from tests.support.simulated import ambient

    other, hours = Path(sys.argv[1]).resolve(), float(sys.argv[2]) if len(sys.argv) > 2 else 2.0
    seconds = HOUR_S + round(HOUR_S * hours)
    floors = ambient(configuration(float(HOP_S)).model(), float(seconds), RATE_HZ, 2, level_spread=0.2)
    with tempfile.TemporaryDirectory() as folder:
        samples = Path(folder) / "floors.npy"
        np.save(samples, floors)
        kinds = {"the other checkout": begin(other, "none", samples)}
        kinds |= {word: begin(HERE, kind, samples) for kind, word in KINDS.items()}
        spent: dict[str, list[float]] = {name: [] for name in kinds}
        order, chance = list(kinds), random.Random(0)
        for block in range((seconds - HOUR_S) // HOP_S):
            chance.shuffle(order)
            for name in order:
                spent[name].append(ask(kinds[name], block))
        for process in kinds.values():
            process.communicate()
    times = {name: np.array(s) for name, s in spent.items()}
    judged = np.flatnonzero(np.min(list(times.values()), axis=0) > 0.0)[10:]
    first = judged < HOUR_S // HOP_S
    for part, hops in {"first hour": judged[first], "after": judged[~first], "all": judged}.items():
        if hops.size:
            print(f"{part}, {hops.size} hops")
            for name, s in times.items():
                print("  " + row(name, s[hops], times["the other checkout"][hops]))


if __name__ == "__main__":
    if sys.argv[1] == "--worker":
        sys.path.remove(str(Path(__file__).resolve().parent))  # this file is run by its path: other checkouts lack it
        with threadpool_limits(limits=1):
            worker(sys.argv[2], Path(sys.argv[3]))
    else:
        main()
