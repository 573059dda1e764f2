"""Lasting loss after an event: an hour of ambient motion before and after, 0 to 30 % lost in the middle story.

``python -m tests.statistics.lasting_loss SEED...`` prints a line for each loss and seed.
"""

from __future__ import annotations

import sys

import numpy as np

from monitor.events import Event
from monitor.pipeline import Pipeline
from tests.events.shaken import RATE, STIFFNESS, Shaken, blocks, configuration, kanai_tajimi, shake

_AMBIENT_S = 3600.0


def trial(lost: float, seed: int) -> Event:
    """Return the last telling of an event after which the middle story has lost a share of its stiffness."""
    rng = np.random.default_rng(seed)
    wave = kanai_tajimi(20.0, 1.0, 2.5, rng)
    ground = np.zeros(round(_AMBIENT_S * RATE) + wave.size)
    ground[-wave.size :] = wave
    first, state = shake(ground, rng)
    stiffness = STIFFNESS * np.array([1.0, 1.0 - lost, 1.0])
    second, _ = shake(np.zeros(round((_AMBIENT_S + 200.0) * RATE)), rng, stiffness=stiffness, start=state)
    motion = Shaken(*(np.concatenate([getattr(first, n), getattr(second, n)]) for n in ("floors", "ground", "drifts")))
    pipeline = Pipeline(configuration(processing={"hop_s": 200.0}))
    return [e for block in blocks(motion, n=4000) for e in pipeline.push(block) if isinstance(e, Event)][-1]


def main() -> None:
    """Print the losses told, in percent, with their standard deviations."""
    for lost in (0.0, 0.03, 0.1, 0.3):
        for seed in map(int, sys.argv[1:]):
            event = trial(lost, seed)
            told = ", ".join(f"{100 * x:.2f} ({100 * s:.2f})" for x, s in zip(event.loss, event.loss_std, strict=True))
            print(f"{100 * lost:.0f} % lost in story 2, seed {seed}, revision {event.revision}: {told} %", flush=True)


if __name__ == "__main__":
    main()
