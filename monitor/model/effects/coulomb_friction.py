"""Dry (Coulomb) friction across a story."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, pi, sqrt
from typing import Self

import numpy as np
from typing_extensions import override

from monitor.model.effects.base import (
    Condition,
    Context,
    Effect,
    FittedSizes,
    Law,
    LawKind,
    Parameter,
    System,
    place_index,
)
from monitor.model.structures import Structure

_STICK_FACTOR = 8.0
"""Velocity that the friction force gives the story's impedance, over the velocity below which friction is smoothed.
[ratio; not recorded]"""


@dataclass(frozen=True)
class CoulombFriction(Effect):
    """Dry friction: a force of constant size F against the drift's velocity v.

    The integration uses tanh(v / v0) for the sign of v, with v0 = F / (8 sqrt(k m)), where m is the mass that moves when only the
    story drifts.  This creep is well below any velocity that matters, since v0 falls with F.  Linearized, the damping is
    c + sqrt(2 / pi) F / s_v, where s_v is the RMS drift velocity.
    """

    name = "coulomb_friction"
    family = "structure"
    places = ("story",)
    parameters = (Parameter("friction_force_n", 0.0, inf, absent=0.0),)
    signature = "damping falls with the level, frequencies hardly move"
    noun = "dry friction"
    separating_measurement = (
        "record at vibration levels a factor of three apart: friction loses weight as the level grows"
    )
    families = ("dissipating",)
    conditional = True
    nonlinear = True
    amplitude_powers = (-1.0,)
    form_uncertainty = (0.04,)  # real laws may creep, or have more static than sliding friction

    friction_force_n: float

    @override
    def extend(self, system: System, context: Context, condition: Condition) -> System:
        damping = (
            sqrt(2.0 / pi) * self.friction_force_n / float(condition.drift_velocity_m_s[self.index(context.structure)])
        )
        return system.plus(damping=damping * self.pattern(context.structure))

    @override
    def laws(self, structure: Structure) -> tuple[Law, ...]:
        if self.friction_force_n == 0.0:
            return ()
        direction = self.direction(structure)
        mass = 1.0 / float(direction @ np.linalg.solve(structure.mass_matrix(), direction))
        impedance = sqrt(float(structure.stiffness_n_per_m[self.index(structure)]) * mass)
        creep = self.friction_force_n / (_STICK_FACTOR * impedance)
        return (Law(LawKind.FRICTION, direction, (self.friction_force_n, creep)),)

    @classmethod
    @override
    def starts(cls, location: str, context: Context, condition: Condition) -> tuple[Self, ...]:
        j = place_index(location, context.structure)
        return (cls(location, 0.03 * float(context.structure.stiffness_n_per_m[j] * condition.drift_m[j])),)

    @classmethod
    @override
    def sentence(cls, fitted: FittedSizes) -> str:
        size = f" of {fitted.interval('friction_force_n')}"
        return f"{fitted.location} rubs: dry friction{fitted.sized('friction_force_n', size)}"
