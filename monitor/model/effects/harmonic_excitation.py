"""Harmonic force on a floor, as of a machine that runs there."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Self

import numpy as np
from typing_extensions import override

from monitor.core import Array
from monitor.model.effects.base import (
    Condition,
    Context,
    Effect,
    FittedModel,
    FittedSizes,
    Line,
    Parameter,
    Peak,
    place_index,
)

_FREQUENCY_STD_BINS = 0.02
"""Standard deviation of a line's frequency as read from the taper's leakage. Another model describes the bins about a
strong line otherwise. [bins; judgement]"""


@dataclass(frozen=True)
class HarmonicExcitation(Effect):
    """Harmonic force ``force_n sin(2 pi frequency_hz t)``, t from the recording's first sample."""

    name = "harmonic_excitation"
    family = "excitation"
    order = 2
    is_narrow = True
    places = ("floor",)
    parameters = (
        Parameter("frequency_hz", 0.0, inf, "log"),
        Parameter("force_n", 0.0, inf, absent=0.0),
    )
    daily = (0.003, 1.0)
    signature = "a line at one frequency on every channel, narrower than any mode, with a narrow-band kurtosis of 1.5"
    separating_measurement = "switch off the machines nearby and record again"

    frequency_hz: float
    force_n: float
    """Amplitude of the force."""

    @override
    def lines(self) -> tuple[Line, ...]:
        return (Line(self.location, self.frequency_hz, self.force_n),)

    @override
    def form_std_in(self, fitted: FittedModel) -> Array:
        return np.array([_FREQUENCY_STD_BINS * fitted.bin_hz / self.frequency_hz, 0.0])

    @classmethod
    @override
    def at_peak(cls, location: str, peak: Peak, context: Context, condition: Condition) -> Self:
        return cls._weak(location, peak.hz, context, condition)

    @classmethod
    def _weak(cls, location: str, hz: float, context: Context, condition: Condition) -> Self:
        """Make a weak harmonic force at a frequency."""
        j = place_index(location, context.structure)
        return cls(location, hz, 0.1 * float(context.structure.inertia_kg[j] * condition.channel_m_s2.mean()))

    @classmethod
    @override
    def starts(cls, location: str, context: Context, condition: Condition) -> tuple[Self, ...]:
        grid = np.geomspace(6.0, 30.0, 8)
        return tuple(cls._weak(location, float(hz), context, condition) for hz in grid)

    @classmethod
    @override
    def sentence(cls, fitted: FittedSizes) -> str:
        force = fitted.sized("force_n", f" with {fitted.interval('force_n')}", ", too weakly to be sized")
        return f"a machine drives {fitted.location} at {fitted.interval('frequency_hz')}{force}"
