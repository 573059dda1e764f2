"""One trial: record, seal the answer, ask the engine, open the answer, judge."""

from __future__ import annotations

import json
import sys
import tempfile
import time
import traceback
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from tests.hidden import engine, judge, plans, truth, world

TRIALS_A_TRUTH = 8


@lru_cache(maxsize=1)
def calibrated(seed: int) -> tuple[truth.Truth, engine.Baseline]:
    """A truth and what calibration learns of it from 20 healthy minutes."""
    structure = truth.draw_truth(seed)
    act, _ = truth.healthy(structure, seed * 1_000_003 + 1)
    samples = world.record(act, plans.RECORD_S, seed * 1_000_003 + 1)
    t = np.arange(plans.RECORD_S)
    degc = 20.0 + 0.3 * np.sin(2.0 * np.pi * t / 700.0)
    return structure, engine.calibrate(structure.drawing(), world.blocks(samples, degc))


def run(seed: int, name: str, size: float | None = None) -> dict[str, Any]:
    """What came of trial `name` with this seed (and size), as plain data."""
    structure, baseline = calibrated(seed // TRIALS_A_TRUTH)
    began = time.perf_counter()
    plan = plans.draw(structure, name, seed, size)
    recording = world.blocks(world.record(plan.act, plan.duration_s, seed), plan.act.degc)
    made = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        seal = Path(folder) / "sealed.json"
        seal.write_text(json.dumps({"kind": plan.kind, "name": name, "hidden": [asdict(h) for h in plan.hidden]}))
        del plan
        try:
            answer = engine.answer(baseline, recording)
        except Exception as error:  # noqa: BLE001 - an outcome of its own; the next trials go on
            answer = {"verdict": "crashed", "causes": [], "alternatives": [], "error": traceback.format_exc(limit=-3)}
            print(repr(error), file=sys.stderr)
        sealed = json.loads(seal.read_text())
    return {
        "seed": seed,
        "standing": f"{structure.standing}, damping {structure.damping}, noise {structure.noise}, wind {structure.wind}",
        **sealed,
        "answer": answer,
        "outcome": judge.outcome(sealed, answer),
        "false": judge.false_causes(sealed, answer),
        "sizes": judge.sizes(sealed, answer),
        "seconds": {"record": round(made - began, 1), "diagnose": round(time.perf_counter() - made, 1)},
    }
