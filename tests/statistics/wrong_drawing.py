"""How honest the damage index is where the drawing is wrong: masses 5 % off, joints that rotate.

    .venv/bin/python -m tests.statistics.wrong_drawing [BASELINES] [WINDOWS]

Records of a frame with joints of ratio 10 and masses 5 % off the drawing (signs drawn anew for each baseline), 10 % noise;
baselines of 1200 s; disjoint windows of the intact frame and of one that lost 5 % in one story.
"""

from __future__ import annotations

import numpy as np

from monitor.core import WindowResult
from monitor.model import EFFECTS, Model
from monitor.pipeline import Pipeline
from tests.statistics.estimates import BASELINE_S, WINDOW_S, configuration
from tests.support.campaign import each, words
from tests.support.simulated import ambient, learned, windows_of

LOSS = 0.05


def one_baseline(number: int, n_windows: int) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """(damaged story or 0, index, standard deviation) of every window."""
    rng = np.random.default_rng([20261121, number])
    drawn = configuration(WINDOW_S)
    masses = np.array(drawn.structure.masses_kg) * (1.0 + 0.05 * rng.choice([-1.0, 1.0], 3))
    joints = EFFECTS["joint_flexibility"].create("frame", {"girder_to_column_ratio": 10.0})
    truth = Model(drawn.model().structure.with_masses(masses), (joints,))
    overlapping = configuration(10.0)

    def seen(model: Model, seconds: float, pipeline: Pipeline) -> list[WindowResult]:
        return windows_of(pipeline, ambient(model, seconds, 1000.0, int(rng.integers(2**31))), 1000.0)

    baseline = learned(overlapping, seen(truth, BASELINE_S, Pipeline(overlapping)))
    out = []
    for story in range(4):
        stiffness = truth.structure.stiffness_n_per_m.copy()
        stiffness[story - 1] *= 1.0 - LOSS if story else 1.0
        run = seen(truth.with_stiffness(stiffness), WINDOW_S * n_windows, Pipeline(drawn, baseline))
        out += [(story, r.damage.ddi, r.damage.ddi_std) for r in run if r.damage is not None]
    return out


def main() -> None:
    """Print the table."""
    n_baselines, n_windows = words(20, 5)
    rows = [row for rows in each(one_baseline, [(i, n_windows) for i in range(n_baselines)]) for row in rows]
    print("lost in    mean index, stories 1 2 3 (%)   95 % intervals hold   right story leads")
    for story in range(4):
        ddi = np.array([d for s, d, _ in rows if s == story])
        std = np.array([e for s, _, e in rows if s == story])
        true = np.zeros(3)
        true[story - 1] = LOSS if story else 0.0
        held = (np.abs(ddi - true) < 1.96 * std).mean(axis=0)
        leads = f"{100.0 * (ddi.argmax(axis=1) == story - 1).mean():.1f} %" if story else ""
        name, mean = f"story {story}" if story else "none", str(np.round(100.0 * ddi.mean(axis=0), 2))
        print(f"{name:<10} {mean:<31} {np.round(100.0 * held, 1)!s:<21} {leads}  ({len(ddi)} windows)")


if __name__ == "__main__":
    main()
