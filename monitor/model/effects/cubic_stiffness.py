"""Cubic stiffness: a story that hardens or softens with its drift."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import ClassVar, Literal, Self

import numpy as np

from monitor.core import Array
from monitor.model.effects.base import Condition, Context, Effect, FittedModel, Law, LawKind, System
from monitor.model.effects.parameter import Parameter
from monitor.model.effects.report_face import FittedSizes, LawFamily, ParameterEstimates
from monitor.model.structures import Structure

_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(40)
_WEIGHTS /= _WEIGHTS.sum()
"""Gauss-Hermite nodes and weights of the mean over a standard normal variable."""
_NO_LIMIT_M = 1e30
"""Stands for the drift at which the force of a spring that hardens would fade. [m; definition: never]"""


@dataclass(frozen=True, eq=False, slots=True)
class CubicSpring:
    """Cubic spring of a story."""

    story: int
    """Index of the story, from 0."""
    direction: Array
    """Row that picks the story's drift out of the floors' motion, shape (n,)."""
    k3_n_per_m3: float
    half_force_m: float
    """Drift at which the factor on the cubic force is one half, m."""


@dataclass(frozen=True)
class CubicStiffness(Effect):
    """Cubic stiffness: story force k d + k3 d^3.

    On the frame k3 is the same share of k in every story, as where all stories are built alike; k3 is then the mean over stories.
    A softening cubic would be unstable at large drift.  Its force is therefore multiplied by 1 / (1 + (d / q)^4), q^2 = k / |k3|:
    the law is the cubic up to the sixth order, and its tangent stays positive.  Linearized for a normal drift, the stiffness is
    k + E[d phi(d)] / s_d^2, which is k + 3 k3 s_d^2 where the story hardens.
    """

    name: ClassVar[str] = "cubic_stiffness"
    family: ClassVar[Literal["structure", "excitation", "sensor"]] = "structure"
    places: ClassVar[tuple[str, ...]] = ("story", "frame")
    parameters: ClassVar[tuple[Parameter, ...]] = (Parameter("k3_n_per_m3", -inf, inf, absent=0.0),)
    signature: ClassVar[str] = "frequencies rise (fall) with the level, damping does not, the drift is not skewed"
    noun: ClassVar[str] = "a cubic spring"
    separating_measurement: ClassVar[str] = (
        "record at a vibration level two or three times as high, with a displacement sensor across the story"
    )
    conditional: ClassVar[bool] = True
    nonlinear: ClassVar[bool] = True
    # Without a measured input the levels alone tell a law, one story's from all stories' by little.
    driven_places: ClassVar[tuple[str, ...]] = ("frame",)
    amplitude_powers: ClassVar[tuple[float, ...]] = (2.0,)
    daily: ClassVar[tuple[float, ...]] = (0.2,)  # a persistent one is estimated by few simulations
    # Fits from different starts end that far apart, where the levels compensate for the difference.
    form_uncertainty: ClassVar[tuple[float, ...]] = (0.1,)

    k3_n_per_m3: float

    def extend(self, system: System, context: Context, condition: Condition) -> System:
        """See `Effect.extend`."""
        for spring in self.springs(context.structure):
            s = float(condition.drift_m[spring.story])
            fourth = float(_WEIGHTS @ (_NODES**4 / (1.0 + (s * _NODES / spring.half_force_m) ** 4)))
            pattern = np.outer(spring.direction, spring.direction)
            system = system.plus(stiffness=spring.k3_n_per_m3 * s**2 * fourth * pattern)
        return system

    def laws(self, structure: Structure) -> tuple[Law, ...]:
        """See `Effect.laws`."""
        return tuple(Law(LawKind.CUBIC, s.direction, (s.k3_n_per_m3, s.half_force_m)) for s in self.springs(structure))

    def springs(self, structure: Structure) -> tuple[CubicSpring, ...]:
        """Return the springs: that of the story, or one in each story of the frame."""
        stories, k, rows = self._stories(structure), structure.stiffness_n_per_m, structure.drift_matrix()
        k3 = self.k3_n_per_m3 * k[stories] / k[stories].mean()
        half = np.sqrt(k[stories] / -k3) if self.is_softening else np.full(len(stories), _NO_LIMIT_M)
        return tuple(CubicSpring(j, rows[j], float(a), float(b)) for j, a, b in zip(stories, k3, half, strict=True))

    @property
    def is_softening(self) -> bool:
        """See `Effect.is_softening`."""
        return self.k3_n_per_m3 < 0.0

    def form_std_in(self, fitted: FittedModel) -> Array:
        """See `Effect.form_std_in`.

        The law of softening beyond the third order is not known.  With a fifth order like that of tanh, a size would differ by
        twice the relative softening.
        """
        if not self.is_softening:
            return self.form_std
        size = np.abs(self.coordinates)
        stories = self._stories(fitted.structure)
        softening = (
            3.0
            * size
            * (fitted.condition.drift_m[stories] ** 2).max()
            / fitted.structure.stiffness_n_per_m[stories].mean()
        )
        return np.asarray(np.hypot(self.form_std, size * softening))

    def _stories(self, structure: Structure) -> list[int]:
        return list(range(structure.n_stories)) if self.location == "frame" else [self.index]

    @classmethod
    def starts(cls, location: str, context: Context, condition: Condition) -> tuple[Self, ...]:
        """See `Effect.starts`.  On the frame of one story there are none: that is the story's own law."""
        if location == "frame" and context.structure.n_stories == 1:
            return ()
        stories = cls(location, 0.0)._stories(context.structure)
        k, s = float(context.structure.stiffness_n_per_m[stories].mean()), float(condition.drift_m[stories].mean())
        return tuple(cls(location, size * k / (3.0 * s**2)) for size in (0.03, 0.1, -0.03, -0.08))

    @classmethod
    def law_families(cls, parameters: ParameterEstimates) -> tuple[LawFamily, ...]:
        """See `Effect.law_families`."""
        return ("softening",) if parameters["k3_n_per_m3"]["value"] < 0 else ("hardening",)

    @classmethod
    def sentence(cls, fitted: FittedSizes) -> str:
        """See `Effect.sentence`."""
        trend = "soften" if fitted.value("k3_n_per_m3") < 0 else "harden"
        size = f": cubic stiffness {fitted.interval('k3_n_per_m3')}"
        subject, ending = (
            ("all stories", "as their drifts grow")
            if fitted.location == "frame"
            else (fitted.location, "as its drift grows")
        )
        verb = trend if fitted.location == "frame" else f"{trend}s"
        return f"{subject} {verb} {ending}{fitted.sized('k3_n_per_m3', size)}"
