"""``python -m tests.hidden.smallest [--effects a,b] [--start SIZE] [--trials 10] [--seed S] [--out FILE]``: what is just found.

The held-out gain of a few clear trials says how far an effect may shrink until that is no more than what it takes to be named;
there (and, where that fails, at half as much again) it must be found at its right place in nine of ten new trials.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from tests.hidden import trial

_FOUND = 0.9
_PILOTS = 3
_NEEDED = 40.0
"""Nats that a cause takes to be named in nearly every record: its margin, its parameters' price, its rivals, and chance."""
_STEPS = 3
_WIDER = 1.5


@dataclass(frozen=True)
class Ladder:
    """Sizes of one effect, as the draws of `tests.hidden.catalogue` understand them."""

    unit: str
    clear: float
    """A size that is surely found."""
    power: float = 0.5
    """The size goes with this power of the gain; negative where a larger number is a smaller effect."""


LADDERS = {
    "stiffness_change": Ladder("relative, one story", 0.02),
    "added_mass": Ladder("of the floor's mass", 0.04),
    "temperature": Ladder("per K, over 10-16 K in 2 h", 1e-3),
    "cubic_stiffness": Ladder("3 k3 s_d^2 / k", 0.04),
    "gap_contact": Ladder("contact over story stiffness, gap 1.2-2.2 s_d", 0.5),
    "bilinear_stiffness": Ladder("relative drop", 0.1),
    "coulomb_friction": Ladder("of the RMS story force", 0.04),
    "quadratic_damping": Ladder("of the floor's own damping", 1.0),
    "story_damper": Ladder("N s/m", 0.5),
    "base_flexibility": Ladder("times the lowest story's stiffness", 20.0, -0.5),
    "gravity_softening": Ladder("factor", 0.6),
    "joint_flexibility": Ladder("girder to column", 10.0, -0.5),
    "attached_oscillator": Ladder("of the floor's mass, 6-25 Hz", 0.05),
    "harmonic_excitation": Ladder("line's RMS over the channel's", 0.1, 0.25),
    "coloured_excitation": Ladder("corner, Hz", 20.0, -0.25),
    "base_excitation": Ladder("share of the variance", 0.2),
    "sensor_gain": Ladder("gain less one", 0.02),
    "time_offset": Ladder("s", 5e-4),
    "clock_rate": Ladder("relative", 0.01),
    "sensor_clipping": Ladder("of the channel's RMS", 2.5, -0.05),
    "sensor_noise": Ladder("of the channel's RMS", 0.15, 0.25),
}
"""Polarity and swap have no size."""


def smallest(
    name: str, trials: int, seed: int, log: Path | None, start: float | None = None
) -> tuple[float | None, list[tuple[float, int]]]:
    """The smallest size found in nine of ten trials (None if no size tried is), and all that were tried.

    `start` is tried first in place of the pilots' forecast.
    """
    ladder = LADDERS[name]

    def run(number: int, size: float) -> dict[str, Any]:
        result = trial.run(seed * 100_000 + number, name, size)
        if log is not None:
            with log.open("a") as file:
                file.write(json.dumps({**result, "size": size}) + "\n")
        return result

    size = start or 0.0
    if start is None:
        pilots = [run(i, ladder.clear)["answer"].get("nats", 0.0) for i in range(_PILOTS)]
        size = ladder.clear * (_NEEDED / max(min(pilots), _NEEDED)) ** ladder.power
    tried = []
    for step in range(_STEPS):
        found = 0
        for i in range(trials):
            found += run(100 * (step + 1) + i, size)["outcome"] == "right"
            if found + trials - 1 - i < _FOUND * trials:
                break  # it cannot be reached any more
        tried.append((size, found))
        if found >= _FOUND * trials:
            return size, tried
        size *= _WIDER if ladder.power > 0 else 1.0 / _WIDER
    return None, tried


def main() -> None:
    """A line an effect, as soon as it is known."""
    parser = argparse.ArgumentParser(prog="python -m tests.hidden.smallest")
    parser.add_argument("--effects", default=",".join(LADDERS))
    parser.add_argument("--start", type=float)
    parser.add_argument("--trials", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    for name in options.effects.split(","):
        with threadpool_limits(limits=1):
            best, tried = smallest(name, options.trials, options.seed, options.out, options.start)
        steps = "; ".join(f"{size:.3g}: {found}" for size, found in tried)
        said = "larger" if best is None else f"{best:.3g}"
        print(f"{name:22s} {said:>14s} {LADDERS[name].unit} (found of {options.trials}: {steps})", flush=True)


if __name__ == "__main__":
    main()
