"""A story, or every story alike, lost or gained stiffness."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from monitor.effects.base import Effect
from monitor.results import Array
from monitor.structures import ShearFrame


@dataclass(frozen=True)
class StiffnessChange(Effect):
    """Stiffness k becomes k (1 + relative)."""

    name: ClassVar[str] = "stiffness_change"
    places: ClassVar[tuple[str, ...]] = ("story", "frame")
    minimum: ClassVar[Mapping[str, float]] = {"relative": -1.0}

    relative: float
    """-0.2 = 20 % lost."""

    def stiffness_matrix(self, stiffness: Array, structure: ShearFrame) -> Array:
        """See `Effect.stiffness_matrix`."""
        if self.location == "frame":
            return stiffness * (1.0 + self.relative)
        lost = self.relative * structure.stiffness_n_per_m[self.index]
        return np.asarray(stiffness + lost * structure.stiffness_derivatives()[self.index])
