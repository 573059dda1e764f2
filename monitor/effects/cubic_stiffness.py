"""A story that hardens or softens with its drift."""

from __future__ import annotations

from dataclasses import dataclass
from math import erf, erfc, exp, inf, pi, sqrt
from typing import ClassVar, Literal, Self

from monitor.effects.base import Condition, Context, Effect, Law, LawKind, System
from monitor.effects.parameter import Parameter
from monitor.structures import Structure


@dataclass(frozen=True)
class CubicStiffness(Effect):
    """Story force k d + k3 d^3.

    A softening cubic would run away, so beyond the drift at which its tangent has fallen to a tenth of k it goes on
    straight with that tangent; below, it is the cubic exactly.  Linearized: k + 3 k3 E min(d^2, d_max^2) for a normal
    drift, which is k + 3 k3 s_d^2 for any hardening cubic.
    """

    name: ClassVar[str] = "cubic_stiffness"
    family: ClassVar[Literal["structure", "excitation", "sensor"]] = "structure"
    places: ClassVar[tuple[str, ...]] = ("story",)
    parameters: ClassVar[tuple[Parameter, ...]] = (Parameter("k3_n_per_m3", -inf, inf, absent=0.0),)
    signature: ClassVar[str] = "frequencies rise (fall) with the level, damping does not, the drift is not skewed"
    conditional: ClassVar[bool] = True
    nonlinear: ClassVar[bool] = True

    k3_n_per_m3: float

    def extend(self, system: System, context: Context, condition: Condition) -> System:
        """See `Effect.extend`."""
        s, limit = float(condition.drift_m[self.index]), self._limit_m(context.structure)
        a = limit / s
        within = erf(a / sqrt(2.0)) - sqrt(2.0 / pi) * a * exp(-0.5 * a**2)
        mean_square = s**2 * within + limit**2 * erfc(a / sqrt(2.0))
        return system.plus(stiffness=3.0 * self.k3_n_per_m3 * mean_square * self.pattern(context.structure))

    def laws(self, structure: Structure) -> tuple[Law, ...]:
        """See `Effect.laws`."""
        return (Law(LawKind.CUBIC, self.direction(structure), (self.k3_n_per_m3, self._limit_m(structure))),)

    def _limit_m(self, structure: Structure) -> float:
        """Drift at which the cubic goes over into its tangent."""
        if self.k3_n_per_m3 >= 0.0:
            return 1e30
        return sqrt(0.9 * float(structure.stiffness_n_per_m[self.index]) / (-3.0 * self.k3_n_per_m3))

    @classmethod
    def starts(cls, location: str, context: Context, condition: Condition) -> tuple[Self, ...]:
        """See `Effect.starts`."""
        j = int(location.partition(" ")[2]) - 1
        k, s = float(context.structure.stiffness_n_per_m[j]), float(condition.drift_m[j])
        return tuple(cls(location, size * k / (3.0 * s**2)) for size in (0.03, 0.1, -0.03, -0.08))
