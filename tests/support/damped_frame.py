"""A frame with dampers, its recordings and their diagnosis."""

from __future__ import annotations

from drivers.base import ACCELERATION
from monitor.config import Configuration
from monitor.inference import Segments, gather
from monitor.model import Context, Effect, Model, simulate
from monitor.runs import cut_into_blocks
from tests.support.frames import shear_frame

RATE = 100.0
DAMPER = "story_damper:story 1:damping_n_s_per_m=1.5"


def settings(**changes: object) -> Configuration:
    return shear_frame([0.33, 0.35, 0.31], [2900.0, 1500.0, 1900.0], structure=changes)


def recorded(effects: tuple[Effect, ...], seed: int, duration_s: float = 400.0, **more: object) -> Segments:
    config = settings()
    model = Model(config.model().structure, effects)
    context = Context(model.structure, config.channels, config.instrumented().sensor_matrix, RATE)
    motion = simulate(
        model, duration_s=duration_s, rate_hz=RATE, noise=0.05, level_spread=0.35, seed=seed, context=context, **more
    )
    return gather(cut_into_blocks(ACCELERATION, motion.floors, config.channels, RATE, 10**18, 100), config.front_end())


def context_of(config: Configuration) -> Context:
    return config.instrumented().context(RATE)
