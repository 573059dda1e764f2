"""What the site's files say that the description of events needs."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from monitor.core import Array
from monitor.events.settings import EventSettings
from monitor.model import InstrumentedModel, ShearFrame


@dataclass(frozen=True, eq=False, slots=True)
class Site:
    """Structure, sensors and limits of a site."""

    channels: tuple[str, ...]
    sensors: Array
    """Shape (c, N): from the floors' motion to the channels."""
    drifts: Array
    """Shape (n, N): from the floors' displacement to the stories' drifts."""
    stiffness_n_per_m: Array
    """Shape (n,)."""
    masses_kg: Array
    """Shape (N,)."""
    is_chain: bool
    """Whether each story carries the inertia of the floors above it alone."""
    heights_m: Array | None
    """Shape (n,)."""
    modes_hz: Array
    """Shape (m,): frequencies of the model."""
    shapes: Array
    """Shape (m, c): the model's shapes on the channels."""
    names: tuple[str, ...]
    """Names of the stories."""
    window_s: float
    """Length of the windows of ambient motion, s."""
    settings: EventSettings

    @classmethod
    def of(cls, site: InstrumentedModel, names: tuple[str, ...], window_s: float, settings: EventSettings) -> Site:
        """Collect what is needed from a model with its sensors."""
        structure, modes = site.model.structure, site.model.modes()
        sensors = site.sensor_matrix
        return cls(
            site.channels,
            sensors,
            structure.drift_matrix(),
            structure.stiffness_n_per_m,
            structure.masses_kg,
            isinstance(structure, ShearFrame),
            structure.story_heights_m,
            modes.frequencies_hz,
            (sensors @ modes.shapes).T,
            names,
            window_s,
            settings,
        )

    def content(self) -> dict[str, Any]:
        """Return the content as plain values, of which `read` makes the same site."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        settings = self.settings.model_dump(mode="json")
        return {name: v.tolist() if isinstance(v, np.ndarray) else v for name, v in values.items()} | {
            "settings": settings
        }

    @classmethod
    def read(cls, content: dict[str, Any]) -> Site:
        """Make a site of its content (`content`)."""
        known = dict(content)
        for name in ("sensors", "drifts", "stiffness_n_per_m", "masses_kg", "heights_m", "modes_hz", "shapes"):
            known[name] = None if known[name] is None else np.array(known[name], dtype=float)
        names = {name: tuple(known[name]) for name in ("channels", "names")}
        return cls(**known | names | {"settings": EventSettings.model_validate(known["settings"])})

    @property
    def n_stories(self) -> int:
        """Number of stories."""
        return len(self.drifts)

    @property
    def rides(self) -> Array:
        """Share of a rigid motion that each channel has, shape (c,)."""
        return np.asarray(self.sensors.sum(axis=1))
