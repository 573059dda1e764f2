"""Stiffness that depends on the temperature."""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, inf

import numpy as np
from typing_extensions import override

from monitor.core import Array
from monitor.model.effects.base import Condition, Context, Effect, FittedSizes, Parameter, System


@dataclass(frozen=True)
class TemperatureStiffness(Effect):
    """Temperature dependence of the stiffness: every k becomes k (1 + per_degc T).

    T is the temperature above its reference after a first-order lag.  The damping does not change.
    """

    name = "temperature_stiffness"
    family = "structure"
    places = ("frame",)
    parameters = (
        Parameter("per_degc", -1.0, 1.0, absent=0.0),
        Parameter("lag_s", 0.0, inf, closed=True, least=60.0),
    )
    signature = "all frequencies by the same factor, shapes untouched, following the temperature, equal at every level"
    separating_measurement = "record the temperature along with the acceleration, through a warm and a cold spell"
    start_sizes = ((1e-3, 0.0), (1e-3, 600.0))
    conditional = True

    per_degc: float
    """Relative change of the stiffness per kelvin."""
    lag_s: float
    """Time constant of the lag; before the first reading the temperature is taken to have been constant."""

    @property
    @override
    def temperature_lag_s(self) -> float | None:
        return self.lag_s

    @override
    def extend(self, system: System, context: Context, condition: Condition) -> System:
        n = context.structure.n_stories
        return system.plus(stiffness=self.per_degc * condition.excess_degc(self.lag_s) * system.stiffness[:n, :n])

    @override
    def stiffness_factor(self, excess_degc: Array, rate_hz: float) -> Array | None:
        from scipy.signal import lfilter  # takes most of a second to load

        if self.lag_s > 0.0:
            keep = exp(-1.0 / (rate_hz * self.lag_s))
            excess_degc = lfilter([1.0 - keep], [1.0, -keep], excess_degc, zi=[keep * excess_degc[0]])[0]
        return np.asarray(1.0 + self.per_degc * excess_degc)

    @classmethod
    @override
    def sentence(cls, fitted: FittedSizes) -> str:
        trend = "loses" if fitted.value("per_degc") < 0 else "gains"
        is_late = fitted.value("lag_s") > 0 and fitted.is_sized("lag_s")
        late = f", {fitted.interval('lag_s')} late" if is_late else ""
        size = f"{fitted.percent('per_degc')} of its stiffness per K of warming{late}"
        return f"the frame {trend} {fitted.sized('per_degc', size, 'stiffness with warming, too little to be sized')}"
