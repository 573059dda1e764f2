"""A frame whose joints give with the level of motion: what is announced in a storm, and what is judged.

    .venv/bin/python -m tests.statistics.storm a|b [SEEDS]

Each story's stiffness falls by ``s a^2 / (a^2 + h^2)``, where a is the level of the forces and h three times that of the day.
(a) Baseline of one ordinary hour, then an hour at 2, 3 and 4 times its level, with ordinary hours between.  (b) Baseline of 48
windows at levels 0.5 to 3, then an hour of storm at 3 times the level, intact and with 5 % lost in story 2.  Windows are of
400 s, each simulated as a linear frame with the stiffness of its level.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from monitor.core import WHOLE, WindowResult
from monitor.damage import Baseline
from monitor.pipeline import Pipeline
from tests.statistics.estimates import STIFFNESS, configuration
from tests.support.campaign import words
from tests.support.simulated import ambient, learned, seeded, windows_of

WINDOW_S, HOP_S, RATE_HZ, BURN_IN_S = 400, 100, 200.0, 5.0
CONFIG = configuration(float(HOP_S))
SHAPES = {"issue": (0.024, 0.072, 0.048), "top": (0.08, 0.02, 0.02), "base": (0.02, 0.03, 0.09)}
"""Greatest softening of the stories 1, 2, 3."""
HALF = 3.0
"""Level of half the softening, over that of the day."""


def softened(level: float, shape: tuple[float, ...]) -> np.ndarray:
    """Stiffness over that of a frame at rest; drift follows the level alike in all stories."""
    return 1.0 - np.array(shape) * level**2 / (level**2 + HALF**2)


def run(
    pipeline: Pipeline, levels: list[float], shape: tuple[float, ...], seed: int, loss: np.ndarray, begin_s: int = 0
) -> list[WindowResult]:
    """Push a stretch of `WINDOW_S` for each level through a pipeline; the excitation swells by 10 % from stretch to stretch."""
    results: list[WindowResult] = []
    rng = np.random.default_rng([seed, 7])
    for k, nominal in enumerate(levels):
        level = nominal * float(np.exp(0.1 * rng.standard_normal()))
        model = CONFIG.model().with_stiffness(STIFFNESS * softened(level, shape) * (1.0 - loss))
        floors = level * ambient(model, WINDOW_S, RATE_HZ, seeded(seed, begin_s, k), lead_s=BURN_IN_S)
        results += windows_of(pipeline, floors, RATE_HZ, first=round((begin_s + k * WINDOW_S) * RATE_HZ))
    return results


def calibrated(levels: list[float], shape: tuple[float, ...], seed: int) -> Baseline:
    """Learn the baseline of windows at these levels."""
    pipeline = Pipeline(CONFIG)
    seen = run(pipeline, levels, shape, seed, np.zeros(3))
    return learned(CONFIG, seen, level_of=pipeline, span_ns=(0, len(levels) * WINDOW_S * 10**9))


@dataclass(frozen=True)
class Told:
    """What a stretch of windows said."""

    judged: float
    """Share of the windows."""
    announced: tuple[int, ...]
    """Stories that were announced, `WHOLE` among them."""
    ddi: np.ndarray
    """Mean index, shape (3,)."""


def told(results: list[WindowResult]) -> Told:
    """Summarize windows."""
    judged = [r for r in results if r.damage is not None]
    named = sorted({story for r in results for story in r.alarm.active})
    ddi = np.mean([r.damage.ddi for r in judged if r.damage is not None], axis=0) if judged else np.full(3, np.nan)
    return Told(len(judged) / len(results), tuple(named), ddi)


def trial_a(shape: str, seed: int, stretches: int = 9) -> dict[str, Told]:
    """An ordinary hour as baseline, then an hour of each level with one of the day's level between."""
    baseline = calibrated([1.0] * 9, SHAPES[shape], seed)
    pipeline, out, begin_s = Pipeline(CONFIG, baseline), {}, 10_000
    for level in (2.0, 1.0, 3.0, 1.0, 4.0):
        out[f"level {level:g}, from {begin_s} s"] = told(
            run(pipeline, [level] * stretches, SHAPES[shape], seed + 1000, np.zeros(3), begin_s)
        )
        begin_s += stretches * WINDOW_S
    return out


def trial_b(shape: str, seed: int, stretches: int = 9) -> dict[str, Told]:
    """48 windows, one an hour, at levels of 0.5 to 3; then a storm, intact and with 5 % lost in story 2."""
    levels = np.exp(np.random.default_rng([seed, 9]).uniform(np.log(0.5), np.log(3.0), 48)).tolist()
    baseline = calibrated(levels, SHAPES[shape], seed)
    storm = [3.0] * stretches
    return {
        name: told(run(Pipeline(CONFIG, baseline), storm, SHAPES[shape], seed + 2000, loss, 50_000))
        for name, loss in (("intact", np.zeros(3)), ("5 % lost in story 2", np.array([0.0, 0.05, 0.0])))
    }


def main() -> None:
    """Print what each trial said."""
    which, seeds = words(str, "1")
    for seed in map(int, seeds.split(",")):
        for shape in SHAPES:
            for name, t in (trial_a if which == "a" else trial_b)(shape, seed).items():
                stories, index = ["whole" if s == WHOLE else str(s) for s in t.announced], np.round(100 * t.ddi, 2)
                said = f"judged {100 * t.judged:.0f} %, announced {stories}, index {index} %"
                print(f"{shape} seed {seed} {name}: {said}", flush=True)


if __name__ == "__main__":
    main()
