"""The simulators by name: what each draws and records."""

from __future__ import annotations

from types import ModuleType

import numpy as np

from tests.hidden import building_trials, outside, plans, shaken

WORLDS: dict[str, ModuleType] = {
    "planar": plans, "building": building_trials, "shaken": shaken, "outside": outside,
}  # fmt: skip
"""Each has `NAMES` of a round of trials, `structure` of a seed and a name, and `draw`, which makes the plan of a trial."""
NAMES = tuple(name for world in WORLDS.values() for name in world.NAMES)


def of(name: str) -> ModuleType:
    """The world of a trial's name."""
    return next(world for world in WORLDS.values() if name in world.NAMES)


def rounds(n: int, seed: int, names: tuple[str, ...]) -> list[tuple[int, str]]:
    """Seeds and names of `n` trials, every name as often as the others, in an order that the seed shuffles."""
    out: list[tuple[int, str]] = []
    while len(out) < n:
        turn = np.random.default_rng([seed, len(out)]).permutation(len(names))
        out += [(seed * 100_000 + len(out) + i, names[k]) for i, k in enumerate(turn)]
    return out[:n]


def clean(world: str) -> str:
    """Name of a world's clean trial."""
    return next(name for name in (*WORLDS[world].NAMES, *plans.NAMES) if "clean" in name)
