"""A frame with an effect in a joint, recorded and fitted without it."""

from __future__ import annotations

import numpy as np

from drivers.base import ACCELERATION
from monitor.config import Configuration
from monitor.diagnosis.initial_fit import fit_linearized
from monitor.inference import MapEstimate, Posterior, classify, gather
from monitor.model import Effect, Model, prior_from_drawing, simulate
from monitor.runs import cut_into_blocks

RATE = 128.0


FRAME = {"kind": "shear_frame", "masses_kg": [0.33, 0.35, 0.31], "stiffness_n_per_m": [2900.0, 1500.0, 1900.0]}


SENSORS = [{"channel": f"a{i}", "floor": i} for i in (1, 2, 3)]


BRISK = {"ranked": 8, "tried": 3, "favourites": 2}
"""Settings of a search that fits fewer candidates than usual."""


CONFIG = Configuration.model_validate(
    {
        "structure": FRAME,
        "sensors": SENSORS,
        "processing": {"cutoff_hz": 30.0, "hop_s": 5.0},
        "refinement": {"segment_s": 10.0},
        "diagnosis": BRISK,
    }
)
"""The modes lie below 25 Hz; segments half as long as usual bear recordings half as long."""


def posed(effect: Effect, seed: int = 5) -> tuple[Posterior, MapEstimate]:
    """A recording with the effect, and the model without it fitted."""
    model = Model(CONFIG.model().structure, (effect,))
    context = CONFIG.instrumented().context(RATE)
    motion = simulate(model, duration_s=200.0, rate_hz=RATE, noise=0.05, level_spread=0.35, seed=seed, context=context)
    blocks = cut_into_blocks(ACCELERATION, motion.floors, CONFIG.channels, RATE, 10**18, 128)
    known = prior_from_drawing(CONFIG.model(), np.full(6, 0.002), 3)
    return fit_linearized(classify(gather(blocks, CONFIG.front_end())), known, context)
