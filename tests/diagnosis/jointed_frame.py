"""A frame whose recordings may hide effects: recorded, fitted without them, learned with them."""

from __future__ import annotations

import numpy as np

from drivers.base import ACCELERATION
from monitor.config import Configuration
from monitor.core import Array
from monitor.diagnosis.initial_fit import fit_linearized
from monitor.inference import MapEstimate, Posterior, Segments, classify, gather
from monitor.model import Effect, Model, StructuralPrior, parse_effect, prior_from_drawing, simulate
from monitor.runs import cut_into_blocks, diagnose
from tests.support.brisk import briefly
from tests.support.frames import shear_frame
from tests.support.reference import once

RATE = 128.0
PLAIN = shear_frame([0.33, 0.35, 0.31], [2900.0, 1500.0, 1900.0])
CONFIG = briefly(PLAIN)
CONTEXT = CONFIG.instrumented().context(RATE)


def recorded(
    *effects: str | Effect,
    seed: int,
    reads: Array | None = None,
    config: Configuration = CONFIG,
    duration_s: float = 300.0,
    noise: float = 0.02,
    level_spread: float = 0.0,
) -> Segments:
    """The frame with effects, seen by channels that read the floors by a matrix, each by a factor, or by a factor a sample."""
    present = tuple(parse_effect(e) if isinstance(e, str) else e for e in effects)
    floors = simulate(
        Model(config.model().structure, present),
        duration_s=duration_s,
        rate_hz=RATE,
        noise=noise,
        level_spread=level_spread,
        seed=seed,
        context=CONTEXT,
    ).floors
    if reads is not None:
        floors = floors @ reads.T if reads.shape == (3, 3) else floors * reads
    return gather(cut_into_blocks(ACCELERATION, floors, config.channels, RATE, 10**18, 128), config.front_end())


def known(std: float = 0.002) -> StructuralPrior:
    """The drawing, of which every stiffness and mass is known to a share."""
    return prior_from_drawing(CONFIG.model(), np.full(6, std), 3)


def fitted(segments: Segments, std: float = 0.002) -> tuple[Posterior, MapEstimate]:
    """The drawing fitted to a recording."""
    return fit_linearized(classify(segments), known(std), CONTEXT)


def posed(effect: Effect, seed: int = 5) -> tuple[Posterior, MapEstimate]:
    """A recording with the effect, and the model without it fitted."""
    return fitted(recorded(effect, seed=seed, duration_s=200.0, noise=0.05, level_spread=0.35))


COLOUR = "coloured_excitation:frame:corner_hz=12"
GAINS = ("sensor_gain:channel a1:gain=1.015", "sensor_gain:channel a2:gain=0.985")


def forces(share: float, more: float) -> str:
    """Falling ever faster, but for a hump at 8 Hz, and pushing floors together."""
    rises = (f"rise_{i}={(0.3 if i == 10 else -0.3 - 0.3 * (i > 10)) + more}" for i in range(1, 16))
    return f"ambient_forces:frame:common_share={share}," + ",".join(rises)


FORCES, ANOTHER_DAY = forces(0.3, 0.0), forces(0.33, 0.06)
"""Of the forces, and how they are on another day."""

TURNING = (
    "unmodelled_mode:frame:frequency_hz=9.0,damping_ratio=0.012,shape_1=2.0,shape_2=1.5,shape_3=-0.9,"
    "force_ratio=0.6,eccentricity_1=-0.275,eccentricity_2=-0.238,eccentricity_3=-0.081",
    "unmodelled_mode:frame:frequency_hz=17.0,damping_ratio=0.01,shape_1=1.0,shape_2=-2.0,shape_3=0.6,"
    "force_ratio=0.9,eccentricity_1=0.02,eccentricity_2=-0.1,eccentricity_3=-0.1",
)
"""Modes of a frame that turns besides."""


@once
def learned(*standing: str) -> StructuralPrior:
    """The reference of a healthy frame that has had some effects from the start."""
    return diagnose.learn_healthy_prior(recorded(*standing, seed=1), CONFIG)
