"""Beginnings of recordings: ``python -m tests.statistics.beginnings 20`` counts the events falsely told in their first 100 s.

Six frames, at rest and moving, and three of them with a gale, doors, a knocked sensor or a decaying motion; that many seeds each.
The decaying motion is strong motion that began before the recording, and is told as that.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import eigh
from scipy.signal import cont2discrete, lfilter

from drivers.base import ACCELERATION, SampleBlock
from monitor.events import Event
from monitor.pipeline import Pipeline
from tests.events.shaken import T0_NS, Array
from tests.support.campaign import words
from tests.support.frames import shear_frame

RATE, LENGTH_S, RMS, NOISE, OFFSET = 100.0, 100.0, 0.01, 1e-5, 9.81
FRAMES = {
    "laboratory, 5.5 Hz": ([0.325, 0.351, 0.313], [2251.0, 2251.0, 1811.0], 0.01),
    "the same, damping 0.2 %": ([0.325, 0.351, 0.313], [2251.0, 2251.0, 1811.0], 0.002),
    "house, 3.1 Hz": ([1000.0, 1200.0, 1200.0], [1.6e6, 2.0e6, 2.4e6], 0.02),
    "two floors, 3.1 Hz": ([1.0, 1.0], [1000.0, 1000.0], 0.01),
    "tower, 0.3 Hz": ([1e6] * 6, [6.3e7] * 6, 0.01),
    "tower, 0.15 Hz": ([1e6] * 10, [4e7] * 10, 0.005),
}
DISTURBED = ("laboratory, 5.5 Hz", "house, 3.1 Hz", "tower, 0.3 Hz")
DISTURBANCES = ("gale in 20 s", "gale in 60 s", "doors", "knocked", "decay")


def ambient(name: str, rng: np.random.Generator, *, rest: bool, level: Array | None = None) -> Array:
    """Accelerations of a frame under white forces, shape (n, floors), from rest or in its steady state."""
    masses, stiffness, damping = FRAMES[name]
    n, count = len(masses), round(LENGTH_S * RATE)
    drift = np.eye(n) - np.eye(n, k=1)
    w2, shapes = eigh(drift.T @ np.diag(stiffness) @ drift, np.diag(masses))
    lead = 0 if rest else min(round(20.0 / (damping * np.sqrt(w2[0])) * RATE), 400_000)
    force = rng.standard_normal((lead + count, n))
    if level is not None:
        force[lead:] *= level[:, None]
    motion = np.zeros_like(force)
    for j, w in enumerate(np.sqrt(w2)):
        b, a, _ = cont2discrete(([1.0, 0.0, 0.0], [1.0, 2.0 * damping * w, w * w]), 1.0 / RATE, method="foh")
        motion += np.outer(lfilter(np.ravel(b), a, force @ shapes[:, j]), shapes[:, j])
    motion = motion[lead:]
    return np.asarray(RMS * motion / motion.std() + NOISE * rng.standard_normal(motion.shape))


def disturb(motion: Array, kind: str, rng: np.random.Generator) -> Array:
    """Add a disturbance to a motion."""
    motion, (count, n) = motion.copy(), motion.shape
    t = np.arange(count) / RATE
    if kind == "doors":  # thirty times the ambient motion on all floors
        for at in rng.uniform(4.0, 60.0, 8):
            i, length = round(at * RATE), rng.integers(5, 40)
            motion[i : i + length] += rng.normal(0.0, 30.0 * RMS, (length, n))
    elif kind == "knocked":
        i = round(rng.uniform(5.0, 30.0) * RATE)
        motion[i : i + 800, rng.integers(n)] += rng.normal(0.0, 50.0 * RMS, 800)
    elif kind == "decay":
        motion *= (1.0 + 30.0 * np.exp(-t / 10.0))[:, None]
    return motion


def told(name: str, motion: Array) -> int:
    """Count the events that are told of a motion."""
    masses, stiffness, damping = FRAMES[name]
    config = shear_frame(masses, stiffness, structure={"damping_ratio": damping})
    pipeline, found = Pipeline(config), 0
    for i in range(0, len(motion), 200):
        values = (motion[i : i + 200] + OFFSET).astype(np.float32)
        t_ns = T0_NS + round(i / RATE * 1e9)
        block = SampleBlock(ACCELERATION, t_ns, i, RATE, config.channels, "m/s^2", values)
        found += sum(isinstance(r, Event) and r.revision is None for r in pipeline.push(block))
    return found + len(pipeline.finish())


def main() -> None:
    """Print the number of events falsely told of each frame and disturbance."""
    (seeds,), total = words(int), 0
    for name in FRAMES:
        for rest in (True, False):
            found = sum(told(name, ambient(name, np.random.default_rng(1000 + s), rest=rest)) for s in range(seeds))
            total += found
            print(f"{name}, {'at rest' if rest else 'moving'}: {found} of {seeds}", flush=True)
    print(f"in all: {total} of {2 * seeds * len(FRAMES)}")
    t = np.arange(round(LENGTH_S * RATE)) / RATE
    for kind in DISTURBANCES:
        found = 0
        for name in DISTURBED:
            for s in range(seeds):
                rng, level = np.random.default_rng(2000 + s), None
                if kind.startswith("gale"):
                    level = 1.0 + 4.0 * np.clip((t - rng.uniform(5.0, 20.0)) / float(kind.split()[2]), 0.0, 1.0)
                found += told(name, disturb(ambient(name, rng, rest=False, level=level), kind, rng))
        print(f"{kind}: {found} of {seeds * len(DISTURBED)}", flush=True)


if __name__ == "__main__":
    main()
