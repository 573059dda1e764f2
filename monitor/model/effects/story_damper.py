"""Viscous damper across a story."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

from typing_extensions import override

from monitor.model.effects.base import Condition, Context, Effect, FittedSizes, Parameter, System


@dataclass(frozen=True)
class StoryDamper(Effect):
    """Viscous damper: a force c times the drift's velocity, in addition to the structure's own damping."""

    name = "story_damper"
    family = "structure"
    places = ("story",)
    parameters = (Parameter("damping_n_s_per_m", 0.0, inf, absent=0.0),)
    signature = "damping up in the modes that move this story, complex shapes, equal at every level"
    noun = "a viscous damper"
    separating_measurement = (
        "record at vibration levels a factor of three apart: a viscous damper acts alike at all of them"
    )
    families = ("dissipating",)
    start_sizes = ((0.1,),)

    damping_n_s_per_m: float

    @override
    def extend(self, system: System, context: Context, condition: Condition) -> System:
        return system.plus(damping=self.damping_n_s_per_m * self.pattern(context.structure))

    @classmethod
    @override
    def sentence(cls, fitted: FittedSizes) -> str:
        says = f"{fitted.location} has <>more damping than {fitted.source}"
        return fitted.with_size("damping_n_s_per_m", says, fitted.interval("damping_n_s_per_m"), by="")
