"""Breathing crack: open for positive drift, closed for negative drift."""

from __future__ import annotations

from dataclasses import dataclass

from typing_extensions import override

from monitor.core import Array
from monitor.model.effects.base import Condition, Context, Effect, FittedModel, Law, LawKind, System, blurred_by_form
from monitor.model.effects.gap_contact import mean_contact
from monitor.model.effects.parameter import Parameter
from monitor.model.effects.report_face import FittedSizes
from monitor.model.structures import Structure


@dataclass(frozen=True)
class BilinearStiffness(Effect):
    """Bilinear story stiffness: k (1 - relative_drop) for positive drift, k for negative drift.

    The linearization about the mean drift that the law causes is a little less than k (1 - 0.5 drop), the same at every level of
    vibration.
    """

    name = "bilinear_stiffness"
    family = "structure"
    places = ("story",)
    parameters = (Parameter("relative_drop", 0.0, 1.0, absent=0.0),)
    signature = (
        "half the frequency drop of an open crack, the same at every level, with a skewed drift and second harmonics"
    )
    noun = "a crack that opens"
    separating_measurement = "push the story both ways with a known force: an open crack is softer one way"
    families = ("asymmetric",)
    start_sizes = ((0.05,),)
    nonlinear = True
    amplitude_powers = (0.0,)
    form_uncertainty = (0.015,)  # independently written simulators differ by 1 to 2 %

    relative_drop: float

    @override
    def extend(self, system: System, context: Context, condition: Condition) -> System:
        k = float(context.structure.stiffness_n_per_m[self.index(context.structure)])
        drop = self.relative_drop * k
        return system.plus(stiffness=-drop * mean_contact(k, -drop, 0.0) * self.pattern(context.structure))

    @override
    def laws(self, structure: Structure) -> tuple[Law, ...]:
        drop = self.relative_drop * float(structure.stiffness_n_per_m[self.index(structure)])
        return (Law(LawKind.CONTACT, self.direction(structure), (0.0, -drop)),)

    def form_std_in(self, fitted: FittedModel) -> Array:
        """The drop is relative to a story's stiffness, which the frame's form leaves uncertain."""
        return blurred_by_form(self, fitted)

    @classmethod
    @override
    def sentence(cls, fitted: FittedSizes) -> str:
        says = f"{fitted.location} is <>softer for positive drift than for negative"
        return fitted.with_size("relative_drop", says, fitted.percent("relative_drop"))
