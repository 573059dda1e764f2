"""Time offset of a channel."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, pi

import numpy as np
from typing_extensions import override

from monitor.core import Array, ComplexArray
from monitor.model.effects.base import Condition, Context, Effect, FittedSizes, Parameter
from monitor.model.effects.sensor_gain import on_channel

_PAD_N = 1024
"""Zeros in which what is delayed beyond the end dies away instead of coming round to the start. [samples; judgement]"""


@dataclass(frozen=True)
class TimeOffset(Effect):
    """Delay of a channel: each sample is the motion of `seconds` before, a band-limited fractional delay."""

    name = "time_offset"
    family = "sensor"
    places = ("channel",)
    parameters = (Parameter("seconds", -1.0, 1.0, absent=0.0),)
    signature = "the phase of one channel falls in proportion to the frequency"
    separating_measurement = "give all channels one pulse at once, or put two sensors side by side"
    start_sizes = ((0.5e-3,), (1.5e-3,), (-1.5e-3,), (3e-3,), (-3e-3,), (4.5e-3,), (-4.5e-3,))

    seconds: float

    @override
    def response(self, hz: Array, context: Context, condition: Condition) -> ComplexArray | None:
        return on_channel(np.exp(-2j * pi * hz * self.seconds), self.channel_indices(context)[0], context)

    @override
    def measure(self, samples: Array, rate_hz: float, context: Context, rng: np.random.Generator) -> Array:
        if self.seconds == 0.0:
            return samples
        from scipy.fft import irfft, next_fast_len, rfft, rfftfreq  # takes a third of a second to load

        j, n = self.channel_indices(context)[0], len(samples)
        padded = next_fast_len(n + ceil(self.seconds * rate_hz) + _PAD_N, real=True)
        delay = np.exp(-2j * pi * rfftfreq(padded, 1.0 / rate_hz) * self.seconds)
        measured = samples.copy()
        measured[:, j] = irfft(rfft(samples[:, j], padded) * delay, padded)[:n]
        return measured

    @classmethod
    @override
    def sentence(cls, fitted: FittedSizes) -> str:
        trend = "late" if fitted.value("seconds") > 0 else "early"
        return fitted.with_size("seconds", f"{fitted.location} comes <>{trend}", fitted.magnitude("seconds", 1e3, "ms"))
