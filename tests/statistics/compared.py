"""Comparisons of recordings: how often two of one state are told to differ, and from which loss of a story two of two states are.

    .venv/bin/python -m tests.statistics.compared TRIALS [PROCESSES]

`halves` are two halves of one simulated record, of a kind of `KINDS` each; `days` are records of different days, whose level,
frequencies (by 0.5 %) and colour of the forces differ, with three to six more such days as the healthy ones.  In both, B may have
lost stiffness of a story.
"""

from __future__ import annotations

import tempfile
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from drivers.base import ACCELERATION
from monitor.core import Array
from monitor.model import Model, ShearFrame
from monitor.runs import compare, cut_into_blocks
from tests.support.campaign import each, words
from tests.support.live_rig import write
from tests.support.simulated import seeded

RATE_HZ, LOWEST_HZ, LEAD_S, DAY = 50.0, 2.0, 60.0, 0.005
KINDS = ("frame", "light", "close", "single", "gusts", "impulses")
LOSSES = (0.02, 0.05, 0.10)


class Told(NamedTuple):
    """What a comparison told."""

    differs: bool | None
    chance: float | None
    parts: tuple[str, ...]
    """What is significant, levels apart."""
    beyond: bool
    """Whether any mode's z-score lies beyond the limit, whatever the answer."""


def motion(
    kind: str, seconds: float, rng: np.random.Generator, *, loss: float = 0.0, faster: float = 0.0, colour: float = 0.0
) -> Array:
    """Acceleration of three floors, or of one sensor, m/s^2: modes that are resonators of a discrete model, with sensor noise.

    `faster` is the relative change of all frequencies, `colour` that of the forces (their coefficient of one sample ago).
    """
    frame = ShearFrame(np.array([1.0, 1.1, 0.9]), np.array([900.0, 1000.0, 1100.0]), 0.01)
    modes = Model(frame).with_stiffness(frame.stiffness_n_per_m * [1.0, 1.0 - loss, 1.0]).modes()
    hz = modes.frequencies_hz * LOWEST_HZ / Model(frame).modes().frequencies_hz[0] * (1.0 + faster)
    shapes = modes.shapes
    if kind == "close":
        hz[1] = 1.02 * hz[0]
    damping = 0.003 if kind == "light" else 0.01
    n = int((seconds + LEAD_S) * RATE_HZ)
    forces = lfilter([1.0], [1.0, -colour], rng.standard_normal((n, 3)), axis=0)
    if kind == "gusts":  # of a minute, by a factor of two; the forces' colour is red
        gusts = lfilter([1.0], [1.0, -np.exp(-1.0 / (60.0 * RATE_HZ))], rng.standard_normal(n))
        forces = lfilter([1.0], [1.0, -0.7], forces, axis=0) * np.exp(0.7 * gusts / gusts.std())[:, None]
    if kind == "impulses":
        forces = 0.1 * forces + 10.0 * (rng.random((n, 1)) < 0.2 / RATE_HZ) * rng.lognormal(size=(n, 1)) * [
            0.3,
            1.0,
            0.6,
        ]
    poles = np.exp(2.0 * np.pi / RATE_HZ * hz * (-damping + 1j * np.sqrt(1.0 - damping**2)))
    modal = [
        lfilter([1.0, -2.0, 1.0], [1.0, -2.0 * p.real, abs(p) ** 2], f)
        for p, f in zip(poles, (forces @ shapes).T, strict=True)
    ]
    clean = (np.transpose(modal) @ shapes.T)[-int(seconds * RATE_HZ) :]
    floors = 0.01 * (clean / clean.std() + 0.05 * rng.standard_normal(clean.shape))
    return np.asarray(floors[:, 2:] if kind == "single" else floors)


def seconds_of(kind: str) -> float:
    """Length of a side: six blocks of ten decay times, of which a comparison takes the length of four."""
    return 60.0 / (2.0 * np.pi * LOWEST_HZ * (0.003 if kind == "light" else 0.01))


def recorded(path: Path, samples: Array, *, rate_hz: float = RATE_HZ, gaps: tuple[float, ...] = ()) -> Path:
    """Write a recording; `gaps` are where a second of it is missing, as shares of it."""
    names = tuple(f"a{i + 1}" for i in range(samples.shape[1]))
    size = int(rate_hz)
    blocks = list(cut_into_blocks(ACCELERATION, samples, names, rate_hz, 10**18, size))
    lost = {int(share * len(blocks)) for share in gaps}
    return write(path, [block for k, block in enumerate(blocks) if k not in lost])


def compared(sides: list[Array]) -> Told:
    """Compare the first two records, with the others as the healthy ones."""
    with tempfile.TemporaryDirectory() as folder:
        paths = [recorded(Path(folder, f"{k}.mcap"), samples) for k, samples in enumerate(sides)]
        content = compare.compare(paths[0], paths[1], healthy=paths[2:])
    tests = [test for test in content["tests"] if test["kind"] != "level"]
    return Told(
        content["differs"],
        content["chance"],
        tuple(test["what"] for test in tests if test["significant"]),
        any(abs(test["z"]) > content["limit"] for test in tests),
    )


def halves(kind: str, seed: int, loss: float) -> Told:
    """Compare the halves of a record, or a record with that of a structure that lost stiffness."""
    rng, seconds = np.random.default_rng(seeded(KINDS.index(kind), seed)), seconds_of(kind)
    if not loss:
        both = motion(kind, 2.0 * seconds, rng)
        return compared([both[: len(both) // 2], both[len(both) // 2 :]])
    return compared([motion(kind, seconds, rng), motion(kind, seconds, rng, loss=loss)])


def days(seed: int, loss: float) -> Told:
    """Compare records of two days, with those of three to six more days."""
    rng, kind = np.random.default_rng(seeded(100, seed)), ("frame", "single", "gusts")[seed % 3]

    def day(loss: float = 0.0) -> Array:
        faster, level, colour = DAY * rng.standard_normal(), rng.lognormal(), rng.uniform(-0.2, 0.2)
        return level * motion(kind, seconds_of(kind), rng, loss=loss, faster=faster, colour=colour)

    return compared([day(), day(loss), *(day() for _ in range(3 + seed // 3 % 4))])


def share(told: list[Told]) -> float:
    """Share of comparisons that tell a difference."""
    return float(np.mean([bool(one.differs) for one in told]))


def line(name: str, told: list[Told]) -> str:
    """Say what comparisons told."""
    unsaid = sum(one.differs is None for one in told)
    beyond, named = np.mean([(one.beyond, bool(one.parts)) for one in told], axis=0)
    return (
        f"{name}: {100 * share(told):.1f} % of {len(told)} differ, {unsaid} cannot be said; a mode is named in "
        f"{100 * named:.0f} %, beyond its limit in {100 * beyond:.0f} %"
    )


def main() -> None:
    """Print a line for each kind and loss."""
    trials, processes = words(20, 1)
    for kind, loss in product(KINDS, (0.0, *LOSSES)):
        told = each(halves, [(kind, seed, loss) for seed in range(trials)], processes, keep=True)
        print(line(f"halves, {kind}, {100 * loss:g} %", told), flush=True)
    for loss in (0.0, *LOSSES):
        print(
            line(f"days, {100 * loss:g} %", each(days, [(seed, loss) for seed in range(trials)], processes, keep=True)),
            flush=True,
        )


if __name__ == "__main__":
    main()
