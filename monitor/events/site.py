"""What the site's files say that the description of events needs."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Annotated, Any

import numpy as np

from monitor.core import Array
from monitor.events.settings import EventSettings
from monitor.model import Building, InstrumentedModel, Modes, ShearFrame


@dataclass(frozen=True, eq=False, slots=True)
class Site:
    """Structure, sensors and limits of a site."""

    channels: tuple[str, ...]
    sensors: Annotated[Array, "c floors"]
    """From the floors' motion to the channels."""
    drifts: Annotated[Array, "n floors"]
    """From the floors' displacement to the stories' drifts; of a building those along x and y, at the centre of stiffness."""
    stiffness_n_per_m: Annotated[Array, "p"]
    masses_kg: Annotated[Array, "floors"]
    story_forces: Annotated[Array, "n floors"]
    """From the floors' absolute accelerations to the forces of the stories' springs that hold up their inertia, kg; empty where a
    story is no spring between two floors."""
    is_chain: bool
    """Whether each story carries the inertia of the floors above it alone."""
    heights_m: Annotated[Array, "n"] | None
    modes_hz: Annotated[Array, "m"]
    """Frequencies of the model."""
    shapes: Annotated[Array, "m c"]
    """The model's shapes on the channels."""
    names: tuple[str, ...]
    """Names of the stories, or of a building's stiffnesses."""
    window_s: float
    """Length of the windows of ambient motion."""
    settings: EventSettings
    lowest_hz: float
    """Lowest frequency of the structure."""
    floor_shapes: Annotated[Array, "floors m"] = field(default_factory=lambda: np.zeros((0, 0)))
    """The model's shapes at the floors, with unit modal mass; empty where they are not known."""
    damping: Annotated[Array, "m"] = field(default_factory=lambda: np.zeros(0))
    """The model's damping ratios."""
    floor_rides: Annotated[Array, "floors"] = field(default_factory=lambda: np.zeros(0))
    """Share of the ground's motion that each degree of freedom has; empty for all of it."""
    corners: Annotated[Array, "q floors"] = field(default_factory=lambda: np.zeros((0, 0)))
    """From the floors' displacement to the drifts along x and y at the corners of the plan, of a building: 8 rows a storey."""

    @classmethod
    def of(cls, site: InstrumentedModel, names: tuple[str, ...], window_s: float, settings: EventSettings) -> Site:
        """Collect what is needed from a model with its sensors."""
        structure, modes = site.model.structure, site.model.modes()
        sensors, drifts, corners = site.sensor_matrix, structure.drift_matrix(), np.zeros((0, 0))
        forces: Array = np.zeros((0, structure.n_dofs))
        if isinstance(structure, ShearFrame | Building):
            forces = np.asarray(np.linalg.solve(drifts.T, structure.mass_matrix()), dtype=np.float64)
        heights = structure.heights_m if isinstance(structure, Building) else structure.story_heights_m
        if isinstance(structure, Building):
            sways = [j for j, place in enumerate(structure.story_places) if not place.endswith("torsion")]
            drifts, forces, corners = drifts[sways], forces[sways], structure.corner_drifts()
            heights = np.tile(heights, len(sways) // structure.n_masses) if heights is not None else None
        return cls(
            site.channels,
            sensors,
            drifts,
            structure.stiffness_n_per_m,
            structure.inertia_kg,
            forces,
            isinstance(structure, ShearFrame),
            heights,
            modes.frequencies_hz,
            (sensors @ modes.shapes).T,
            names,
            window_s,
            settings,
            float(modes.frequencies_hz[0]),
            modes.shapes,
            site.model.damping_ratios(),
            structure.rides,
            corners,
        )

    def content(self) -> dict[str, Any]:
        """Return the content as plain values, of which `read` makes the same site."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        plain = {name: v.tolist() if isinstance(v, np.ndarray) else v for name, v in values.items()}
        return plain | {"settings": self.settings.model_dump(mode="json")}

    @classmethod
    def read(cls, content: dict[str, Any]) -> Site:
        """Make a site of its content (`content`)."""
        known = dict(content)
        arrays = (
            "sensors",
            "drifts",
            "stiffness_n_per_m",
            "masses_kg",
            "story_forces",
            "heights_m",
            "modes_hz",
            "shapes",
        )
        for name in (*arrays, "floor_shapes", "damping", "floor_rides", "corners"):
            known[name] = None if known[name] is None else np.array(known[name], dtype=float)
        names = {name: tuple(known[name]) for name in ("channels", "names")}
        return cls(**known | names | {"settings": EventSettings.model_validate(known["settings"])})

    @classmethod
    def of_channels(
        cls, channels: tuple[str, ...], modes: Modes | None, lowest_hz: float, window_s: float, settings: EventSettings
    ) -> Site:
        """Collect what is needed where nothing but the channels and perhaps their modes is known: there are no stories.

        The modes are as the channels show them; where they are not known, `lowest_hz` is the lowest frequency of the structure.
        """
        c = len(channels)
        hz = np.zeros(0) if modes is None else modes.frequencies_hz
        shapes = np.zeros((0, c)) if modes is None else modes.shapes.T
        none, lowest_hz = np.zeros(0), float(hz[0]) if hz.size else lowest_hz
        drifts = np.zeros((0, c))
        return cls(
            channels, np.eye(c), drifts, none, none, drifts, False, None, hz, shapes, (), window_s, settings, lowest_hz
        )

    @property
    def n_stories(self) -> int:
        """Number of stories, whose stiffness is judged."""
        return self.stiffness_n_per_m.size

    @property
    def tells_drifts(self) -> bool:
        """Whether stories have drifts: of a chain, or of a building."""
        return self.is_chain or bool(self.corners.size)

    @property
    def rides(self) -> Annotated[Array, "c"]:
        """Share of a rigid motion that each channel has."""
        floors = self.floor_rides if self.floor_rides.size else np.ones(self.sensors.shape[1])
        return np.asarray(self.sensors @ floors)
