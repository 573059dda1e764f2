"""The sensors that a window is identified with: all of a structure's, or those that are left when some are left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Self

import numpy as np

from monitor.core import Array, ModalEstimate
from monitor.identification import sensor_correction
from monitor.model import Context, Effect


@dataclass(frozen=True, eq=False, slots=True)
class SubArray:
    """Some of the channels of a structure, in their order."""

    channels: tuple[int, ...]
    """Channels (0 = first), as measured."""
    past: tuple[int, ...]
    """Reference channels, as places in `channels`: those that are left, or else all."""
    shown: Annotated[Array, "c n"]
    """What the channels show of the floors' motion, with the stated sensor effects; shapes are matched by it."""
    places: tuple[int, ...]
    """Channels whose motion the shapes hold once the sensor effects are removed: others than `channels` where cables are
    swapped."""
    sensors: Annotated[Array, "c n"]
    """Sensor matrix of `places`."""
    n_channels: int
    """Number of all channels."""
    effects: tuple[Effect, ...] = ()
    context: Context | None = None
    """Structure and sensors on which the effects act; None without effects where there is no model."""

    @classmethod
    def plain(cls, channels: tuple[int, ...], past: Sequence[int], n_channels: int) -> Self:
        """Select some channels where nothing but the channels is known: shapes are those of all `n_channels`."""
        left = tuple(k for k, channel in enumerate(channels) if channel in past)
        sensors = np.eye(n_channels)[list(channels)]
        return cls(channels, left or tuple(range(len(channels))), sensors, channels, sensors, n_channels)

    @classmethod
    def of(
        cls,
        channels: tuple[int, ...],
        past: Sequence[int],
        sensors: Array,
        effects: tuple[Effect, ...],
        context: Context,
    ) -> Self:
        """Select some channels (0 = first) of a structure.

        `past` (all channels where it holds none of these) and `sensors` are those of the whole structure, `effects` those of
        sensors that the structure file states.
        """
        places = sensor_correction.true_channels(effects, context, channels) if effects else channels
        left = tuple(k for k, channel in enumerate(channels) if channel in past)
        shown = sensor_correction.seen_by_sensors(effects, context)
        if len(channels) < len(shown):  # else as they are: the rounding of products depends on the order in memory
            shown = shown[list(channels)]
        if places != tuple(range(len(sensors))):
            sensors = sensors[list(places)]
        n = len(context.channels)
        return cls(channels, left or tuple(range(len(channels))), shown, places, sensors, n, effects, context)

    def correct(self, modes: ModalEstimate) -> ModalEstimate:
        """Remove the stated sensor effects from modes of these channels."""
        if not self.effects or self.context is None:
            return modes
        return sensor_correction.correct_modes(modes, self.effects, self.context, self.channels, self.places)

    def spread(self, modes: ModalEstimate) -> ModalEstimate:
        """Place modes of these channels among all channels (`ModalEstimate.at_channels`)."""
        return modes.at_channels(self.places, self.n_channels)
