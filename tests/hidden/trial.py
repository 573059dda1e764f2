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

from drivers.base import SampleBlock
from tests.hidden import engine, judge, worlds
from tests.hidden.building_trials import Tower
from tests.hidden.truth import Truth

TRIALS_A_TRUTH = 8


@lru_cache(maxsize=4)
def calibrated(structure: Truth | Tower, seed: int) -> tuple[engine.Baseline, float]:
    """What calibration learns from 20 healthy minutes of a truth, and the seconds that it took."""
    recording = structure.healthy_recording(seed * 1_000_003 + 1)
    began = time.perf_counter()
    baseline = engine.calibrate(structure.drawing(), recording)
    return baseline, time.perf_counter() - began


def _asked(structure: Truth | Tower, seed: int, kind: str, recording: list[SampleBlock]) -> dict[str, Any]:
    """The engine's answer, with the seconds of calibration and diagnosis."""
    if kind == "uncalibrated":
        baseline, calibration_s = engine.uncalibrated(structure.drawing()), 0.0
    else:
        baseline, calibration_s = calibrated(structure, seed // TRIALS_A_TRUTH)
    began = time.perf_counter()
    answer = engine.answer(baseline, recording)
    return {**answer, "seconds": {"calibrate": calibration_s, "diagnose": time.perf_counter() - began}}


def run(seed: int, name: str, size: float | None = None) -> dict[str, Any]:
    """What came of trial `name` with this seed (and size), as plain data."""
    world = worlds.of(name)
    structure = world.structure(seed // TRIALS_A_TRUTH, name)
    began = time.perf_counter()
    plan = world.draw(structure, name, seed, size)
    recording, kind, note = plan.recording(), plan.kind, plan.note
    seconds = {"calibrate": 0.0, "record": time.perf_counter() - began, "diagnose": 0.0}
    with tempfile.TemporaryDirectory() as folder:
        seal = Path(folder) / "sealed.json"
        hidden = [asdict(h) for h in plan.hidden]
        seal.write_text(json.dumps({"kind": kind, "name": name, "hidden": hidden, **plan.known}))
        del plan, hidden
        try:
            answer = _asked(structure, seed, kind, recording)
            seconds |= answer.pop("seconds")
        except Exception as error:  # noqa: BLE001 - an outcome of its own; the next trials go on
            answer = {"verdict": "crashed", "causes": [], "alternatives": [], "error": traceback.format_exc(limit=-8)}
            print(repr(error), file=sys.stderr)
        sealed = json.loads(seal.read_text())
    return {
        "seed": seed,
        "standing": structure.summary() + (f"; {note}" if note else ""),
        **sealed,
        "answer": answer,
        "outcome": judge.outcome(sealed, answer),
        "false": judge.false_causes(sealed, answer),
        "sizes": judge.sizes(sealed, answer),
        "seconds": {what: round(s, 1) for what, s in seconds.items()},
    }
