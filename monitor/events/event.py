"""The description of an event: motion of floors and stories, frequencies, and what remains of the stiffness afterwards."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array


@dataclass(frozen=True, eq=False, slots=True)
class Spectrum:
    """Response spectrum of the base: largest motion of oscillators that the measured ground drives."""

    period_s: Annotated[Array, "n"]
    pseudo_acceleration_m_s2: Annotated[Array, "n"]
    """Squared angular frequency times the largest relative displacement, 5 % damping."""


@dataclass(frozen=True, eq=False, slots=True)
class FloorMotion:
    """Motion of one channel during an event, with the filter of ``[processing]``."""

    channel: str
    peak_m_s2: float
    """Largest absolute acceleration about its mean before the event."""
    rms_m_s2: float
    """RMS acceleration from begin to end."""
    peak_m_s: float
    """Largest velocity above the corner."""
    arias_m_s: float
    """Arias intensity, ``pi / (2 g)`` times the integral of the squared acceleration (A. Arias, 1970)."""
    cav_m_s: float
    """Cumulative absolute velocity, the integral of the absolute acceleration (EPRI, 1988)."""


@dataclass(frozen=True, eq=False, slots=True)
class Event:
    """What is known of one event.  NaN stands for what cannot be said."""

    id: str
    """UTC of the begin, which later revisions share."""
    revision: int | None
    """None for the preliminary message, 0 for the final line, 1 with the lasting loss."""
    begin_ns: int
    """UTC of the first frame above the threshold."""
    end_ns: int
    """UTC of the end of strong motion."""
    floors: tuple[FloorMotion, ...]
    """In the order of the structure's channels."""
    ground: FloorMotion | None
    """The measured ground motion; None where it was not measured."""
    spectrum: Spectrum | None
    """Of the measured ground motion."""
    instrumental_intensity: float | None
    """Modified Mercalli intensity by the peaks of the ground's one component (D. Wald et al., Earthquake Spectra 15 (1999)
    557); of one component, so unofficial."""
    corner_hz: float
    """Corner below which drifts and velocities are left out."""
    drift_m: Annotated[Array, "n"]
    """Largest dynamic drift of each story; NaN where no sensors tell."""
    drift_std_m: Annotated[Array, "n"]
    drift_ratio: Annotated[Array, "n"]
    """The drift over the story's height; NaN without heights."""
    before_hz: Annotated[Array, "m"]
    """Frequencies of the model's modes by the last windows before."""
    during_hz: Annotated[Array, "m"]
    """Frequency of the largest power of each mode's motion during the event; NaN where there is no peak."""
    after_hz: Annotated[Array, "m"]
    """The same after the event; by windows from the revision on."""
    loss: Annotated[Array, "n"]
    """Lasting relative loss of each story's stiffness, by ambient motion before and after; NaN until the revision."""
    loss_std: Annotated[Array, "n"]
    verdict: str | None
    """The site's own words for the first limit exceeded, or "no limit exceeded"; None where no limit can be judged."""
    exceeded: tuple[str, ...] = ()
    """Every limit exceeded, in words."""
    saturated: tuple[str, ...] = ()
    """Channels that reached the end of their range: their peaks are lower bounds, and the drifts made of them have no standard
    deviation."""
    cut: bool = False
    """Whether the motion began before its samples, or they end amid it: peaks and drifts are lower bounds."""
    note: str = ""
    """What limits these figures, in words."""
    drift_corner_m: Annotated[Array, "k"] = field(default_factory=lambda: np.zeros(0))
    """Largest drift of each storey of a building at the corners of its plan; empty elsewhere."""

    @property
    def is_bound(self) -> Annotated[NDArray[np.bool_], "n"]:
        """Stories whose drift is a lower bound: a channel of it reached the end of its range, or motion is missing."""
        return np.asarray(np.isfinite(self.drift_m) & np.isnan(self.drift_std_m) & (self.cut or bool(self.saturated)))
