"""An acquisition whose clock runs wrong."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal, Self

from monitor.model.effects.base import Condition, Context, Effect
from monitor.model.effects.parameter import Parameter


@dataclass(frozen=True)
class ClockRate(Effect):
    """Samples are taken at nominal rate x (1 + relative) and called nominal."""

    name: ClassVar[str] = "clock_rate"
    family: ClassVar[Literal["structure", "excitation", "sensor"]] = "sensor"
    places: ClassVar[tuple[str, ...]] = ("frame",)
    parameters: ClassVar[tuple[Parameter, ...]] = (Parameter("relative", -0.5, 1.0, absent=0.0),)
    signature: ClassVar[str] = "every frequency by the same factor, shapes and damping ratios untouched"

    relative: float

    @property
    def clock_factor(self) -> float:
        """See `Effect.clock_factor`."""
        return 1.0 + self.relative

    @classmethod
    def starts(cls, location: str, context: Context, condition: Condition) -> tuple[Self, ...]:
        """See `Effect.starts`."""
        return tuple(cls(location, r) for r in (1e-3, 6e-3, -6e-3, 1.5e-2, -1.5e-2))
