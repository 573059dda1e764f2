"""``python -m tests.hidden.smallest [--effects a,b] [--trials 10] [--seed S] [--out FILE]``: the smallest size that is found.

For every effect, sizes are tried from large to small, each in as many trials with new places, signs and records, until fewer
than 90 % are found at the right place; the last size that held is the smallest.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from math import sqrt
from pathlib import Path

from threadpoolctl import threadpool_limits

from tests.hidden import trial

_FOUND = 0.9


@dataclass(frozen=True)
class Ladder:
    """Sizes of one effect, as the draws of `tests.hidden.catalogue` understand them."""

    unit: str
    largest: float
    ratio: float = 1.0 / sqrt(2.0)
    """From one size to the next smaller effect: above one where a larger number is a smaller effect."""


LADDERS = {
    "stiffness_change": Ladder("relative, one story", 0.02),
    "added_mass": Ladder("of the floor's mass", 0.04),
    "temperature": Ladder("per K, over 10-16 K in 2 h", 5e-4),
    "cubic_stiffness": Ladder("3 k3 s_d^2 / k", 0.02),
    "gap_contact": Ladder("contact over story stiffness, gap 1.2-2.2 s_d", 0.5),
    "bilinear_stiffness": Ladder("relative drop", 0.1),
    "coulomb_friction": Ladder("of the RMS story force", 0.03),
    "quadratic_damping": Ladder("of the floor's own damping", 0.5),
    "story_damper": Ladder("N s/m", 0.4),
    "base_flexibility": Ladder("times the lowest story's stiffness", 30.0, sqrt(2.0)),
    "gravity_softening": Ladder("factor", 0.6),
    "joint_flexibility": Ladder("girder to column", 15.0, 2.0),
    "attached_oscillator": Ladder("of the floor's mass, 6-25 Hz", 0.03),
    "harmonic_excitation": Ladder("line's RMS over the channel's", 0.1, 0.5),
    "coloured_excitation": Ladder("corner, Hz", 40.0, 2.0),
    "base_excitation": Ladder("share of the variance", 0.1, 0.5),
    "sensor_gain": Ladder("gain less one", 0.02),
    "time_offset": Ladder("s", 5e-4, 0.5),
    "clock_rate": Ladder("relative", 8e-3),
    "sensor_clipping": Ladder("of the channel's RMS", 2.5, 1.2),
    "sensor_noise": Ladder("of the channel's RMS", 0.15, 0.5),
}
"""The first size of each is one that is found surely; polarity and swap have none."""
_LONGEST = 8


def smallest(name: str, trials: int, seed: int, log: Path | None) -> tuple[float | None, list[tuple[float, int]]]:
    """The smallest size found in nine of ten trials (None if even the largest is not), and all that were tried."""
    ladder = LADDERS[name]
    size, best, tried = ladder.largest, None, []
    for step in range(_LONGEST):
        found = 0
        for i in range(trials):
            result = trial.run(seed * 100_000 + 1000 * step + i, name, size)
            found += result["outcome"] == "right"
            if log is not None:
                with log.open("a") as file:
                    file.write(json.dumps({**result, "size": size}) + "\n")
            if found + trials - 1 - i < _FOUND * trials:
                break  # it cannot be reached any more
        tried.append((size, found))
        if found < _FOUND * trials:
            break
        best, size = size, size * ladder.ratio
    return best, tried


def main() -> None:
    """A line an effect, as soon as it is known."""
    parser = argparse.ArgumentParser(prog="python -m tests.hidden.smallest")
    parser.add_argument("--effects", default=",".join(LADDERS))
    parser.add_argument("--trials", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    for name in options.effects.split(","):
        with threadpool_limits(limits=1):
            best, tried = smallest(name, options.trials, options.seed, options.out)
        steps = "; ".join(f"{size:.3g}: {found}" for size, found in tried)
        said = "more than that" if best is None else f"{best:.3g}"
        print(f"{name:22s} {said:>14s} {LADDERS[name].unit} (found of {options.trials}: {steps})", flush=True)


if __name__ == "__main__":
    main()
