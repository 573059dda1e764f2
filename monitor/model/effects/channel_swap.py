"""Swap of two channels, as by exchanged cables."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from typing_extensions import override

from monitor.core import Array, ComplexArray
from monitor.model.effects.base import Condition, Context, Effect, EffectError, FittedSizes, Structure


@dataclass(frozen=True)
class ChannelSwap(Effect):
    """Swap of two channels: each is recorded under the other's name."""

    name = "channel_swap"
    family = "sensor"
    proportional = False
    places = ("channels",)
    parameters = ()
    signature = "two channels change places in all shapes, frequencies untouched"
    separating_measurement = "tap on one floor and see which channel answers first"

    @override
    def check(self, structure: Structure, channels: tuple[str, ...]) -> None:
        super().check(structure, channels)
        first, second = (channels.index(name) for name in self.location.partition(" ")[2].split(","))
        if first >= second:
            pair = f"channel {channels[second]},{channels[first]}" if first > second else "two different channels"
            raise EffectError(f"{self.name}: {self.location!r}: expected {pair}, in the structure file's order")

    @override
    def response(self, hz: Array, context: Context, condition: Condition) -> ComplexArray | None:
        return np.eye(len(context.channels), dtype=complex)[None, self._order(context)]

    @override
    def measure(self, samples: Array, rate_hz: float, context: Context, rng: np.random.Generator) -> Array:
        return samples[:, self._order(context)]

    def _order(self, context: Context) -> list[int]:
        """Return the channels' indices with the two swapped."""
        order = list(range(len(context.channels)))
        first, second = self.channel_indices(context)
        order[first], order[second] = second, first
        return order

    @classmethod
    @override
    def sentence(cls, fitted: FittedSizes) -> str:
        return f"channels {fitted.place_name.replace(',', ' and ')} are swapped"
