"""A frame that a measured force shakes."""

from __future__ import annotations

import numpy as np

from drivers.base import ACCELERATION, FORCE, GROUND, SampleBlock
from monitor.model import Model, parse_effect
from monitor.model.simulation import level_wander, respond
from monitor.runs import cut_into_blocks
from tests.support.frames import shear_frame

T0_NS = 10**18
FORCED = shear_frame([0.33, 0.35, 0.31], [2900.0, 1500.0, 1900.0], inputs=[{"channel": "shaker", "floor": 2}])


def pushed(
    *effects: str, seed: int, ground: bool = False, late_s: int = 0, duration_s: float = 120.0, below_hz: float = np.inf
) -> list[SampleBlock]:
    """A frame that a measured force on floor 2 shakes, on a ground that moves as well if wanted."""
    rate_hz, n = 256.0, round(duration_s * 256.0)
    model = Model(FORCED.model().structure, tuple(parse_effect(e) for e in effects))
    rng = np.random.default_rng(seed)
    level = level_wander(n, rate_hz, 0.5, rng)
    force, moved = 3.0 * level * rng.standard_normal(n), 0.5 * level * rng.standard_normal(n)
    if below_hz < rate_hz:
        force = np.fft.irfft(np.fft.rfft(force) * (np.fft.rfftfreq(n, 1.0 / rate_hz) < below_hz), n)
    forces = 0.1 * rng.standard_normal((n, 3))
    forces[:, 1] += force
    floors = respond(model, forces, moved if ground else None, rate_hz)
    floors += 0.01 * floors.std(axis=0) * rng.standard_normal(floors.shape)
    blocks = list(cut_into_blocks(ACCELERATION, floors, FORCED.channels, rate_hz, T0_NS, 256))
    blocks += list(cut_into_blocks(FORCE, force[:, None], ("shaker",), rate_hz, T0_NS, 256, unit="N"))[late_s:]
    if ground:
        blocks += cut_into_blocks(GROUND, moved[:, None], ("g",), rate_hz, T0_NS, 256)
    return sorted(blocks, key=lambda block: block.t_ns)
