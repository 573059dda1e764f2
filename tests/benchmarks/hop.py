"""CPU time of one hop (identification over 15 orders with uncertainty, selection, updating, DDI) beside its floor.

Run: make benchmark.  Prints medians of interleaved rounds in one process, one thread of linear algebra; the floor is the
bare numpy work that any such hop needs: one block of lagged products, one SVD, fifteen eigenproblems.
"""

from __future__ import annotations

import time

import numpy as np
import scipy.linalg  # noqa: F401 - loaded before threads are limited
from threadpoolctl import threadpool_limits

from drivers.base import ACCELERATION, SampleBlock
from monitor.baseline import learn
from monitor.config import Configuration
from monitor.pipeline import Pipeline
from monitor.record import blocks_of
from monitor.results import WindowResult
from monitor.simulate import simulate
from monitor.whittle import RefinementSettings

CONFIG = Configuration.model_validate(
    {
        "structure": {
            "kind": "shear_frame",
            "masses_kg": [0.3253, 0.3514, 0.3129],
            "stiffness_n_per_m": [2909.4511, 1514.8507, 1897.6986],
        },
        "sensors": [{"channel": f"a{i}", "floor": i} for i in (1, 2, 3)],
    }
)


def recording(duration_s: float, seed: int) -> list[SampleBlock]:
    """Blocks of 10 s at 100 Hz: one hop each, nothing to resample."""
    floors = simulate(CONFIG.model(), duration_s=duration_s, rate_hz=100.0, noise=0.05, seed=seed).floors
    return list(blocks_of(ACCELERATION, floors, CONFIG.channels, 100.0, 0, 1000))


def floor(samples: np.ndarray, big: np.ndarray) -> None:
    """The work below which no such hop can go."""
    for tau in range(50):
        samples[: 1000 - 49].T @ samples[tau : tau + 1000 - 49]
    np.linalg.svd(big)
    for order in range(2, 31, 2):
        np.linalg.eig(big[:order, :order])


def hops(refined: bool) -> tuple[list[float], list[float]]:
    """CPU seconds of every hop after the first window, and of the floor's work interleaved with them."""
    config = CONFIG.model_copy(update={"refinement": RefinementSettings(enabled=refined)})
    learner = Pipeline(config)
    windows = [r for b in recording(1200.0, 1) for r in learner.push(b) if isinstance(r, WindowResult)]
    healthy, _ = learn(config, [r.modes for r in windows if r.modes], np.ones(1), ())
    pipeline = Pipeline(config, healthy)
    blocks = recording(3000.0, 2)
    for block in blocks[:45]:  # fill the first window
        pipeline.push(block)
    samples = blocks[0].samples.astype(float)
    big = np.random.default_rng(0).standard_normal((75, 75))
    ours, least = [], []
    for block in blocks[45:]:
        begin = time.process_time()
        pipeline.push(block)
        middle = time.process_time()
        floor(samples, big)
        ours.append(middle - begin)
        least.append(time.process_time() - middle)
    return ours, least


def main() -> None:
    """Print the table."""
    for refined, name in (
        (False, "identification, uncertainty, updating, DDI, alarm"),
        (True, "the same, refined by likelihood"),
    ):
        ours, least = hops(refined)
        hop, bare = 1e3 * np.median(ours), 1e3 * np.median(least)
        low, high = 1e3 * np.quantile(ours, [0.25, 0.75])
        print(
            f"{name}: {hop:.1f} ms of CPU a hop (quartiles {low:.1f}, {high:.1f}); floor {bare:.1f} ms; ratio {hop / bare:.1f}"
        )


if __name__ == "__main__":
    with threadpool_limits(limits=1):
        main()
