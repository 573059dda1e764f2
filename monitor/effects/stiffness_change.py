"""A story, or every story alike, lost or gained stiffness."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal, Self

import numpy as np

from monitor.effects.base import Condition, Context, Effect
from monitor.effects.parameter import Parameter
from monitor.results import Array
from monitor.structures import Structure


@dataclass(frozen=True)
class StiffnessChange(Effect):
    """Stiffness k becomes k (1 + relative)."""

    name: ClassVar[str] = "stiffness_change"
    family: ClassVar[Literal["structure", "excitation", "sensor"]] = "structure"
    places: ClassVar[tuple[str, ...]] = ("story", "frame")
    parameters: ClassVar[tuple[Parameter, ...]] = (Parameter("relative", -1.0, 10.0, absent=0.0),)
    signature: ClassVar[str] = (
        "frequencies and shapes move in the pattern of one story (of the frame: all frequencies alike), at every level"
    )

    relative: float
    """-0.2 = 20 % lost."""

    def structural(self, mass: Array, stiffness: Array, structure: Structure) -> tuple[Array, Array]:
        """See `Effect.structural`."""
        if self.location == "frame":
            return mass, stiffness * (1.0 + self.relative)
        lost = self.relative * structure.stiffness_n_per_m[self.index]
        return mass, np.asarray(stiffness + lost * structure.stiffness_derivatives()[self.index])

    @classmethod
    def starts(cls, location: str, context: Context, condition: Condition) -> tuple[Self, ...]:
        """See `Effect.starts`."""
        return tuple(cls(location, r) for r in (-0.003, -0.02, -0.08, 0.08, -0.14))
