"""Mode of the structure that its model does not have: torsion, the other direction, or a part that the drawing leaves out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf, isfinite
from typing import ClassVar, Literal, Self

import numpy as np

from monitor.core import Array
from monitor.model.effects.base import Condition, Context, Effect, EffectError, ExtraMode, Peak
from monitor.model.effects.parameter import Parameter
from monitor.model.effects.report_face import FittedSizes
from monitor.model.structures import Structure

_MODE_DAMPING_LN_STD = 0.8
"""Standard deviation of the logarithm of the mode's damping ratio about the structure's. [1; judgement: a factor of two, as
of an attached oscillator]"""
_BEYOND_BAND = 1.0 / 0.9
"""Highest frequency of a mode, over the band's end. [ratio; the lowpass's cutoff, of which the band ends at 0.9: the foot of a
peak beyond the band lies in it]"""
_MAX_MODE_DAMPING = 0.15
"""Damping ratio from which a peak is no mode of a structure. [1; as of the poles that identification accepts as modes]"""
_DAILY_FREQUENCY = 0.02
"""Relative change of the mode's frequency from calibration that needs no cause. [ratio; judgement: a loss that the model
describes moves this mode too, by up to half the lost share of a story's stiffness]"""
_DAILY_DAMPING = 0.3
"""The same of its damping ratio. [ratio; judgement]"""
_SHAPE = "shape_"
_START = 0.1
"""Start of the shape's largest component, over the reciprocal of the mean floor mass. [ratio; judgement]"""


@dataclass(frozen=True)
class UnmodelledMode(Effect):
    """Mode of the structure beside those of the model, driven by forces of its own.

    The channels move by ``shape h(f) g`` in addition to the model's motion, where h is the accelerance of an oscillator of one
    kilogram and g a random force of the floors' mean force density.
    """

    name: ClassVar[str] = "unmodelled_mode"
    family: ClassVar[Literal["structure", "excitation", "sensor"]] = "structure"
    order: ClassVar[int] = 2
    is_narrow: ClassVar[bool] = True
    repeatable: ClassVar[bool] = True
    stationary_only: ClassVar[bool] = True
    places: ClassVar[tuple[str, ...]] = ("frame",)
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("frequency_hz", 0.0, inf, "log"),
        Parameter("damping_ratio", 0.0, 1.0, "log"),
    )
    """Parameters of the class; an instance adds one for every channel, `shape_1` and so on."""
    signature: ClassVar[str] = (
        "one peak more, as wide as the structure's own, of another shape, with normal kurtosis; the model's modes stay"
    )
    separating_measurement: ClassVar[str] = (
        "put an accelerometer across the measured direction, and two at opposite edges of a floor"
    )

    frequency_hz: float
    damping_ratio: float
    shape: tuple[float, ...] = ()
    """Acceleration of every channel by a unit force on the mode, 1/kg; empty: alike on all channels, over the total mass."""

    def __post_init__(self) -> None:
        """Add a parameter for each channel to those of the class, and its change from day to day."""
        of_channels = tuple(Parameter(f"{_SHAPE}{i + 1}", -inf, inf, absent=0.0) for i in range(len(self.shape)))
        object.__setattr__(self, "parameters", (*type(self).parameters, *of_channels))
        # The forces on the mode, which scale the shape, change from day to day.
        object.__setattr__(self, "daily", (_DAILY_FREQUENCY, _DAILY_DAMPING, *(1.0,) * len(self.shape)))

    @classmethod
    def create(cls, location: str, parameters: Mapping[str, float]) -> Effect:
        """See `Effect.create`.  The shape, `shape_1` and so on, may be left out."""
        shape = {name: value for name, value in parameters.items() if name.startswith(_SHAPE)}
        wanted = {f"{_SHAPE}{i + 1}" for i in range(len(shape))}
        if set(shape) != wanted:
            raise EffectError(f"{cls.name}: needs {', '.join(sorted(wanted))}, one for every channel")
        for name, value in shape.items():
            if not isfinite(value):
                raise EffectError(f"{cls.name}: {name} = {value:g} must be finite")
        bare = super().create(location, {name: value for name, value in parameters.items() if name not in shape})
        return cls(location, **bare.values(), shape=tuple(shape[f"{_SHAPE}{i + 1}"] for i in range(len(shape))))

    def values(self) -> dict[str, float]:
        """See `Effect.values`."""
        own = {"frequency_hz": self.frequency_hz, "damping_ratio": self.damping_ratio}
        return own | {f"{_SHAPE}{i + 1}": component for i, component in enumerate(self.shape)}

    @property
    def units(self) -> Array:
        """See `Effect.units`.  All components of the shape have the unit of the largest."""
        out = np.ones(len(self.parameters))
        out[2:] = max(np.abs(self.shape), default=1.0) or 1.0
        return out

    def at(self, coordinates: Array) -> Self:
        """See `Effect.at`."""
        hz, ratio, *shape = (p.value(float(x)) for p, x in zip(self.parameters, coordinates, strict=True))
        return replace(self, frequency_hz=hz, damping_ratio=ratio, shape=tuple(shape))

    def extra_modes(self, context: Context) -> tuple[ExtraMode, ...]:
        """See `Effect.extra_modes`."""
        return (ExtraMode(self.frequency_hz, self.damping_ratio, self._shape_on(context)),)

    def _shape_on(self, context: Context) -> Array:
        """Return the shape on the channels, shape (c,), 1/kg."""
        if self.shape:
            return np.array(self.shape)
        return np.full(len(context.channels), 1.0 / float(context.structure.masses_kg.sum()))

    def check(self, structure: Structure, channels: tuple[str, ...]) -> None:
        """See `Effect.check`."""
        super().check(structure, channels)
        if self.shape and len(self.shape) != len(channels):
            raise EffectError(f"{self.name}: {len(self.shape)} components of the shape for {len(channels)} channels")

    def known(self, context: Context, condition: Condition) -> tuple[Array, Array]:
        """See `Effect.known`.  The damping ratio is that of the structure, within a factor of two."""
        mean, precision = self.coordinates, np.zeros(len(self.parameters))
        mean[1], precision[1] = np.log(context.structure.damping_ratio), _MODE_DAMPING_LN_STD**-2
        return mean, precision

    def is_plausible(self, band_hz: Array) -> bool:
        """See `Effect.is_plausible`.  The peak reaches into the band, and the damping ratio is below the limit."""
        in_band = band_hz[0] <= self.frequency_hz <= _BEYOND_BAND * band_hz[-1]
        return bool(in_band and self.damping_ratio < _MAX_MODE_DAMPING)

    @classmethod
    def at_peak(cls, location: str, peak: Peak, context: Context, condition: Condition) -> Self:
        """See `Effect.at_peak`."""
        largest = _START / float(context.structure.masses_kg.mean())
        shape = largest * peak.amplitude / np.abs(peak.amplitude).max()
        return cls(location, peak.hz, context.structure.damping_ratio, tuple(shape.tolist()))

    @classmethod
    def starts(cls, location: str, context: Context, condition: Condition) -> tuple[Self, ...]:
        """See `Effect.starts`.  Only a peak of the recording's spectra tells a shape to start from."""
        return ()

    @classmethod
    def sentence(cls, fitted: FittedSizes) -> str:
        """See `Effect.sentence`."""
        damping = fitted.sized("damping_ratio", f" with {fitted.percent('damping_ratio')} damping", "")
        return (
            f"the structure has a mode at {fitted.interval('frequency_hz')}{damping} that the model lacks: "
            "torsion, the other direction or a local mode"
        )

    @classmethod
    def sentence_of_several(cls, fitted: Sequence[FittedSizes]) -> str:
        """See `Effect.sentence_of_several`."""
        hz = sorted(one.value("frequency_hz") for one in fitted)
        listed = ", ".join(f"{f:.4g}" for f in hz[:-1]) + f" and {hz[-1]:.4g}"
        return (
            f"the structure has modes at {listed} Hz that the model lacks: torsion, the other direction or local modes"
        )
