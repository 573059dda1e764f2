"""Loss or gain of stiffness of one story, or of all stories alike."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from typing_extensions import override

from monitor.core import Array
from monitor.model.effects.base import Effect, FittedModel, FittedSizes, Parameter, Structure, blurred_by_form

_GIRDERS_STD = 0.25
"""Relative standard deviation of a story's change beside flexible joints, times the joints' column-to-girder ratio.
[ratio; half of what it matters in frames like the paper's whether girders changed with the columns]"""


@dataclass(frozen=True)
class StiffnessChange(Effect):
    """Change of stiffness: k becomes k (1 + relative), of one story or of all stories."""

    name = "stiffness_change"
    family = "structure"
    places = ("story", "frame")
    parameters = (Parameter("relative", -1.0, 10.0, absent=0.0),)
    signature = (
        "frequencies and shapes move in the pattern of one story (of the frame: all frequencies alike), at every level"
    )
    start_sizes = ((-0.003,), (-0.02,), (-0.08,), (0.08,), (-0.14,))

    is_stiffness_loss = True

    relative: float
    """-0.2 = 20 % lost."""

    @override
    def altered(self, structure: Structure) -> Structure:
        if self.location == "frame":
            return structure
        return structure.changed(self.relative * np.eye(structure.n_stories)[self.index(structure)])

    @override
    def structural(self, mass: Array, stiffness: Array, structure: Structure) -> tuple[Array, Array]:
        return mass, stiffness * (1.0 + self.relative) if self.location == "frame" else stiffness

    def form_std_in(self, fitted: FittedModel) -> Array:
        """The frame's form, and girders that may have changed, leave a story's stiffness uncertain."""
        if self.location == "frame":
            return self.form_std
        flexible = sum(effect.column_to_girder for effect in fitted.effects)
        return blurred_by_form(self, fitted, _GIRDERS_STD * min(flexible, 1.0))

    @classmethod
    @override
    def sentence(cls, fitted: FittedSizes) -> str:
        change = "softer" if fitted.value("relative") < 0 else "stiffer"
        subject = "all stories are" if fitted.location == "frame" else f"{fitted.location} is"
        says = f"{subject} <>{change} than {fitted.source}"
        return fitted.with_size("relative", says, fitted.percent("relative"))
