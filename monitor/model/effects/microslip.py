"""Microslip: a joint of which more and more slips as it moves more, so that stiffness and damping follow a power of the drift."""

from __future__ import annotations

from dataclasses import dataclass
from math import gamma, inf, pi, sqrt
from typing import ClassVar, Literal, Self

from monitor.model.effects.base import Condition, Context, Effect, Law, LawKind, System
from monitor.model.effects.parameter import Parameter
from monitor.model.effects.report_face import FittedSizes, LawFamily, ParameterEstimates
from monitor.model.structures import Structure


@dataclass(frozen=True)
class Microslip(Effect):
    """Microslip: story force ``k d (1 - r (d / 1 mm)^e)`` at first loading, and after each reversal by Masing's rule.

    The element is that of Iwan: springs with sliders in parallel, of which a share slips at any drift, so that the loss of
    stiffness grows as the drift to the exponent e, and the energy dissipated in a cycle as the drift to the power 2 + e.  It has
    no drift at which all slips.  On the frame all stories lose the same share at the same drift.  The element is linearized as
    the mean over the amplitudes of a narrow-band drift (Rayleigh's distribution, weighted by the squared amplitude) of the
    secant stiffness of its steady cycles and of the energy that they dissipate.

    References
    ----------
    W. D. Iwan, A distributed-element model for hysteresis and its steady-state dynamic response, Journal of Applied Mechanics 33
    (1966) 893; D. J. Segalman, A four-parameter Iwan model for lap-type joints, Journal of Applied Mechanics 72 (2005) 752.
    """

    name: ClassVar[str] = "microslip"
    family: ClassVar[Literal["structure", "excitation", "sensor"]] = "structure"
    places: ClassVar[tuple[str, ...]] = ("story", "frame")
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("relative_at_1mm", 0.0, inf, absent=0.0),
        Parameter("exponent", 0.0, 1.0),
    )
    signature: ClassVar[str] = "frequencies fall and damping rises with a power of the level, the drift is not skewed"
    noun: ClassVar[str] = "a joint of which more and more slips"
    separating_measurement: ClassVar[str] = (
        "record at vibration levels a factor of ten apart, with a measured force or ground motion"
    )
    conditional: ClassVar[bool] = True
    nonlinear: ClassVar[bool] = True
    driven_only: ClassVar[bool] = True  # as `HystereticSlip`

    relative_at_1mm: float
    """Share of the story's stiffness at small drift that is lost at a drift of 1 mm at first loading."""
    exponent: float
    """Power of the drift with which the loss grows."""

    @property
    def is_softening(self) -> bool:
        """See `Effect.is_softening`."""
        return True

    def extend(self, system: System, context: Context, condition: Condition) -> System:
        """See `Effect.extend`."""
        k, rows = context.structure.stiffness_n_per_m, context.structure.drift_matrix()
        for j in self._stories(context.structure):
            drift = float(condition.drift_m[j])
            secant, loss = self.linearized(drift)
            pattern = k[j] * rows[j][:, None] * rows[j]
            damping = loss * drift / float(condition.drift_velocity_m_s[j])
            system = system.plus(stiffness=-secant * pattern, damping=damping * pattern)
        return system

    def linearized(self, drift_m: float) -> tuple[float, float]:
        """Compute the share of the stiffness that is lost, and the loss factor, at an RMS drift.

        Examples
        --------
        >>> [round(x, 3) for x in Microslip("frame", 0.04, 0.5).linearized(0.001)]
        [0.055, 0.014]
        """
        e = self.exponent
        # Mean of the power e of the amplitude, weighted by the squared amplitude.
        lost = self.relative_at_1mm * (sqrt(2.0) * drift_m / 1e-3) ** e * gamma(2.0 + 0.5 * e)
        secant = 4.0 / pi * (2.0 * _half_angle_integral(4.0 + 2.0 * e) - _half_angle_integral(2.0 + 2.0 * e)) * lost
        return min(secant, 1.0), min(4.0 / pi * e / (2.0 + e) * lost, 1.0)

    def laws(self, structure: Structure) -> tuple[Law, ...]:
        """See `Effect.laws`."""
        k, rows = structure.stiffness_n_per_m, structure.drift_matrix()
        return tuple(
            Law(LawKind.MICROSLIP, rows[j], (float(k[j]), self.relative_at_1mm, self.exponent))
            for j in self._stories(structure)
        )

    def _stories(self, structure: Structure) -> tuple[int, ...]:
        """Return the indices of the stories whose joints slip; none without a size."""
        if self.relative_at_1mm == 0.0:
            return ()
        return tuple(range(structure.n_stories)) if self.location == "frame" else (self.index,)

    @classmethod
    def starts(cls, location: str, context: Context, condition: Condition) -> tuple[Self, ...]:
        """See `Effect.starts`."""
        j = 0 if location == "frame" else cls(location, 0.0, 0.5).index
        drift = float(condition.drift_m[j]) / 1e-3
        return tuple(cls(location, 0.03 * drift**-e, e) for e in (0.3, 0.7))

    @classmethod
    def law_families(cls, parameters: ParameterEstimates) -> tuple[LawFamily, ...]:
        """See `Effect.law_families`."""
        return ("softening", "dissipating")

    @classmethod
    def sentence(cls, fitted: FittedSizes) -> str:
        """See `Effect.sentence`."""
        share = fitted.sized("relative_at_1mm", f"{fitted.percent('relative_at_1mm')} of the stiffness", "stiffness")
        power = fitted.sized("exponent", f" {fitted.interval('exponent')}", "")
        where = "the joints of all stories" if fitted.location == "frame" else f"the joints of {fitted.location}"
        return f"{where} slip more the more they move: {share} gives way at 1 mm of drift, with the power{power} of the drift"


def _half_angle_integral(m: float) -> float:
    """Integrate ``sin(angle / 2)^m`` from 0 to pi."""
    return sqrt(pi) * gamma(0.5 * (m + 1.0)) / gamma(0.5 * m + 1.0)
