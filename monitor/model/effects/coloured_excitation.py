"""Forces that are weaker at high frequencies, as those of wind."""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, inf, pi

import numpy as np
from typing_extensions import override

from monitor.core import Array
from monitor.model.effects.base import Effect, FittedSizes, Parameter


@dataclass(frozen=True)
class ColouredExcitation(Effect):
    """Coloured forces: the power density of the floors' forces times 1 / (1 + (f / corner_hz)^2), unchanged at 0 Hz.

    In the simulation white forces pass a first-order recursion, which is exactly the sampled Ornstein-Uhlenbeck process.
    """

    name = "coloured_excitation"
    family = "excitation"
    proportional = False
    places = ("frame",)
    parameters = (Parameter("corner_hz", 0.0, inf, "inverse", inf),)
    signature = "frequencies and shapes as they were, the whole spectrum tilted"
    separating_measurement = "record under another excitation, such as another wind or taps with a hammer"
    # A corner beyond the band bends the spectra too.
    start_sizes = ((4.0,), (8.0,), (16.0,), (32.0,))

    corner_hz: float

    @override
    def colour(self, hz: Array) -> Array | float:
        return np.asarray(1.0 / (1.0 + (hz / self.corner_hz) ** 2))

    @override
    def drive(self, forces: Array, rate_hz: float) -> Array:
        from scipy.signal import lfilter  # takes most of a second to load

        keep = exp(-2.0 * pi * self.corner_hz / rate_hz)
        return np.asarray(lfilter([1.0 - keep], [1.0, -keep], forces, axis=0))

    @classmethod
    @override
    def sentence(cls, fitted: FittedSizes) -> str:
        corner = fitted.sized("corner_hz", f"above {fitted.interval('corner_hz')}", "with the frequency")
        return f"the excitation is not white: its power falls off {corner}"
