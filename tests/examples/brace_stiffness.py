"""An effect: a brace that the drawing left out.  A nonlinear one adds `extend` (linearized at a condition) and `laws`."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import ClassVar, Literal, Self

from monitor.core import Array
from monitor.model import Condition, Context, Effect, FittedSizes, MatrixStructure, Parameter, ShearFrame


@dataclass(frozen=True)
class BraceStiffness(Effect):
    """A brace of known stiffness across a story."""

    name: ClassVar[str] = "brace_stiffness"
    family: ClassVar[Literal["structure", "excitation", "sensor"]] = "structure"
    places: ClassVar[tuple[str, ...]] = ("story",)
    parameters: ClassVar[tuple[Parameter, ...]] = (Parameter("stiffness_n_per_m", 0.0, inf, absent=0.0),)
    signature: ClassVar[str] = "every mode that moves this story rises, at every level alike"
    separating_measurement: ClassVar[str] = "look for a brace that the drawing does not show"

    stiffness_n_per_m: float

    def structural(self, mass: Array, stiffness: Array, structure: ShearFrame | MatrixStructure) -> tuple[Array, Array]:
        """See `Effect.structural`: linear and the same at every level, so this is its face in time as well."""
        return mass, stiffness + self.stiffness_n_per_m * self.pattern(structure)

    @classmethod
    def starts(cls, location: str, context: Context, condition: Condition) -> tuple[Self, ...]:
        """See `Effect.starts`."""
        story = int(location.partition(" ")[2]) - 1
        return (cls(location, 0.05 * float(context.structure.stiffness_n_per_m[story])),)

    @classmethod
    def sentence(cls, fitted: FittedSizes) -> str:
        """See `Effect.sentence`."""
        return f"a brace of {fitted.interval('stiffness_n_per_m')} stiffens {fitted.location}"
