"""Diagnoses of frames whose forces, or whose recording, end inside the band of ``[processing]``.

    .venv/bin/python -m tests.hidden.force_bands FILE.jsonl [--shapes wall_18,...] [--effects clean,loss,...] [--seed S]

Every shape of the forces has a healthy record of 20 minutes, from which the baseline is learned, and for each effect a record.
FILE has a JSON line a record; those that it already holds are not made again.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.signal import butter, ellip, sosfilt
from threadpoolctl import threadpool_limits

from tests.hidden import engine, plans, truth, world
from tests.hidden.frame import drifts

FORCES = {
    "wall_25": ellip(10, 0.1, 80.0, 25.0, fs=world.KNOT_HZ, output="sos"),
    "wall_18": ellip(10, 0.1, 80.0, 18.0, fs=world.KNOT_HZ, output="sos"),
    "steep_25": butter(8, 25.0, fs=world.KNOT_HZ, output="sos"),
    "narrow_3_20": ellip(8, 0.1, 80.0, [3.0, 20.0], btype="bandpass", fs=world.KNOT_HZ, output="sos"),
}
"""Filters of the forces."""
RECORDING = {"antialias_28": butter(12, 28.0, fs=world.RATE_HZ, output="sos")}
"""Filters of the recording, before noise of a thousandth of its RMS."""
EFFECTS = ("clean", "loss", "cubic", "friction")
STORY = 1
"""Index of the story in which everything acts."""


def act_of(effect: str, structure: truth.Truth, seed: int) -> world.Act:
    """Make what acts in a record: a loss of 5 %, a hardening of 6 %, friction of 5 % of the story's force, or nothing."""
    act, motion = truth.healthy(structure, seed)
    k, drift, row = float(structure.frame.stories[STORY]), float(motion.drift[STORY]), drifts(3)[STORY]
    if effect == "loss":
        return replace(act, stiffness=act.stiffness - 0.05 * k * np.outer(row, row))
    if effect == "cubic":
        return replace(act, laws=((world.CUBIC, row, 0.06 * k / (3.0 * drift**2), 0.0),))
    if effect == "friction":
        return replace(act, laws=((world.FRICTION, row, 0.05 * k * drift, 0.01 * float(motion.drift_velocity[STORY])),))
    return act


def record(shape: str, effect: str, structure: truth.Truth, seed: int) -> np.ndarray:
    """Record one structure under forces of a shape."""
    act = replace(act_of(effect, structure, seed), sections=FORCES.get(shape))
    samples = world.record(act, plans.RECORD_S, seed)
    if shape in RECORDING:
        rng = np.random.default_rng([seed, 7])
        samples = sosfilt(RECORDING[shape], samples, axis=0)
        samples = samples + 1e-3 * samples.std(axis=0) * rng.standard_normal(samples.shape)
    return samples.astype(np.float32)


def main() -> None:
    """Make the records that FILE lacks, and print a line for each."""
    parser = argparse.ArgumentParser(prog="python -m tests.hidden.force_bands")
    parser.add_argument("file", type=Path)
    parser.add_argument("--shapes", default=",".join((*FORCES, *RECORDING)))
    parser.add_argument("--effects", default=",".join(EFFECTS))
    parser.add_argument("--seed", type=int, default=3)
    options = parser.parse_args()
    lines = options.file.read_text().splitlines() if options.file.exists() else []
    done = {(r["shape"], r["effect"], r["seed"]) for r in map(json.loads, lines)}
    structure = truth.draw_truth(options.seed)
    for shape in options.shapes.split(","):
        baseline = None
        for i, effect in enumerate(options.effects.split(",")):
            if (shape, effect, options.seed) in done:
                continue
            began = time.perf_counter()
            with threadpool_limits(limits=1):
                if baseline is None:
                    healthy = world.blocks(record(shape, "clean", structure, 1000 * options.seed))
                    baseline = engine.calibrate(structure.drawing(), healthy)
                recording = world.blocks(record(shape, effect, structure, 1000 * options.seed + 1 + i))
                answer = engine.answer(baseline, recording)
            result = {"shape": shape, "effect": effect, "seed": options.seed, "answer": answer}
            result |= {"hz": structure.frame.hz().round(2).tolist(), "seconds": round(time.perf_counter() - began, 1)}
            with options.file.open("a") as out:
                out.write(json.dumps(result) + "\n")
            told = "; ".join(f"{c['effect']} {c['location']} {c['parameters']}" for c in answer["causes"])
            rivals = "; ".join(f"{a['effect']} {a['location']} {a['probability']:.2f}" for a in answer["alternatives"])
            print(
                shape, effect, answer["verdict"], told, rivals, answer.get("band_hz"), answer["left_over"], flush=True
            )


if __name__ == "__main__":
    main()
