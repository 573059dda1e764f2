"""Noise of a channel beyond that of the others."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Self

import numpy as np
from typing_extensions import override

from monitor.core import Array
from monitor.model.effects.base import Condition, Context, Effect, FittedSizes, Parameter


@dataclass(frozen=True)
class SensorNoise(Effect):
    """White noise of one channel, in addition to the noise that all channels have."""

    name = "sensor_noise"
    family = "sensor"
    order = 2
    places = ("channel",)
    parameters = (Parameter("rms_m_s2", 0.0, inf, absent=0.0),)
    daily = (0.2,)  # a part of a channel's noise may follow its motion
    signature = "a raised floor between the peaks of one channel, its coherence down"
    separating_measurement = "record the sensor on a block that stands still"

    rms_m_s2: float
    """RMS of the noise at the source's rate."""

    @override
    def noise_variance(self, context: Context, condition: Condition) -> Array | float:
        variance = np.zeros(len(context.channels))
        variance[self.channel_indices(context)[0]] = self.rms_m_s2**2
        return variance

    @override
    def measure(self, samples: Array, rate_hz: float, context: Context, rng: np.random.Generator) -> Array:
        measured = samples.copy()
        measured[:, self.channel_indices(context)[0]] += self.rms_m_s2 * rng.standard_normal(len(samples))
        return measured

    @classmethod
    @override
    def starts(cls, location: str, context: Context, condition: Condition) -> tuple[Self, ...]:
        j = context.channels.index(location.partition(" ")[2])
        return (cls(location, 0.15 * float(condition.channel_m_s2[j])),)

    @classmethod
    @override
    def sentence(cls, fitted: FittedSizes) -> str:
        says = f"{fitted.location} has <>noise beyond what all channels have"
        return fitted.with_size("rms_m_s2", says, f"{fitted.interval('rms_m_s2')} RMS of", by="")
