"""Wrong calibration of a channel."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import ClassVar, Literal, Self

import numpy as np

from monitor.core import Array, ComplexArray
from monitor.model.effects.base import Condition, Context, Effect
from monitor.model.effects.parameter import Parameter
from monitor.model.effects.report_face import FittedSizes


@dataclass(frozen=True)
class SensorGain(Effect):
    """Wrong gain of a channel: its samples are the true ones times `gain`."""

    name: ClassVar[str] = "sensor_gain"
    family: ClassVar[Literal["structure", "excitation", "sensor"]] = "sensor"
    places: ClassVar[tuple[str, ...]] = ("channel",)
    parameters: ClassVar[tuple[Parameter, ...]] = (Parameter("gain", 0.0, inf, "log", 1.0),)
    signature: ClassVar[str] = "one factor on one channel in all shapes, frequencies untouched"
    separating_measurement: ClassVar[str] = (
        "put two sensors side by side on one floor, or turn the sensor over and read twice gravity"
    )

    gain: float

    def response(self, hz: Array, context: Context, condition: Condition) -> ComplexArray | None:
        """See `Effect.response`."""
        return on_channel(self.gain, self.channel_indices(context)[0], context)

    def measure(self, samples: Array, rate_hz: float, context: Context, rng: np.random.Generator) -> Array:
        """See `Effect.measure`."""
        measured = samples.copy()
        measured[:, self.channel_indices(context)[0]] *= self.gain
        return measured

    @classmethod
    def starts(cls, location: str, context: Context, condition: Condition) -> tuple[Self, ...]:
        """See `Effect.starts`."""
        return (cls(location, 1.02),)

    @classmethod
    def sentence(cls, fitted: FittedSizes) -> str:
        """See `Effect.sentence`."""
        trend = "too much" if fitted.value("gain") > 1 else "too little"
        size = fitted.sized("gain", f"{fitted.percent('gain', above=1.0)} ", "", above=1.0)
        small = fitted.sized("gain", "", ", by too little to be sized", above=1.0)
        return f"{fitted.location} reads {size}{trend}{small}"


def on_channel(factor: complex | ComplexArray, channel: int, context: Context) -> ComplexArray:
    """Build the frequency response that multiplies one channel by a factor and leaves the others unchanged.

    Parameters
    ----------
    factor : complex or ndarray, shape (n_hz,)
    channel : int
        Index of the channel.

    Returns
    -------
    ndarray, shape (n_hz or 1, c, c)
    """
    factors = np.atleast_1d(factor)
    response = np.tile(np.eye(len(context.channels), dtype=complex), (factors.size, 1, 1))
    response[:, channel, channel] = factors
    return response
