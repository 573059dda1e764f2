"""Cubic stiffness: a story that hardens or softens with its drift."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, sqrt
from typing import Self

import numpy as np
from typing_extensions import override

from monitor.core import Array
from monitor.model.effects.base import (
    Condition,
    Context,
    Effect,
    FittedModel,
    Law,
    LawKind,
    Parameter,
    System,
    place_index,
)
from monitor.model.effects.report_face import FittedSizes, LawFamily, ParameterEstimates
from monitor.model.structures import Structure

_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(40)
_WEIGHTS /= _WEIGHTS.sum()
"""Gauss-Hermite nodes and weights of the mean over a standard normal variable."""


@dataclass(frozen=True)
class CubicStiffness(Effect):
    """Cubic stiffness: story force k d + k3 d^3.

    A softening cubic would be unstable at large drift.  Its force is therefore multiplied by 1 / (1 + (d / q)^4), q^2 = k / |k3|:
    the law is the cubic up to the sixth order, and its tangent stays positive.  Linearized for a normal drift, the stiffness is
    k + E[d phi(d)] / s_d^2, which is k + 3 k3 s_d^2 where the story hardens.
    """

    name = "cubic_stiffness"
    family = "structure"
    places = ("story",)
    parameters = (Parameter("k3_n_per_m3", -inf, inf, absent=0.0),)
    signature = "frequencies rise (fall) with the level, damping does not, the drift is not skewed"
    noun = "a cubic spring"
    separating_measurement = (
        "record at a vibration level two or three times as high, with a displacement sensor across the story"
    )
    conditional = True
    nonlinear = True
    amplitude_powers = (2.0,)
    daily = (0.2,)  # a persistent one is estimated by few simulations
    # Fits from different starts end that far apart, where the levels compensate for the difference.
    form_uncertainty = (0.1,)

    k3_n_per_m3: float

    @override
    def extend(self, system: System, context: Context, condition: Condition) -> System:
        s, half_force = (
            float(condition.drift_m[self.index(context.structure)]),
            self._half_force_drift_m(context.structure),
        )
        fourth = float(_WEIGHTS @ (_NODES**4 / (1.0 + (s * _NODES / half_force) ** 4)))
        return system.plus(stiffness=self.k3_n_per_m3 * s**2 * fourth * self.pattern(context.structure))

    @override
    def laws(self, structure: Structure) -> tuple[Law, ...]:
        return (Law(LawKind.CUBIC, self.direction(structure), (self.k3_n_per_m3, self._half_force_drift_m(structure))),)

    @property
    @override
    def is_softening(self) -> bool:
        return self.k3_n_per_m3 < 0.0

    def form_std_in(self, fitted: FittedModel) -> Array:
        """The law of softening beyond the third order is not known.

        With a fifth order like that of tanh, a size would differ by twice the relative softening.
        """
        if not self.is_softening:
            return self.form_std
        size = np.abs(self.coordinates)
        j = self.index(fitted.structure)
        drift, stiffness = fitted.condition.drift_m[j], fitted.structure.stiffness_n_per_m[j]
        return np.asarray(np.hypot(self.form_std, size * 3.0 * size * drift**2 / stiffness))

    def _half_force_drift_m(self, structure: Structure) -> float:
        """Compute the drift at which the factor on the cubic force is one half, m."""
        if self.k3_n_per_m3 >= 0.0:
            return 1e30
        return sqrt(float(structure.stiffness_n_per_m[self.index(structure)]) / -self.k3_n_per_m3)

    @classmethod
    @override
    def starts(cls, location: str, context: Context, condition: Condition) -> tuple[Self, ...]:
        j = place_index(location, context.structure)
        k, s = float(context.structure.stiffness_n_per_m[j]), float(condition.drift_m[j])
        return tuple(cls(location, size * k / (3.0 * s**2)) for size in (0.03, 0.1, -0.03, -0.08))

    @classmethod
    @override
    def law_families(cls, parameters: ParameterEstimates) -> tuple[LawFamily, ...]:
        return ("softening",) if parameters["k3_n_per_m3"]["value"] < 0 else ("hardening",)

    @classmethod
    @override
    def sentence(cls, fitted: FittedSizes) -> str:
        trend = "softens" if fitted.value("k3_n_per_m3") < 0 else "hardens"
        size = f": cubic stiffness {fitted.interval('k3_n_per_m3')}"
        return f"{fitted.location} {trend} as its drift grows{fitted.sized('k3_n_per_m3', size)}"
