"""Oscillator on a floor, such as something that hangs or stands there on a spring."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, pi
from typing import Self

import numpy as np
from typing_extensions import override

from monitor.core import Array
from monitor.model.effects.base import Condition, Context, Effect, FittedSizes, Parameter, Peak, System, place_index

_OSCILLATOR_DAMPING = 0.03
"""Damping ratio that is expected of what swings on a floor. [1; judgement: a few percent]"""
_START_MASS = 0.03
"""Start of the mass, over that of the floor. [ratio; judgement: what is hung on a floor is much lighter]"""
_LN_DAMPING_STD = 0.8
"""Standard deviation of the logarithm of that ratio. [1; judgement: a factor of two]"""
_MAX_OSCILLATOR_DAMPING = 0.5
"""Damping ratio from which a mass no longer swings by itself: a heavy one that hardly moves imitates a damper. [1;
judgement]"""


@dataclass(frozen=True)
class AttachedOscillator(Effect):
    """Mass on a spring and a damper on a floor, appended to the system as one more degree of freedom."""

    name = "attached_oscillator"
    family = "structure"
    places = ("floor",)
    parameters = (
        Parameter("mass_kg", 0.0, inf, absent=0.0),
        Parameter("frequency_hz", 0.0, inf, "log"),
        Parameter("damping_ratio", 0.0, 1.0, "log"),
    )
    signature = "one pole more, near a mode as two peaks in one place of the spectrum, with normal kurtosis"
    separating_measurement = "put an accelerometer on what hangs on the floor, or hold it and record again"

    mass_kg: float
    frequency_hz: float
    """Natural frequency on a fixed floor."""
    damping_ratio: float

    @override
    def extend(self, system: System, context: Context, condition: Condition) -> System:
        if self.mass_kg == 0.0:
            return system
        size = system.mass.shape[0]
        link = np.zeros(size + 1)
        j = self.index(context.structure)
        link[j], link[size] = -1.0, 1.0
        joint = np.outer(link, link)
        omega = 2.0 * pi * self.frequency_hz
        larger = system.enlarged(system.ground[j])
        larger.mass[size, size] = self.mass_kg
        larger.damping[:] += 2.0 * self.damping_ratio * omega * self.mass_kg * joint
        larger.stiffness[:] += omega**2 * self.mass_kg * joint
        return larger

    def known(self, context: Context, condition: Condition) -> tuple[Array, Array]:
        """The damping ratio is a few percent, within a factor of two."""
        mean = self.coordinates
        mean[2] = np.log(_OSCILLATOR_DAMPING)
        return mean, np.array([0.0, 0.0, _LN_DAMPING_STD**-2])

    def is_plausible(self, band_hz: Array) -> bool:
        """The natural frequency lies in the band, and the damping ratio is below the limit."""
        return bool(band_hz[0] <= self.frequency_hz <= band_hz[-1] and self.damping_ratio < _MAX_OSCILLATOR_DAMPING)

    @classmethod
    @override
    def starts(cls, location: str, context: Context, condition: Condition) -> tuple[Self, ...]:
        mass = _mass(location, context)
        return tuple(cls(location, mass, float(hz), _OSCILLATOR_DAMPING) for hz in np.geomspace(6.0, 25.0, 16))

    @classmethod
    @override
    def at_peak(cls, location: str, peak: Peak, context: Context, condition: Condition) -> Self:
        mass = _mass(location, context)
        return cls(location, mass, peak.hz, _OSCILLATOR_DAMPING)

    @classmethod
    @override
    def sentence(cls, fitted: FittedSizes) -> str:
        mass = f" of {fitted.interval('mass_kg')}{fitted.share_of_floor_mass('mass_kg')}"
        mass = fitted.sized("mass_kg", mass, "")
        damping = fitted.sized("damping_ratio", f" with {fitted.percent('damping_ratio')} damping", "")
        light = fitted.sized("mass_kg", "", ", too light to be sized")
        return f"something{mass} on {fitted.location} swings by itself at {fitted.interval('frequency_hz')}{damping}{light}"


def _mass(location: str, context: Context) -> float:
    """Return the mass with which a fit starts, kg."""
    return _START_MASS * float(context.structure.inertia_kg[place_index(location, context.structure)])
