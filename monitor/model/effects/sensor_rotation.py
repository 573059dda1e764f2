"""Rotation of a box with two accelerometers about the vertical, as of one that is mounted askew."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from typing_extensions import override

from monitor.core import Array, ComplexArray
from monitor.model.effects.base import Condition, Context, Effect, EffectError, FittedSizes, Parameter, Structure

_HALF_TURN_DEG = 180.0
"""Largest rotation. [degrees; definition]"""


@dataclass(frozen=True)
class SensorRotation(Effect):
    """Rotation of a box, whose two channels are x and y at one place: its axes are turned from x towards y."""

    name = "sensor_rotation"
    family = "sensor"
    places = ("channels",)
    parameters = (Parameter("angle_deg", -_HALF_TURN_DEG, _HALF_TURN_DEG + 1e-6, absent=0.0, least=1.0),)
    signature = "each of two channels of a box shows what the other should, in all shapes, frequencies untouched"
    separating_measurement = "look at how the box is mounted, against the building's axes"
    start_sizes = ((2.0,), (30.0,), (90.0,), (150.0,), (-30.0,), (-90.0,), (-150.0,))

    angle_deg: float

    @classmethod
    @override
    def places_in(cls, context: Context) -> tuple[str, ...]:
        return tuple(f"channel {','.join(context.channels[i] for i in sorted(box))}" for box in context.boxes)

    @override
    def check(self, structure: Structure, channels: tuple[str, ...]) -> None:
        super().check(structure, channels)
        first, second = (channels.index(name) for name in self.location.partition(" ")[2].split(","))
        if first >= second:
            raise EffectError(f"{self.name}: {self.location!r}: expected two channels in the structure file's order")

    def _turn(self, context: Context) -> Array:
        """Return the matrix from the true channels to the recorded ones; x is the first of a pair that is no box."""
        pair = self.channel_indices(context)
        x, y = next((box for box in context.boxes if set(box) == set(pair)), pair)
        c, s = np.cos(np.radians(self.angle_deg)), np.sin(np.radians(self.angle_deg))
        out = np.eye(len(context.channels))
        out[[x, x, y, y], [x, y, x, y]] = c, s, -s, c
        return out

    @override
    def response(self, hz: Array, context: Context, condition: Condition) -> ComplexArray | None:
        return self._turn(context).astype(complex)[None]

    @override
    def measure(self, samples: Array, rate_hz: float, context: Context, rng: np.random.Generator) -> Array:
        return samples @ self._turn(context).T

    @classmethod
    @override
    def sentence(cls, fitted: FittedSizes) -> str:
        says = f"the box of channels {fitted.place_name.replace(',', ' and ')} is turned <>about the vertical, from x towards y"
        return fitted.with_size("angle_deg", says, f"by {fitted.interval('angle_deg')}")
