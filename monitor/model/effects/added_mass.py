"""Mass that the drawing does not contain, on one floor or on all floors alike."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf

import numpy as np
from typing_extensions import override

from monitor.core import Array
from monitor.model.effects.base import Condition, Context, Effect, FittedSizes, Parameter, Structure, place_index

_SIGNATURE = "frequencies fall in the pattern of one floor (of the frame: all alike, as a uniform loss of stiffness)"


@dataclass(frozen=True)
class AddedMass(Effect):
    """Additional mass: a floor's mass m becomes m + mass_kg.

    On the frame the effect is an `AddedMassEverywhere`, and every m becomes m (1 + relative).
    """

    name = "added_mass"
    family = "structure"
    places = ("floor", "frame")
    whole_floor = True
    parameters = (Parameter("mass_kg", 0.0, inf, absent=0.0),)
    signature = _SIGNATURE
    separating_measurement = "weigh what stands on the floors, or add a known mass and record again"

    mass_kg: float

    @classmethod
    @override
    def create(cls, location: str, parameters: Mapping[str, float]) -> Effect:
        if location == "frame":
            return AddedMassEverywhere.create(location, parameters)
        return super().create(location, parameters)

    @override
    def structural(self, mass: Array, stiffness: Array, structure: Structure) -> tuple[Array, Array]:
        return np.asarray(mass + self.mass_kg * structure.added_mass(self.index(structure))), stiffness

    @classmethod
    @override
    def starts(cls, location: str, context: Context, condition: Condition) -> tuple[Effect, ...]:
        if location == "frame":
            return tuple(AddedMassEverywhere(location, r) for r in (0.003, 0.02, 0.08))
        mass = float(context.structure.masses_kg[place_index(location, context.structure)])
        return tuple(cls(location, share * mass) for share in (0.003, 0.02, 0.1))

    @classmethod
    @override
    def sentence(cls, fitted: FittedSizes) -> str:
        if fitted.location == "frame":
            return AddedMassEverywhere.sentence(fitted)
        if not fitted.is_sized("mass_kg"):
            return f"{fitted.location} carries more mass than {fitted.source}, too little to be sized"
        share = fitted.share_of_floor_mass("mass_kg")
        return f"{fitted.location} carries {fitted.interval('mass_kg')} more than {fitted.source}{share}"


@dataclass(frozen=True)
class AddedMassEverywhere(Effect):
    """Additional mass on the whole frame: the same fraction of every floor's mass."""

    name = "added_mass"
    family = "structure"
    places = ("frame",)
    parameters = (Parameter("relative", 0.0, 10.0, absent=0.0),)
    signature = _SIGNATURE

    relative: float

    @override
    def structural(self, mass: Array, stiffness: Array, structure: Structure) -> tuple[Array, Array]:
        return mass * (1.0 + self.relative), stiffness

    @classmethod
    @override
    def sentence(cls, fitted: FittedSizes) -> str:
        if not fitted.is_sized("relative"):
            return f"all floors are heavier than {fitted.source}, by too little to be sized"
        return f"all floors are {fitted.percent('relative')} heavier than {fitted.source}"
