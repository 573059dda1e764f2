"""Contact with a stop that a story reaches only when its drift exceeds a gap."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import erfc, exp, inf, pi, sqrt
from typing import Self

from typing_extensions import override

from monitor.model.effects.base import (
    Condition,
    Context,
    Effect,
    FittedSizes,
    Law,
    LawKind,
    Parameter,
    System,
    place_index,
)
from monitor.model.structures import Structure


@dataclass(frozen=True)
class GapContact(Effect):
    """Contact with a stop: story force k d + kc (d - gap) for d beyond the gap.

    A negative gap closes for negative drift.  The law is linearized at the story's RMS drift, about the mean drift that the
    one-sided force causes (`mean_contact`).
    """

    name = "gap_contact"
    family = "structure"
    places = ("story",)
    parameters = (
        Parameter("gap_m", -inf, inf),
        Parameter("contact_stiffness_n_per_m", 0.0, inf, absent=0.0),
    )
    signature = "stiffer above a level only, the drift skewed, bursts of high frequency on two neighbours"
    noun = "a stop"
    separating_measurement = (
        "read the story's drift with a displacement sensor: a stop lets one sign go less far than the other"
    )
    families = ("hardening", "asymmetric")
    conditional = True
    nonlinear = True
    amplitude_powers = (-1.0, 0.0)
    form_uncertainty = (0.05, 0.12)  # the stiffness of a contact while it closes is not known

    gap_m: float
    """Drift at which the contact closes; negative for one that closes at negative drift."""
    contact_stiffness_n_per_m: float

    @override
    def extend(self, system: System, context: Context, condition: Condition) -> System:
        k = float(context.structure.stiffness_n_per_m[self.index(context.structure)])
        s = float(condition.drift_m[self.index(context.structure)])
        share = mean_contact(k, self.contact_stiffness_n_per_m, abs(self.gap_m) / s)
        return system.plus(stiffness=self.contact_stiffness_n_per_m * share * self.pattern(context.structure))

    @override
    def laws(self, structure: Structure) -> tuple[Law, ...]:
        parameters = (self.gap_m, self.contact_stiffness_n_per_m)
        return (Law(LawKind.CONTACT, self.direction(structure), parameters),)

    @override
    def mirrored(self) -> Effect | None:
        return replace(self, gap_m=-self.gap_m)

    @classmethod
    @override
    def starts(cls, location: str, context: Context, condition: Condition) -> tuple[Self, ...]:
        j = place_index(location, context.structure)
        k, s = float(context.structure.stiffness_n_per_m[j]), float(condition.drift_m[j])
        return tuple(cls(location, gap * s, 0.5 * k) for gap in (1.2, 1.7, 2.2, -1.2, -1.7, -2.2))

    @classmethod
    @override
    def sentence(cls, fitted: FittedSizes) -> str:
        sign = "positive" if fitted.value("gap_m") > 0 else "negative"
        gap = fitted.sized("gap_m", f"after {fitted.magnitude('gap_m', 1e3, 'mm')} of {sign}", f"at some {sign}")
        worth = f", worth {fitted.interval('contact_stiffness_n_per_m')}"
        worth = fitted.sized("contact_stiffness_n_per_m", worth, ", too soft to be sized")
        return f"{fitted.location} meets a stop {gap} drift{worth}"


def mean_contact(stiffness: float, contact: float, gap: float) -> float:
    """Compute the share of time that a normal drift of unit RMS about its own mean spends beyond a gap.

    `contact` is the stiffness added beyond the gap, negative where it is lost there; `gap` is over the RMS drift.  The mean force
    at the mean drift m is zero: ``k m + kc E[(m + z - gap)+] = 0``, solved by Newton's method (the left side is monotonic and
    convex or concave).
    """
    mean = 0.0
    for _ in range(12):
        a = gap - mean
        beyond = 0.5 * erfc(a / sqrt(2.0))
        overlap = exp(-0.5 * a**2) / sqrt(2.0 * pi) - a * beyond
        mean -= (stiffness * mean + contact * overlap) / (stiffness + contact * beyond)
    return 0.5 * erfc((gap - mean) / sqrt(2.0))
