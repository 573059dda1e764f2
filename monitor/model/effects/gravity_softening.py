"""Softening by gravity: the weight above a story that leans adds to its drift (P-delta)."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import numpy as np
from typing_extensions import override

from monitor.core import Array
from monitor.model.effects.base import Effect, EffectError, FittedSizes, Parameter, Structure

_GRAVITY_M_S2 = 9.80665
"""Acceleration of gravity. [m/s^2; definition: standard gravity]"""


@dataclass(frozen=True)
class GravitySoftening(Effect):
    """Softening by gravity: story stiffness k becomes k - factor N / h, N the weight above, h the story's height.

    The factor is known from theory: 1 for hinged columns, 1.2 for columns clamped at both ends.
    """

    name = "gravity_softening"
    family = "structure"
    places = ("frame",)
    parameters = (Parameter("factor", 0.0, inf, absent=0.0),)
    signature = "all frequencies lower, the first most, at every level: a fixed pattern of losses, growing downwards"
    separating_measurement = (
        "work out the weight above every story over its height: theory fixes the size of this effect"
    )
    start_sizes = ((0.6,),)

    factor: float

    @override
    def check(self, structure: Structure, channels: tuple[str, ...]) -> None:
        if structure.story_heights_m is None:
            raise EffectError(f"{self.name}: needs story_heights_m in the structure file")

    @override
    def structural(self, mass: Array, stiffness: Array, structure: Structure) -> tuple[Array, Array]:
        assert structure.story_heights_m is not None, "refused by `check`"
        weight = _GRAVITY_M_S2 * np.cumsum(mass.sum(axis=1))
        lost = self.factor * weight / structure.story_heights_m
        return mass, np.asarray(stiffness - np.einsum("j,jab->ab", lost, structure.stiffness_derivatives()))

    @classmethod
    @override
    def sentence(cls, fitted: FittedSizes) -> str:
        times = f" by {fitted.interval('factor')} times weight over height (theory: 1.2, clamped columns)"
        return f"weight softens the stories{fitted.sized('factor', times)}"
