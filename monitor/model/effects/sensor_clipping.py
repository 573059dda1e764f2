"""Clipping of a sensor whose range is too small."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import erf, erfc, exp, inf, pi, sqrt
from typing import Self

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from monitor.core import Array, ComplexArray
from monitor.model.effects.base import Condition, Context, Effect, FittedSizes, Parameter
from monitor.model.effects.sensor_gain import on_channel

_NO_CLIPPING = 10.0
"""Limit over RMS that is never reached. [ratio; definition: beyond ten standard deviations]"""
_ONLY_SIGN_LEFT = 0.05
"""Least limit over RMS: all that is left of the signal is its sign. [ratio; judgement]"""


_PILE_STD = 1e-4
"""Relative standard deviation of the limit where samples pile up at it. [ratio; resolution of the samples]"""
_PEAK_FACTOR = 4.5
"""RMS values that a signal exceeds somewhere in a recording if nothing stops it. [ratio; normal distribution: the peak
of some 100 000 samples]"""


@dataclass(frozen=True)
class SensorClipping(Effect):
    """Clipping of a channel's samples at +-limit_m_s2.

    The law is linearized by Bussgang's theorem for a normal signal of RMS s: a gain erf(a / sqrt(2)), a = limit / s, and a
    distortion that makes up the rest of the clipped signal's variance.  The distortion is uncorrelated with the signal and taken
    to be white.  The RMS of the clipped samples is known; s follows from it.
    """

    name = "sensor_clipping"
    family = "sensor"
    proportional = False
    places = ("channel",)
    parameters = (Parameter("limit_m_s2", 0.0, inf, "inverse", inf),)
    signature = "one channel with flat tops, its kurtosis below 3"
    separating_measurement = "set the sensor to a wider range and record again"
    conditional = True
    nonlinear = True
    stationary_only = True

    limit_m_s2: float

    @override
    def response(self, hz: Array, context: Context, condition: Condition) -> ComplexArray | None:
        j = self.channel_indices(context)[0]
        return on_channel(erf(self._limit(condition, j) / sqrt(2.0)), j, context)

    @override
    def noise_variance(self, context: Context, condition: Condition) -> Array | float:
        j = self.channel_indices(context)[0]
        a = self._limit(condition, j)
        distortion = clipped_power(a) - erf(a / sqrt(2.0)) ** 2
        variance = np.zeros(len(context.channels))
        variance[j] = max(distortion, 0.0) * condition.channel_m_s2[j] ** 2 / clipped_power(a)
        return variance

    @override
    def measure(self, samples: Array, rate_hz: float, context: Context, rng: np.random.Generator) -> Array:
        j = self.channel_indices(context)[0]
        measured = samples.copy()
        measured[:, j] = np.clip(measured[:, j], -self.limit_m_s2, self.limit_m_s2)
        return measured

    def _limit(self, condition: Condition, channel: int) -> float:
        """Compute the limit over the unclipped signal's RMS."""
        return _limit_over_unclipped_rms(self.limit_m_s2 / float(condition.channel_m_s2[channel]))

    @classmethod
    @override
    def starts(cls, location: str, context: Context, condition: Condition) -> tuple[Self, ...]:
        j = context.channels.index(location.partition(" ")[2])
        rms, peak = float(condition.channel_m_s2[j]), _channel_value(condition.channel_peak_m_s2, j)
        if _channel_value(condition.channel_piled, j):
            return (cls(location, peak),)
        if peak > _PEAK_FACTOR * rms:
            return (cls(location, 2.0 * rms),) if peak == inf else ()
        return (cls(location, 0.8 * peak), cls(location, 0.999 * peak))

    def known(self, context: Context, condition: Condition) -> tuple[Array, Array]:
        """Where many samples share the largest magnitude, that magnitude is the limit."""
        j = self.channel_indices(context)[0]
        if not _channel_value(condition.channel_piled, j):
            return self.coordinates, np.zeros(1)
        peak = _channel_value(condition.channel_peak_m_s2, j)
        return np.array([1.0 / peak]), np.array([(peak / _PILE_STD) ** 2])

    @classmethod
    @override
    def sentence(cls, fitted: FittedSizes) -> str:
        limit = fitted.sized("limit_m_s2", f" at ± {fitted.interval('limit_m_s2')}", "")
        return f"{fitted.location} is cut off{limit}"


def _channel_value(values: Array | NDArray[np.bool_], channel: int) -> float:
    """Return a channel's value; a condition without values by channel has one for all channels."""
    return float(values[min(channel, values.size - 1)])


@lru_cache(maxsize=256)  # every spectrum needs the same values again
def _limit_over_unclipped_rms(ratio: float) -> float:
    """Compute the limit over the unclipped signal's RMS from the limit over the clipped signal's RMS."""
    if ratio >= _NO_CLIPPING:
        return _NO_CLIPPING
    low, high = 0.0, ratio  # a / sqrt(power) falls with a to 1, where all samples are clipped
    for _ in range(50):
        a = 0.5 * (low + high)
        low, high = (a, high) if a < ratio * sqrt(clipped_power(a)) else (low, a)
    return max(high, _ONLY_SIGN_LEFT)


def clipped_power(a: float) -> float:
    """Compute the variance of a unit normal variable clipped at +-a."""
    power = erf(a / sqrt(2.0)) - sqrt(2.0 / pi) * a * exp(-0.5 * a**2) + a**2 * erfc(a / sqrt(2.0))
    return max(power, 0.0)  # rounding, where nearly no power is left
