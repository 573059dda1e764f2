"""Flexible joints: the girders of a one-bay frame are not rigid, so that its joints rotate."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf

from typing_extensions import override

from monitor.model.effects.base import Effect, EffectError, FittedSizes, Parameter
from monitor.model.structures import ShearFrame, Structure


@dataclass(frozen=True)
class JointFlexibility(Effect):
    """Flexible joints: the two columns of a story are clamped into joints that rotate against one girder a floor.

    Both joints of a floor rotate alike (sway), so each floor has one rotation; `ShearFrame` condenses them.
    """

    name = "joint_flexibility"
    family = "structure"
    places = ("frame",)
    parameters = (Parameter("girder_to_column_ratio", 0.0, inf, "inverse", inf),)
    signature = "frequency ratios above a uniform shear frame's, and shapes that no set of stories gives"
    separating_measurement = "measure the rotation of a joint with an inclinometer or a gyroscope"
    start_sizes = ((50.0,),)

    girder_to_column_ratio: float
    """(E I_g / L_g) / (E I_c / h), one girder and one column, E I_c / h the mean over stories."""

    @override
    def check(self, structure: Structure, channels: tuple[str, ...]) -> None:
        if not isinstance(structure, ShearFrame):
            raise EffectError(
                f"{self.name}: needs a shear frame, a structure given by matrices has its girders in them"
            )

    @property
    @override
    def column_to_girder(self) -> float:
        return 0.0 if self.girder_to_column_ratio == inf else 1.0 / self.girder_to_column_ratio

    def altered(self, structure: Structure) -> Structure:
        """The flexibility adds to that of joints that are known to rotate."""
        assert isinstance(structure, ShearFrame), "refused by `check`"
        return replace(structure, column_to_girder=structure.column_to_girder + self.column_to_girder)

    @classmethod
    @override
    def sentence(cls, fitted: FittedSizes) -> str:
        size = f": girders are {fitted.interval('girder_to_column_ratio')} times as stiff as columns"
        return f"the joints rotate{fitted.sized('girder_to_column_ratio', size)}"
