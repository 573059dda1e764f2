"""What the intervals of `shm_monitor.identify` hold of records of 20 to 120 s, on seven simulated structures.

    .venv/bin/python -m tests.statistics.short_records OUT.jsonl [SEEDS] [FIRST_SEED] [SECONDS,SECONDS,...]

Every seed has a structure of its own.  OUT.jsonl is gone on with.  A mode counts as found within 10 % of a true frequency, one to
one; an interval is 1.96 standard deviations either way, and one that is refused (`nan`) is counted beside them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shm_monitor as shm
from scipy.optimize import linear_sum_assignment
from scipy.signal import lfilter

from tests.support.campaign import gone_on_with, words
from tests.support.shear_response import RATE_HZ, Array, response, shear_frame

SECONDS = "20,30,60,120"
NEAR = 0.1
_BURN_IN = 10.0
"""Decay times of the lowest mode before a record begins. [count; what is left is 5e-5]"""


@dataclass(frozen=True)
class Case:
    """A kind of structure, and how it is shaken and measured."""

    floors: int = 3
    damping: float = 0.01
    close: float = 0.0
    """Relative distance of a mode of the other direction from each of the frame's; 0 for none."""
    channels: tuple[int, ...] | None = None
    level: float = 0.0
    """Standard deviation of the logarithm of the level, which wanders within 10 s; forces are then heavy-tailed too."""


CASES = {
    "3 floors": Case(),
    "10 floors": Case(floors=10),
    "damping 0.3 %": Case(damping=0.003),
    "damping 3 %": Case(damping=0.03),
    "close modes": Case(floors=2, close=0.05),
    "one channel": Case(channels=(-1,)),
    "gusts": Case(level=0.5),
}


def made(case: Case, seconds: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """A record of a new structure of this kind, and its true frequencies."""
    hz, shapes = shear_frame(case.floors, rng)
    if case.close:
        hz, shapes = np.concatenate([hz, hz * (1.0 + case.close)]), np.asarray(np.kron(np.eye(2), shapes))
        turn = rng.uniform(-0.5, 0.5)
        turned = np.kron([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]], np.eye(case.floors))
        shapes = np.asarray(turned @ shapes)
    lead = _BURN_IN / (2.0 * np.pi * hz.min() * case.damping)
    x = response(hz, shapes, case.damping, seconds + lead, rng, level=level(case, seconds + lead, rng))
    return x[-round(seconds * RATE_HZ) :, case.channels or slice(None)], hz


def level(case: Case, seconds: float, rng: np.random.Generator) -> Array | float:
    """The forces' level over time: of constant size, or wandering and of heavy tails."""
    if not case.level:
        return 1.0
    n, keep = round(seconds * RATE_HZ), np.exp(-1.0 / (10.0 * RATE_HZ))
    wander = lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], rng.standard_normal(n))
    return np.asarray(np.exp(case.level * wander) / np.sqrt(rng.chisquare(4.0, n) / 4.0))


def trial(name: str, seconds: float, seed: int) -> dict[str, Any]:
    """Identify one record; scores are errors over stated deviations of ln frequency and damping, NaN where refused."""
    case, rng = CASES[name], np.random.default_rng([seed, *name.encode(), round(seconds)])
    samples, hz = made(case, seconds, rng)
    found = shm.identify(samples, RATE_HZ)
    inside = hz * seconds >= 10.0
    apart = np.abs(np.log(found.frequencies_hz[:, None] / hz))
    pairs = [(int(i), int(j)) for i, j in zip(*linear_sum_assignment(apart), strict=True) if apart[i, j] < NEAR]
    rows = [
        (
            (found.frequencies_hz[i] - hz[j]) / found.frequencies_std_hz[i],
            (found.damping_ratio[i] - case.damping) / found.damping_std[i],
            found.frequencies_std_hz[i] / hz[j],
            found.damping_std[i] / case.damping,
            hz[j],
        )
        for i, j in pairs
    ]
    refined = found.estimate is not None and found.estimate.refined
    return {"modes": int(inside.sum()), "false": len(found) - len(pairs), "refined": refined, "rows": rows}


def table(rows: Sequence[dict[str, Any]]) -> str:
    """One line for each kind of structure and length: share that holds, of how many, and the median relative deviation."""
    lines = [f"{'':<15} {'s':>4}  records refined  modes found false  frequency holds         damping holds"]
    for name, seconds in sorted({(row["name"], row["seconds"]) for row in rows}):
        own = [row for row in rows if (row["name"], row["seconds"]) == (name, seconds)]
        z = np.array([one for row in own for one in row["rows"]], dtype=float).reshape(-1, 5)
        said = [_holds(z[:, k], z[:, 2 + k]) for k in (0, 1)]
        refined, modes, false = (sum(row[key] for row in own) for key in ("refined", "modes", "false"))
        counts = f"{len(own):>7} {refined:>7}  {modes:>5} {len(z):>5} {false:>5}"
        lines.append(f"{name:<15} {seconds:>4g}  {counts}  {said[0]:<22}  {said[1]}")
    return "\n".join(lines)


def _holds(z: Array, std: Array) -> str:
    stated = np.isfinite(z)
    if not stated.any():
        return "-"
    return f"{100 * (np.abs(z[stated]) < 1.96).mean():.1f} % ({stated.sum()}, {100 * np.median(std[stated]):.2g} %)"


def main() -> None:
    """Do what the file lacks, and print the table of all of it."""
    out, n, first, lengths = words(Path, 100, 1000, SECONDS)
    tasks = [(name, float(s), first + k) for k in range(n) for name in CASES for s in lengths.split(",")]
    print(table(gone_on_with(out, ("name", "seconds", "seed"), tasks, trial)))


if __name__ == "__main__":
    main()
