"""Reversed sign of a channel that is mounted or wired the wrong way round."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from typing_extensions import override

from monitor.core import Array, ComplexArray
from monitor.model.effects.base import Condition, Context, Effect, FittedSizes
from monitor.model.effects.sensor_gain import on_channel


@dataclass(frozen=True)
class SensorPolarity(Effect):
    """Reversed polarity of a channel: its samples are the true ones times -1."""

    name = "sensor_polarity"
    family = "sensor"
    proportional = False
    places = ("channel",)
    parameters = ()
    signature = "one channel upside down in all shapes, frequencies untouched"
    separating_measurement = "look at how the sensor is mounted, or tilt it and read gravity's sign"

    @override
    def response(self, hz: Array, context: Context, condition: Condition) -> ComplexArray | None:
        return on_channel(-1.0, self.channel_indices(context)[0], context)

    @override
    def measure(self, samples: Array, rate_hz: float, context: Context, rng: np.random.Generator) -> Array:
        measured = samples.copy()
        measured[:, self.channel_indices(context)[0]] *= -1.0
        return measured

    @classmethod
    @override
    def sentence(cls, fitted: FittedSizes) -> str:
        return f"{fitted.location} is upside down: its sign is reversed"
