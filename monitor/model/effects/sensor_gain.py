"""Wrong calibration of a channel."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Annotated

import numpy as np
from typing_extensions import override

from monitor.core import Array, ComplexArray
from monitor.model.effects.base import Condition, Context, Effect, FittedSizes, Parameter


@dataclass(frozen=True)
class SensorGain(Effect):
    """Wrong gain of a channel: its samples are the true ones times `gain`."""

    name = "sensor_gain"
    family = "sensor"
    places = ("channel",)
    parameters = (Parameter("gain", 0.0, inf, "log", 1.0),)
    signature = "one factor on one channel in all shapes, frequencies untouched"
    separating_measurement = "put two sensors side by side on one floor, or turn the sensor over and read twice gravity"
    start_sizes = ((1.02,),)

    gain: float

    @override
    def response(self, hz: Array, context: Context, condition: Condition) -> ComplexArray | None:
        return on_channel(self.gain, self.channel_indices(context)[0], context)

    @override
    def measure(self, samples: Array, rate_hz: float, context: Context, rng: np.random.Generator) -> Array:
        measured = samples.copy()
        measured[:, self.channel_indices(context)[0]] *= self.gain
        return measured

    @classmethod
    @override
    def sentence(cls, fitted: FittedSizes) -> str:
        trend = "too much" if fitted.value("gain") > 1 else "too little"
        says = f"{fitted.location} reads <>{trend}"
        return fitted.with_size("gain", says, fitted.percent("gain", above=1.0), above=1.0)


def on_channel(factor: complex | ComplexArray, channel: int, context: Context) -> Annotated[ComplexArray, "hz c c"]:
    """Build the frequency response that multiplies one channel by a factor (one, or one a frequency) and no other."""
    factors = np.atleast_1d(factor)
    response = np.tile(np.eye(len(context.channels), dtype=complex), (factors.size, 1, 1))
    response[:, channel, channel] = factors
    return response
