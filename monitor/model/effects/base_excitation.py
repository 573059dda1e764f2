"""Unmeasured ground motion under the frame, as from traffic."""

from __future__ import annotations

from dataclasses import dataclass

from typing_extensions import override

from monitor.core import Array
from monitor.model.effects.base import Effect, FittedSizes, Parameter


@dataclass(frozen=True)
class BaseExcitation(Effect):
    """White, horizontal ground acceleration that acts on all floors at once, in addition to the forces on the floors."""

    name = "base_excitation"
    family = "excitation"
    places = ("base",)
    parameters = (Parameter("share", 0.0, 1.0, absent=0.0),)
    signature = "one common input: coherent channels, each with the ground's own motion in it"
    separating_measurement = "put an accelerometer on the ground"
    start_sizes = ((0.2,),)

    conditional = True
    # It is not known up to which frequency the ground's motion and the forces are white.
    form_uncertainty = (0.03,)

    share: float
    """Share of a channel's acceleration variance at the source's rate that the ground causes, mean over channels."""

    @property
    @override
    def ground_share(self) -> float:
        return self.share

    def is_plausible(self, band_hz: Array) -> bool:
        """The ground may cause all of the motion."""
        return True

    @classmethod
    @override
    def sentence(cls, fitted: FittedSizes) -> str:
        share = f": it causes {fitted.percent('share')} of the acceleration's variance"
        return f"the ground moves{fitted.sized('share', share)}"
