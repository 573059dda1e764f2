"""A frame that turns, which the model cannot."""

from __future__ import annotations

from functools import cache

import numpy as np

from drivers.base import ACCELERATION
from monitor.diagnosis import Diagnosis, diagnose
from monitor.inference import ObservedSpectra, Posterior, classify, gather, make_posterior
from monitor.model import Condition, Effect, Model, StructuralPrior, parse_effect, prior_from_drawing, simulate
from monitor.runs import cut_into_blocks
from tests.diagnosis.jointed_frame import PLAIN
from tests.support.brisk import BRISK

RATE = 512.0

TORSION = tuple(
    parse_effect(f"unmodelled_mode:frame:frequency_hz={hz},damping_ratio=0.012,shape_1={a},shape_2={b},shape_3={c}")
    for hz, a, b, c in ((7.4, 1.0, 0.8, 0.45), (17.5, 0.9, -0.5, -1.1))
)

COUPLED = parse_effect(
    "unmodelled_mode:frame:frequency_hz=9.0,damping_ratio=0.012,shape_1=1.0,shape_2=0.8,shape_3=0.45,"
    "force_ratio=0.6,eccentricity_1=-0.361,eccentricity_2=-0.325,eccentricity_3=-0.167,"
    "force_arm_1=-0.3,force_arm_2=0.25,force_arm_3=0.1"
)

REST = Condition(np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3))
TRUTH = PLAIN.model()
CONTEXT = PLAIN.instrumented().context(RATE)


@cache
def spectra(*effects: Effect) -> ObservedSpectra:
    """Averaged spectra of ten minutes of the true frame."""
    model = Model(TRUTH.structure, effects)
    motion = simulate(model, duration_s=600.0, rate_hz=RATE, noise=0.03, seed=5, context=CONTEXT)
    return classify(
        gather(cut_into_blocks(ACCELERATION, motion.floors, PLAIN.channels, RATE, 10**18, 128), PLAIN.front_end())
    )


def drawn(off: np.ndarray) -> StructuralPrior:
    """What a drawing tells that is off by factors."""
    structure = TRUTH.structure.with_stiffness(TRUTH.structure.stiffness_n_per_m * off)
    return prior_from_drawing(Model(structure), np.r_[np.full(3, 0.2), np.full(3, 0.05)], 3)


def posterior(off: np.ndarray, *effects: Effect) -> Posterior:
    return make_posterior(spectra(*effects), drawn(off), CONTEXT)


def diagnosed(off: np.ndarray, *effects: Effect) -> Diagnosis:
    """The first half of the recording, whose two classes of level take less time than five, up to the frame's last mode."""
    segments = spectra(*effects).segments
    half = segments.part(segments.t_s < 300.0).within((2.0, 27.0))
    return diagnose(classify(half), drawn(off), CONTEXT, BRISK)
