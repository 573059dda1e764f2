"""Days without an event: how often strong motion is recognized where there is none; resumable.

``python -m tests.statistics.quiet_days N SEED OUT.jsonl`` appends a line for each day, and prints the sum of all lines.

The forces' level wanders by a factor of e over the hours, with a gale of five times the level each day.  Each hour has
sixty doors and steps of people on one floor (a quarter of them felt on all floors), four spikes of several channels, two knocks
of a sensor for some seconds, and one machine that starts and stops.  Each day an offset steps and a channel is dead for an hour.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.signal import lfilter

from monitor.events import EventState, Site, stage
from monitor.signals import Conditioner
from tests.events.shaken import MASSES, STIFFNESS, configuration
from tests.support.campaign import gone_on_with, words

Array = NDArray[np.float64]
RATE = 100.0
HOUR = round(3600 * RATE)
_FORCE_N, _NOISE_M_S2 = 6.0, 2e-4
_DESIGN = Conditioner.design(RATE, RATE, 40.0)


class Building:
    """Ambient motion of a frame of three floors, hour after hour without a seam."""

    def __init__(self, rng: np.random.Generator) -> None:
        drift = np.eye(3) - np.eye(3, k=1)
        self._w2, self._shapes = eigh(drift.T @ np.diag(STIFFNESS) @ drift, np.diag(MASSES))
        self._rng, self._memory = rng, [np.zeros(2) for _ in self._w2]

    def move(self, forces: Array) -> Array:
        """Return the floors' accelerations by forces on them, shape (n, 3), at exact poles."""
        out = np.zeros_like(forces)
        for j, w in enumerate(np.sqrt(self._w2)):
            pole = np.exp((-0.02 * w + 1j * w * np.sqrt(1.0 - 0.02**2)) / RATE)
            a = [1.0, -2.0 * pole.real, abs(pole) ** 2]
            moved, self._memory[j] = lfilter([1.0, -2.0, 1.0], a, forces @ self._shapes[:, j], zi=self._memory[j])
            out += moved[:, None] * self._shapes[:, j]
        return out


def _level(day_hours: int, hour: int, gale: int, wander: Array) -> Array:
    """Return the factor on the forces through an hour of the day."""
    t = hour + np.arange(HOUR) / HOUR
    slow = np.interp(t, np.arange(day_hours + 1), wander)
    wind = np.interp(t, [0, gale, gale + 0.1, gale + 0.6, gale + 0.8, 24], [1, 1, 5, 5, 1, 1])
    return np.asarray(np.exp(slow) * wind)


def _disturb(floors: Array, rng: np.random.Generator, size: float) -> None:
    """Add doors, people, spikes, knocks and a machine to an hour of the floors' motion."""
    t = np.arange(100) / RATE
    for at in rng.integers(0, HOUR - 2000, 60):
        wave = size * rng.uniform(5, 100) * np.exp(-t / 0.1) * np.sin(2 * np.pi * rng.uniform(8, 35) * t)
        felt = rng.uniform(0.1, 1.0, 3) if rng.uniform() < 0.25 else np.eye(3)[rng.integers(3)]
        floors[at : at + 100] += wave[:, None] * felt
    for at in rng.integers(0, HOUR, 4):
        floors[at, : rng.integers(1, 4)] += rng.uniform(0.1, 20.0)
    for at in rng.integers(0, HOUR - 2000, 2):
        n = rng.integers(100, 1500)
        floors[at : at + n, rng.integers(3)] += size * rng.uniform(5, 300) * rng.standard_normal(n)
    begin, end = np.sort(rng.integers(0, HOUR, 2))
    hum = size * rng.uniform(2, 20) * np.sin(2 * np.pi * rng.uniform(5, 30) * np.arange(end - begin) / RATE)
    floors[begin:end] += hum[:, None] * rng.uniform(0.1, 1.0, 3)


def trial(seed: int) -> dict[str, int]:
    """Count the events that are recognized in a day without one, and the seconds in which windows would be skipped."""
    rng, state, hours = np.random.default_rng(seed), EventState(), 24
    building, wander, gale = Building(rng), rng.standard_normal(hours + 1) * 0.5, int(rng.integers(1, 22))
    config = configuration()
    site = Site.of(config.instrumented(), config.story_names, config.processing.window_s, config.events)
    events, held, dead_hour, step_at = 0, 0, int(rng.integers(24)), int(rng.integers(24))
    for hour in range(hours):
        forces = _FORCE_N * rng.standard_normal((HOUR, 3)) * _level(hours, hour, gale, wander)[:, None]
        floors = building.move(forces) + _NOISE_M_S2 * rng.standard_normal((HOUR, 3))
        _disturb(floors, rng, float(floors.std()))
        floors[:, 1] *= hour != dead_hour
        floors[:, 0] += 0.05 * (hour >= step_at)
        for first in range(0, HOUR, 6000):
            span = floors[first : first + 6000]
            state, told = stage.step(state, hour * HOUR + first, 0, _DESIGN, span, site)
            events += sum(e.revision == 0 for e in told)
            held += sum(end - begin for begin, end in state.marks if begin >= hour * HOUR + first)
    return {"events": events, "suspected_s": round(held / RATE)}


def main() -> None:
    """Do the days that the file lacks, and print the sum."""
    n, seed, out = words(int, int, Path)
    done = gone_on_with(out, ("seed",), [(1000 * seed + k,) for k in range(n)], trial)
    found, held = (sum(day[name] for day in done) for name in ("events", "suspected_s"))
    print(f"{len(done)} days: {found} events; motion suspected for {held / len(done):.0f} s a day")


if __name__ == "__main__":
    main()
