"""Ambient forces of a site, which are neither white nor independent between floors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from typing_extensions import override

from monitor.core import Array
from monitor.model.effects.base import Condition, Context, Effect, FittedSizes, Parameter

_KNOTS_HZ = 2.0 ** (0.5 * np.arange(-4, 12))
"""Frequencies between which the spectrum is interpolated: half octaves from 0.25 to 45 Hz. [Hz; judgement]"""
_ANCHOR_HZ = 8.0
"""Frequency at which the forces have the level of white ones. [Hz; judgement]"""
_SLOPE_STD = 0.7
"""Prior standard deviation of the spectrum's slope. [1; judgement: 6 dB an octave or less]"""
_COMMON_SHARE_STD = 0.3
"""Prior standard deviation of the share of the forces that floors have in common. [ratio; judgement: not most of the
force]"""


@dataclass(frozen=True)
class AmbientForces(Effect):
    """Difference of the floors' forces from white and independent ones: a smooth spectrum, and a part common to all floors.

    The logarithm of the power density is linear in that of the frequency over half octaves, and constant beyond its ends.
    The common share of each floor's power acts on all floors at once, in proportion to the root of each floor's own power.
    Calibration alone looks for this effect, since a persistent spectrum is a property of the site.  Differences on another day
    have names of their own in the catalogue.
    """

    name = "ambient_forces"
    family = "excitation"
    proportional = False
    places = ("frame",)
    parameters = (
        Parameter("common_share", 0.0, 0.99, closed=True, least=1.0),
        *(Parameter(f"rise_{i}", -50.0, 50.0, least=1.0, drawn=True) for i in range(1, _KNOTS_HZ.size)),
    )
    daily = (0.05,) + (0.1,) * (_KNOTS_HZ.size - 1)
    signature = "frequencies and shapes as they were; a smooth spectrum, and floors that are pushed together"
    colour_title = (
        f"forces on the floors at calibration: power density, 1 at {_ANCHOR_HZ:g} Hz; white ones would be level"
    )
    start_sizes = ((),)  # white and independent forces, from which a fit reaches any spectrum

    common_share: float = 0.0
    rise_1: float = 0.0
    """Logarithm of the power density at 0.35 Hz over that at 0.25 Hz; the others follow, half an octave each."""
    rise_2: float = 0.0
    rise_3: float = 0.0
    rise_4: float = 0.0
    rise_5: float = 0.0
    rise_6: float = 0.0
    rise_7: float = 0.0
    rise_8: float = 0.0
    rise_9: float = 0.0
    rise_10: float = 0.0
    rise_11: float = 0.0
    rise_12: float = 0.0
    rise_13: float = 0.0
    rise_14: float = 0.0
    rise_15: float = 0.0

    @property
    @override
    def common_force(self) -> float:
        return self.common_share

    @override
    def colour(self, hz: Array) -> Array | float:
        knots = np.log(_KNOTS_HZ)
        density = np.concatenate([[0.0], np.cumsum(self.coordinates[1:])])
        at = np.log(np.maximum(hz, 1e-9))
        return np.asarray(np.exp(np.interp(at, knots, density) - np.interp(np.log(_ANCHOR_HZ), knots, density)))

    def drive(self, forces: Array, rate_hz: float) -> Array:
        """The symmetric root of the correlation matrix mixes the floors' forces."""
        from scipy.fft import irfft, next_fast_len, rfft  # takes a third of a second to load

        count, n = forces.shape
        size = forces.std(axis=0)
        own = np.sqrt(1.0 - self.common_share)
        whole = (np.sqrt(1.0 - self.common_share + n * self.common_share) - own) / n
        alone = forces / np.where(size > 0.0, size, 1.0)
        mixed = size * (own * alone + whole * alone.sum(axis=1, keepdims=True))
        length = next_fast_len(count, real=True)
        hz = np.arange(length // 2 + 1) * (rate_hz / length)
        return np.asarray(
            irfft(rfft(mixed, n=length, axis=0) * np.sqrt(self.colour(hz))[:, None], n=length, axis=0)[:count]
        )

    @override
    def known(self, context: Context, condition: Condition) -> tuple[Array, Array]:
        std = np.full(len(self.parameters), _SLOPE_STD)
        std[0] = _COMMON_SHARE_STD
        return np.zeros(std.size), std**-2.0

    @classmethod
    @override
    def sentence(cls, fitted: FittedSizes) -> str:
        is_common = fitted.value("common_share") > 2.0 * fitted.std("common_share")
        together = f", and {fitted.percent('common_share')} of it pushes all floors at once" if is_common else ""
        return f"the excitation is not white, but of a smooth spectrum{together}"
