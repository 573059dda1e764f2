"""Quadratic damping: drag of a floor in air or water."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, pi, sqrt
from typing import Self

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


@dataclass(frozen=True)
class QuadraticDamping(Effect):
    """Quadratic damping: force c2 v |v| against a floor's velocity v relative to the ground.

    Linearized, the damping is c + sqrt(8 / pi) c2 s_v, where s_v is the RMS velocity of the floor.
    """

    name = "quadratic_damping"
    family = "structure"
    places = ("floor",)
    parameters = (Parameter("coefficient_n_s2_per_m2", 0.0, inf, absent=0.0),)
    signature = "damping rises with the level, frequencies stay"
    noun = "a drag"
    separating_measurement = "record at vibration levels a factor of three apart: drag gains weight as the level grows"
    families = ("dissipating",)
    conditional = True
    nonlinear = True
    amplitude_powers = (1.0,)

    coefficient_n_s2_per_m2: float

    @override
    def extend(self, system: System, context: Context, condition: Condition) -> System:
        speed = float(condition.floor_velocity_m_s[self.index(context.structure)])
        damping = sqrt(8.0 / pi) * self.coefficient_n_s2_per_m2 * speed
        return system.plus(damping=damping * self.pattern(context.structure))

    @override
    def laws(self, structure: Structure) -> tuple[Law, ...]:
        return (Law(LawKind.QUADRATIC, self.direction(structure), (self.coefficient_n_s2_per_m2, 0.0)),)

    @classmethod
    @override
    def starts(cls, location: str, context: Context, condition: Condition) -> tuple[Self, ...]:
        j = place_index(location, context.structure)
        structure = context.structure
        stiffness = float(structure.stiffness_matrix()[j, j])
        own = 2.0 * structure.damping_ratio * sqrt(stiffness * float(structure.inertia_kg[j]))
        return (cls(location, 0.5 * own / (sqrt(8.0 / pi) * float(condition.floor_velocity_m_s[j]))),)

    @classmethod
    @override
    def sentence(cls, fitted: FittedSizes) -> str:
        drag = fitted.sized("coefficient_n_s2_per_m2", f", {fitted.interval('coefficient_n_s2_per_m2')}")
        return f"{fitted.location} feels a drag that grows as its velocity squared{drag}"
