"""Flexible base: a massless footing on a spring under the lowest story."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Self

import numpy as np
from typing_extensions import override

from monitor.core import Array
from monitor.model.effects.base import Condition, Context, Effect, EffectError, FittedSizes, Parameter
from monitor.model.structures import ShearFrame, Structure


@dataclass(frozen=True)
class BaseFlexibility(Effect):
    """Spring under the whole frame, in series with the lowest story; the footing is massless.

    The footing's motion is condensed statically, for any frame above it: K - K 1 (K 1)^T / (1^T K 1 + k_b).
    """

    name = "base_flexibility"
    family = "structure"
    places = ("base",)
    parameters = (Parameter("stiffness_n_per_m", 0.0, inf, "inverse", inf),)
    signature = "as a loss of stiffness in the lowest story, exactly"
    separating_measurement = "put an accelerometer on the ground or footing: a soft base lets the footing move"

    stiffness_n_per_m: float

    @override
    def check(self, structure: Structure, channels: tuple[str, ...]) -> None:
        if not isinstance(structure, ShearFrame):
            raise EffectError(
                f"{self.name}: needs a shear frame, a structure given by matrices has the footing in them"
            )

    @override
    def structural(self, mass: Array, stiffness: Array, structure: Structure) -> tuple[Array, Array]:
        pull = stiffness.sum(axis=1)  # forces on the floors by a unit displacement of the footing
        condensed = np.outer(pull, pull) / (pull.sum() + self.stiffness_n_per_m)
        return mass, np.asarray(stiffness - condensed)

    @classmethod
    @override
    def starts(cls, location: str, context: Context, condition: Condition) -> tuple[Self, ...]:
        return (cls(location, 20.0 * float(context.structure.stiffness_n_per_m[-1])),)

    @classmethod
    @override
    def sentence(cls, fitted: FittedSizes) -> str:
        lowest = fitted.structure.stiffness_n_per_m[-1]
        lost = 100.0 * lowest / (lowest + fitted.value("stiffness_n_per_m"))
        spring = fitted.interval("stiffness_n_per_m")
        size = f" like a spring of {spring}, which takes {lost:.1f} % from the lowest story"
        return f"the base gives way{fitted.sized('stiffness_n_per_m', size)}"
