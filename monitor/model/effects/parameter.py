"""Parameter of an effect: its name, its bounds, and the coordinate in which it is estimated."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Literal

import numpy as np


@dataclass(frozen=True, slots=True)
class Parameter:
    """Parameter of an effect."""

    name: str
    """Name with the unit as suffix."""
    low: float
    """Lower bound of what is physically possible; exclusive, as `high`."""
    high: float
    scale: Literal["linear", "log", "inverse"] = "linear"
    """Coordinate of estimation: the parameter itself, its logarithm, or its reciprocal."""
    absent: float | None = None
    """Value at which the effect vanishes; None where the effect vanishes at no value of this parameter."""
    closed: bool = False
    """Whether the lower bound itself is allowed."""
    least: float = 1e-9
    """Coordinate below which finite differences no longer shrink in proportion to the coordinate."""

    drawn: bool = False
    """Whether a report shows the parameter by a curve (`Effect.colour_title`) instead of a row of its table."""

    @property
    def weighty(self) -> bool:
        """Whether the parameter scales with masses and stiffnesses, whose common scale no motion shows: forces, not lengths."""
        return not {"n", "kg"}.isdisjoint(self.name.split("_"))

    def coordinate(self, value: float) -> float:
        """Convert a value to the coordinate of estimation."""
        if self.scale == "log":
            return float(np.log(value))
        return 1.0 / value if self.scale == "inverse" else value

    def value(self, coordinate: float) -> float:
        """Convert a coordinate of estimation to the value, limited to the bounds."""
        if self.scale == "log":
            coordinate = float(np.exp(min(coordinate, 300.0)))
        elif self.scale == "inverse":
            coordinate = 1.0 / coordinate if coordinate > 0 else 1e300
        low, high = self.low, self.high - 1e-9 * abs(self.high) if self.high < inf else 1e300
        if not self.closed and low > -inf:
            low = low + 1e-9 * abs(low) if low != 0.0 else 1e-300
        return min(max(float(coordinate), low), high)

    def slope(self, value: float) -> float:
        """Differentiate the value by its coordinate, at a value; finite even where the value stands for infinity."""
        if self.scale == "log":
            return value
        return min(value * value, 1e300) if self.scale == "inverse" else 1.0

    def allows(self, value: float) -> bool:
        """Check that a value is finite and within the bounds."""
        return abs(value) < inf and value < self.high and (value > self.low or (self.closed and value == self.low))

    def is_limit(self, value: float) -> bool:
        """Check if a value is one to which `value` limits: what is physically possible ends there.

        Examples
        --------
        >>> relative = Parameter("relative", -1.0, 10.0)
        >>> relative.is_limit(relative.value(-1.3)), relative.is_limit(-0.99)
        (True, False)
        """
        at_low = value == self.value(-inf) and not self.closed
        return at_low or value == self.value(inf)
