"""Viscous damper across a story."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

from typing_extensions import override

from monitor.model.effects.base import Condition, Context, Effect, System
from monitor.model.effects.parameter import Parameter
from monitor.model.effects.report_face import FittedSizes


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
        size = fitted.sized("damping_n_s_per_m", f"{fitted.interval('damping_n_s_per_m')} ", "")
        small = fitted.sized("damping_n_s_per_m", "")
        return f"{fitted.location} has {size}more damping than {fitted.source}{small}"
