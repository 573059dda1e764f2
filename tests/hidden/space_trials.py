"""Trials with the buildings of `building`, of which the structure file knows both directions and the turns.

    python -m tests.hidden.space_trials FIRST_SEED COUNT OUT.jsonl [planar]

Each trial draws a building with eccentric floors, its boxes, a drawing that is off by a few percent, and one thing that is new
since calibration.  With `planar`, answers by a structure file of the sway along x stand beside those in space.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from drivers.base import SampleBlock
from tests.hidden import engine, world
from tests.hidden.building import Act, Building, record, with_building
from tests.hidden.sensors import ideal
from tests.hidden.truth import RECORD_S, Hidden, log_uniform, structure_file

KINDS = ("clean", "loss x", "loss y", "loss torsion", "mass", "gain", "swap", "rotated", "clean x", "loss y in x")
"""What is new; ``clean x`` is nothing, forced along x alone, ``loss y in x`` a loss along y under forces along x alone."""
LOSS = -0.05
"""Of a storey's stiffness in one direction."""
RATE_HZ = 100.0
NOISE = 0.03
"""Of each channel's RMS at calibration."""


def draw_building(rng: np.random.Generator) -> Building:
    """A building of 2 or 3 floors with an eccentricity of up to 8 % of its plan, stiffer along one direction."""
    n, first_hz = int(rng.integers(2, 4)), log_uniform(rng, 1.0, 3.0)
    masses, width = (
        1e5 * np.exp(0.1 * rng.standard_normal(n)),
        np.array([20.0, 14.0]) * np.exp(rng.uniform(-0.2, 0.2, 2)),
    )
    along_x = (
        masses.mean() * (np.pi * first_hz / np.sin(np.pi / (4 * n + 2))) ** 2 * np.exp(0.1 * rng.standard_normal(n))
    )
    along_y = along_x * log_uniform(rng, 1.3, 2.5) * np.exp(0.1 * rng.standard_normal(n))
    centre = rng.uniform(-0.08, 0.08, 2) * width
    return Building(
        masses, (float(width[0]), float(width[1])), np.tile(centre, (n, 1)), np.stack([along_x] * 2, axis=1) / 2.0,
        np.stack([along_y] * 2, axis=1) / 2.0, tuple(0.5 * width * rng.uniform(0.8, 1.0)), np.full(n, 3.3), 0.01,
    )  # fmt: skip


def boxes(b: Building) -> list[tuple[int, tuple[float, float]]]:
    """Floor (0 = top) and place of each box: one a floor at a corner, and one more on the roof at the opposite corner."""
    corner = (0.4 * b.plan[0], 0.4 * b.plan[1])
    return [*((j, corner) for j in range(b.masses.size)), (0, (-corner[0], -corner[1]))]


def seen(b: Building) -> np.ndarray:
    """What the channels see, x and y of each box in turn, shape (c, 3 n)."""
    rows = []
    for floor, (x, y) in boxes(b):
        for of_box in ((1.0, 0.0, -y), (0.0, 1.0, x)):
            row = np.zeros((b.masses.size, 3))
            row[floor] = of_box
            rows.append(row.ravel())
    return np.array(rows)


def drawing(b: Building, rng: np.random.Generator) -> str:
    """The structure file in space, from the ground up; the stiffness about z is left to its default."""
    n = b.masses.size
    off = np.exp(np.stack([0.015 * rng.standard_normal(n), *0.04 * rng.standard_normal((2, n))]))
    text = '[structure]\nkind = "building"\n'
    for j in reversed(range(n)):
        text += (
            f"[[storeys]]\nmass_kg = {b.masses[j] * off[0, j]:.6g}\nplan_m = [{b.plan[0]:.4f}, {b.plan[1]:.4f}]\n"
            f"stiffness_x_n_per_m = {b.x_lines[j].sum() * off[1, j]:.6g}\n"
            f"stiffness_y_n_per_m = {b.y_lines[j].sum() * off[2, j]:.6g}\n"
            f"eccentricity_m = [{b.centre[j, 0]:.3f}, {b.centre[j, 1]:.3f}]\n"
        )
    for k, (floor, (x, y)) in enumerate(boxes(b), start=1):
        for axis in "xy":
            text += (
                f'[[sensors]]\nchannel = "b{k}{axis}"\nfloor = {n - floor}\naxis = "{axis}"\nposition_m = [{x}, {y}]\n'
            )
    return text + _processing(b)


def _processing(b: Building) -> str:
    highest = float(b.modes()[0][-1])
    rate = min(100.0, 5.0 * np.ceil(3.5 * highest / 5.0))
    return f"[processing]\nrate_hz = {rate}\ncutoff_hz = {0.4 * rate}\n"


def healthy(b: Building, rng: np.random.Generator, along: str) -> Act:
    """A record of the building alone, forced in every direction or along x alone."""
    n, c = b.masses.size, len(seen(b))
    level = np.array([1.0, 0.0, 0.0]) if along == "x" else np.exp(rng.uniform(-0.5, 0.5, 3))
    strength = b.masses[:, None] * np.stack([np.ones(n), np.ones(n), np.sqrt(b.gyration())], axis=1)
    forces = 0.01 * strength * level * np.exp(rng.uniform(-0.2, 0.2, (n, 3)))
    act = Act(b.mass(), b.damping(), b.stiffness(), forces.ravel(), seen(b), RATE_HZ, **vars(ideal(c)))
    return replace(act, noise_share=NOISE)


def changed(kind: str, b: Building, act: Act, rng: np.random.Generator) -> tuple[Hidden | None, Act]:
    """What is new of a kind, and the record's act with it."""
    n, c = b.masses.size, len(act.seen)
    j, box = int(rng.integers(n)), int(rng.integers(len(boxes(b))))
    names = [f"b{k + 1}{axis}" for k in range(len(boxes(b))) for axis in "xy"]
    pair = f"channel {names[2 * box]},{names[2 * box + 1]}"
    if kind.startswith("loss"):
        x, y, direction = b.x_lines.copy(), b.y_lines.copy(), kind.split()[1]
        stiffness = act.stiffness
        if direction == "x":
            x[j] *= 1.0 + LOSS
        elif direction == "y":
            y[j] *= 1.0 + LOSS
        weaker = replace(b, x_lines=x, y_lines=y)
        new = with_building(act, weaker)
        if direction == "torsion":
            d = np.zeros(3 * n)
            d[3 * j + 2] = 1.0
            if j + 1 < n:
                d[3 * j + 5] = -1.0
            about = b.x_lines[j].sum() * b.reach[1] ** 2 + b.y_lines[j].sum() * b.reach[0] ** 2
            new = replace(act, stiffness=stiffness + LOSS * about * np.outer(d, d))
        else:  # the two lines of a direction turn the storey too, which stays as it was
            d = np.zeros(3 * n)
            d[3 * j + 2] = 1.0
            if j + 1 < n:
                d[3 * j + 5] = -1.0
            lines, reach = (b.x_lines, b.reach[1]) if direction == "x" else (b.y_lines, b.reach[0])
            new = replace(new, stiffness=new.stiffness - LOSS * lines[j].sum() * reach**2 * np.outer(d, d))
        return Hidden("stiffness_change", f"storey {n - j} {direction}", {"relative": LOSS}), new
    if kind == "mass":
        heavier = replace(b, masses=b.masses + 0.06 * b.masses[j] * np.eye(n)[j])
        return Hidden("added_mass", f"floor {n - j}", {"mass_kg": 0.06 * float(b.masses[j])}), with_building(
            act, heavier
        )
    if kind == "gain":
        k = int(rng.integers(c))
        return Hidden("sensor_gain", f"channel {names[k]}", {"gain": 1.1}), replace(act, gain=1.0 + 0.1 * np.eye(c)[k])
    if kind == "swap":
        order = list(range(c))
        order[2 * box], order[2 * box + 1] = order[2 * box + 1], order[2 * box]
        return Hidden("channel_swap", pair), replace(act, order=tuple(order))
    if kind == "rotated":
        angle = float(rng.choice([-1.0, 1.0]) * rng.uniform(5.0, 40.0))
        cos, sin, turned = np.cos(np.radians(angle)), np.sin(np.radians(angle)), act.seen.copy()
        x, y = act.seen[2 * box], act.seen[2 * box + 1]
        turned[2 * box], turned[2 * box + 1] = cos * x + sin * y, -sin * x + cos * y
        return Hidden("sensor_rotation", pair, {"angle_deg": angle}), replace(act, seen=turned)
    return None, act


def trial(seed: int, kind: str, *, with_planar: bool) -> dict[str, Any]:
    """Draw a trial, ask the engine, and judge its answer."""
    rng, began = np.random.default_rng([seed, 301]), time.monotonic()
    b = draw_building(rng)
    file = drawing(b, rng)
    along = "x" if (kind.endswith(" x") and kind.startswith("clean")) or kind == "loss y in x" else ""
    hidden, act = changed(kind, b, healthy(b, rng, along), rng)
    before = record(healthy(b, rng, ""), RECORD_S, seed)
    # The sensors' noise is that of calibration, however strong the forces are now.
    after = record(replace(act, noise_share=0.0, noise=NOISE * before.std(axis=0)), RECORD_S, seed + 500)
    names = tuple(f"b{k + 1}{axis}" for k in range(len(boxes(b))) for axis in "xy")
    answer = engine.answer(engine.calibrate(file, _blocks(before, names)), _blocks(after, names))
    planar = None
    if with_planar and kind.split()[0] in ("clean", "loss"):
        one, sees = _planar(b)
        planar = engine.answer(engine.calibrate(one, _blocks(before[:, sees], names)), _blocks(after[:, sees], names))
    said = {"seed": seed, "kind": kind, "floors": b.masses.size, "hidden": None if hidden is None else vars(hidden)}
    told = {"answer": answer, "planar": planar, "seconds": round(time.monotonic() - began)}
    return said | {"judged": judged(hidden, answer), "judged_planar": planar and judged(hidden, planar)} | told


def judged(hidden: Hidden | None, answer: dict[str, Any]) -> str:
    """Judge an answer: ``right``, ``among`` the alternatives, ``missed`` (nothing is said), ``more`` besides, or ``wrong``."""
    said = [(c["effect"], c["location"]) for c in answer["causes"]]
    among = [(c["effect"], c["location"]) for c in answer["alternatives"]]
    if hidden is None:
        return "right" if answer["verdict"] == "none" else "wrong"
    own = hidden.effect, hidden.location
    if answer["verdict"] == "none":
        return "missed"
    if own in said:
        return "right" if len(said) == 1 and answer["verdict"] == "named" else "more"
    return "among" if own in among else "wrong"


def _planar(b: Building) -> tuple[str, list[int]]:
    """The structure file of the sway along x, and the channels that it knows: one along x a floor."""
    floors = [floor for floor, _ in boxes(b)][: b.masses.size]
    text = structure_file(b.masses, b.x_lines.sum(axis=1), b.heights, [floor + 1 for floor in floors])
    for k in range(len(floors)):
        text = text.replace(f'"a{k + 1}"', f'"b{k + 1}x"')
    return f"{text}\n{_processing(b)}", [2 * k for k in range(len(floors))]


def _blocks(samples: np.ndarray, names: tuple[str, ...]) -> list[SampleBlock]:
    blocks = world.blocks(samples.astype(np.float32), rate_hz=RATE_HZ)
    chosen = names if samples.shape[1] == len(names) else names[0 : 2 * samples.shape[1] : 2]
    return [replace(block, channels=chosen) for block in blocks]


def main(first: int, count: int, out: Path, *, with_planar: bool) -> None:
    """Run trials of all kinds in turn, one line each."""
    with out.open("a", encoding="utf-8") as file:
        for seed in range(first, first + count):
            kind = KINDS[seed % len(KINDS)]
            try:
                said = trial(seed, kind, with_planar=with_planar)
            except Exception as error:  # noqa: BLE001 - a trial that fails is told as such, and the others go on
                said = {"seed": seed, "kind": kind, "judged": f"failed: {error!r}"}
            file.write(json.dumps(said) + "\n")
            file.flush()


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]), with_planar="planar" in sys.argv[4:])
