"""A quake in which a story loses stiffness."""

from __future__ import annotations

from functools import cache

import numpy as np

from monitor.events import Event
from monitor.pipeline import Pipeline
from tests.events.shaken import RATE, STIFFNESS, Shaken, blocks, configuration, kanai_tajimi, shake

LIMIT = {"residual_loss": 0.05, "says": "send the engineer"}


@cache
def shaken(lost: float, seed: int, after_s: float = 75.0) -> Shaken:
    """70 s of ambient motion, a quake of 20 s after which story 2 has lost a share of its stiffness, and ambient motion."""
    rng = np.random.default_rng(seed)
    wave = np.concatenate([np.zeros(round(70 * RATE)), kanai_tajimi(20.0, 1.0, 2.5, rng)])
    first, state = shake(wave, rng)
    stiffness = STIFFNESS * np.array([1.0, 1.0 - lost, 1.0])
    second, _ = shake(np.zeros(round(after_s * RATE)), rng, stiffness=stiffness, start=state)
    return Shaken(*(np.concatenate([getattr(first, n), getattr(second, n)]) for n in ("floors", "ground", "drifts")))


def final(motion: Shaken, **events: object) -> tuple[Event, Pipeline]:
    pipeline = Pipeline(configuration(events={"limits": [LIMIT], **events}))
    told = [r for b in blocks(motion, n=1000) for r in pipeline.push(b) if isinstance(r, Event)]
    (event,) = (e for e in told if e.revision == 0)
    return event, pipeline
