"""Joints that rotate: the girders of a one-bay frame are not rigid."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import ClassVar, Literal, Self

import numpy as np

from monitor.effects.base import Condition, Context, Effect, EffectError
from monitor.effects.parameter import Parameter
from monitor.results import Array
from monitor.structures import ShearFrame, Structure


@dataclass(frozen=True)
class JointFlexibility(Effect):
    """Story shear from two columns clamped into joints that rotate, held by one girder a floor.

    Both joints of a floor rotate alike (sway), so each floor has one rotation; the rotations are condensed
    statically.  Heights are taken equal where the structure file gives none.

    References
    ----------
    A. K. Chopra, Dynamics of Structures, section 9.3 (beam-to-column stiffness ratio) and 9.4 (condensation).
    """

    name: ClassVar[str] = "joint_flexibility"
    family: ClassVar[Literal["structure", "excitation", "sensor"]] = "structure"
    places: ClassVar[tuple[str, ...]] = ("frame",)
    parameters: ClassVar[tuple[Parameter, ...]] = (Parameter("girder_to_column_ratio", 0.0, inf, "inverse", inf),)
    signature: ClassVar[str] = "frequency ratios above a uniform shear frame's, and shapes that no set of stories gives"

    girder_to_column_ratio: float
    """(E I_g / L_g) / (E I_c / h), one girder and one column, E I_c / h the mean over stories."""

    def check(self, structure: Structure, channels: tuple[str, ...]) -> None:
        """See `Effect.check`."""
        if not isinstance(structure, ShearFrame):
            raise EffectError(
                f"{self.name}: needs a shear frame, a structure given by matrices has its girders in them"
            )

    def structural(self, mass: Array, stiffness: Array, structure: Structure) -> tuple[Array, Array]:
        """See `Effect.structural`."""
        if self.girder_to_column_ratio == inf:
            return mass, stiffness
        assert isinstance(structure, ShearFrame), "refused by `check`"
        n = structure.n_stories
        heights = np.ones(n) if structure.story_heights_m is None else structure.story_heights_m
        column = structure.stiffness_n_per_m * heights**2 / 24.0  # E I_c / h of one of the two columns
        built = column if structure.built_n_per_m is None else structure.built_n_per_m * heights**2 / 24.0
        girder = self.girder_to_column_ratio * float(built.mean())
        drift = structure.drift_matrix()
        # Story j's rotations: its upper floor's and, but for the clamped ground, its lower floor's.
        rotation_sum = np.eye(n) + np.eye(n, k=1)
        k_theta = 12.0 * girder * np.eye(n)  # one girder bent in double curvature, both ends
        for j in range(n):
            ends = [j] if j == n - 1 else [j, j + 1]
            for a in ends:
                for b in ends:
                    k_theta[a, b] += column[j] * (8.0 if a == b else 4.0)
        coupling = -(drift.T * (12.0 * column / heights)) @ rotation_sum
        condensed = coupling @ np.linalg.solve(k_theta, coupling.T)
        return mass, np.asarray(stiffness - condensed)

    @classmethod
    def starts(cls, location: str, context: Context, condition: Condition) -> tuple[Self, ...]:
        """See `Effect.starts`."""
        return (cls(location, 50.0),)
