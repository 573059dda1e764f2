"""Viscous damper across a story."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import ClassVar, Literal, Self

from typing_extensions import override

from monitor.model.effects.base import Condition, Context, Effect, System
from monitor.model.effects.parameter import Parameter
from monitor.model.effects.report_face import FittedSizes, LawFamily, ParameterEstimates


@dataclass(frozen=True)
class StoryDamper(Effect):
    """Viscous damper: a force c times the drift's velocity, in addition to the structure's own damping."""

    name: ClassVar[str] = "story_damper"
    family: ClassVar[Literal["structure", "excitation", "sensor"]] = "structure"
    places: ClassVar[tuple[str, ...]] = ("story",)
    parameters: ClassVar[tuple[Parameter, ...]] = (Parameter("damping_n_s_per_m", 0.0, inf, absent=0.0),)
    signature: ClassVar[str] = "damping up in the modes that move this story, complex shapes, equal at every level"
    noun: ClassVar[str] = "a viscous damper"
    separating_measurement: ClassVar[str] = (
        "record at vibration levels a factor of three apart: a viscous damper acts alike at all of them"
    )

    damping_n_s_per_m: float

    @override
    def extend(self, system: System, context: Context, condition: Condition) -> System:
        return system.plus(damping=self.damping_n_s_per_m * self.pattern(context.structure))

    @classmethod
    @override
    def starts(cls, location: str, context: Context, condition: Condition) -> tuple[Self, ...]:
        return (cls(location, 0.1),)

    @classmethod
    @override
    def law_families(cls, parameters: ParameterEstimates) -> tuple[LawFamily, ...]:
        return ("dissipating",)

    @classmethod
    @override
    def sentence(cls, fitted: FittedSizes) -> str:
        size = fitted.sized("damping_n_s_per_m", f"{fitted.interval('damping_n_s_per_m')} ", "")
        small = fitted.sized("damping_n_s_per_m", "")
        return f"{fitted.location} has {size}more damping than {fitted.source}{small}"
