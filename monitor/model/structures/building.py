"""Building: rigid floors that move along x and y and turn about z, on storeys counted from the ground up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from monitor.core import Array
from monitor.model.structures.base import Structure

Direction = Literal["x", "y", "torsion"]
DIRECTIONS: tuple[Direction, ...] = ("x", "y", "torsion")
"""Directions in which a floor moves, in the order of degrees of freedom and stiffnesses. [names; definition]"""
_KEYS = {"x": "stiffness_x_n_per_m", "y": "stiffness_y_n_per_m", "torsion": "stiffness_z_nm_per_rad"}
"""Keys of their stiffnesses in a structure file. [names; contract]"""


@dataclass(frozen=True, eq=False, slots=True)
class Building(Structure):
    """Building of n storeys; storey j from the ground joins floors j - 1 and j, storey 1 floor 1 and the ground.

    The degrees of freedom are the floors' displacements along x, then along y, then their rotations about z times the radius of
    gyration of the plan, so that all are metres, their inertias kilograms and the forces on them newtons.  They are those of the
    centre of stiffness, which is the plan's middle.  The stiffnesses follow in the same order: along x and y in N/m, about z in
    N m/rad; each is one spring between two floors, so that K is linear in all of them.

    A building seen along one direction alone, which nothing couples to the others, has that direction only: a shear frame.

    References
    ----------
    A. K. Chopra, Dynamics of Structures, section 9.6 (one-way and two-way unsymmetric systems).

    Examples
    --------
    >>> import numpy as np
    >>> from monitor.model import Building
    >>> plan, stiffness = np.array([[12.0, 9.0]]), np.array([1000.0, 2000.0, 90000.0])
    >>> Building(np.array([100.0]), stiffness, 0.01, plan, np.zeros((1, 2))).stiffness_matrix().round(6)
    array([[1000.,    0.,    0.],
           [   0., 2000.,    0.],
           [   0.,    0., 4800.]])
    """

    plan_m: Annotated[Array, "n 2"]
    """Length along x and width along y of each floor, m."""
    eccentricity_m: Annotated[Array, "n 2"]
    """Place of each floor's centre of mass, along x and y from the centre of stiffness, m."""
    directions: tuple[Direction, ...] = DIRECTIONS
    """Directions that the model has: all, or one alone."""
    ground_axis: Literal["x", "y"] = "x"
    """Direction of a ground motion."""
    heights_m: Annotated[Array, "n"] | None = None
    """Heights of the storeys, the lowest first."""

    @property
    @override
    def n_dofs(self) -> int:
        return self.n_masses * len(self.directions)

    @property
    def gyration_m(self) -> Annotated[Array, "n"]:
        """Radius of gyration of each floor's plan about its middle, m."""
        return np.asarray(np.sqrt((self.plan_m**2).sum(axis=1) / 12.0))

    @property
    @override
    def inertia_kg(self) -> Array:
        return np.diag(self.mass_matrix())

    @property
    @override
    def rides(self) -> Array:
        alone = len(self.directions) == 1
        return np.repeat([float(alone or d == self.ground_axis) for d in self.directions], self.n_masses)

    @override
    def in_file(self) -> dict[str, Array]:
        """By the keys of ``[[storeys]]``, one value a storey."""
        of_directions = self.stiffness_n_per_m.reshape(len(self.directions), -1)
        stiffness = {_KEYS[d]: own for d, own in zip(self.directions, of_directions, strict=True)}
        return {"mass_kg": self.masses_kg, **stiffness}

    def _places(self, kind: str) -> tuple[str, ...]:
        return tuple(f"{kind} {j + 1} {d}" for d in self.directions for j in range(self.n_masses))

    @property
    @override
    def story_places(self) -> tuple[str, ...]:
        return self._places("storey")

    @property
    @override
    def floor_places(self) -> tuple[str, ...]:
        return self._places("floor")

    def sensor_row(self, floor: int, axis: Literal["x", "y"], position_m: tuple[float, float]) -> Annotated[Array, "N"]:
        """Return what an accelerometer along x or y sees of the degrees of freedom: u - y theta, or v + x theta.

        Floors count from 1, the lowest; the position is from the plan's middle.
        """
        x, y = position_m
        turned = -y if axis == "x" else x
        return self._row(floor, {axis: 1.0}) + turned * self.turn_row(floor)

    def turn_row(self, floor: int) -> Annotated[Array, "N"]:
        """Return the rotation of a floor, from 1, about z by the degrees of freedom, rad/m; zero without torsion."""
        return self._row(floor, {"torsion": 1.0 / float(self.gyration_m[floor - 1])})

    def _row(self, floor: int, shares: Mapping[str, float]) -> Annotated[Array, "N"]:
        row = np.zeros((len(self.directions), self.n_masses))
        row[:, floor - 1] = [shares.get(d, 0.0) for d in self.directions]
        return row.ravel()

    def points_motion(self, floors: Sequence[int], positions_m: Annotated[Array, "k 2"]) -> Annotated[Array, "k 2 N"]:
        """Return the motion along x and y of points on floors (0 the ground, which rests) by the degrees of freedom."""
        out = np.zeros((len(floors), 2, self.n_dofs))
        for row, floor, (x, y) in zip(out, floors, positions_m.tolist(), strict=True):
            if floor:
                row[:] = self.sensor_row(floor, "x", (x, y)), self.sensor_row(floor, "y", (x, y))
        return out

    def corner_drifts(self) -> Annotated[Array, "q N"]:
        """Return the drifts along x and y at the four corners of each storey by the degrees of freedom, 8 rows a storey."""
        n, corners = self.n_masses, np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)])
        at = (self.plan_m[:, None] * corners).reshape(-1, 2)
        above, below = (self.points_motion(np.repeat(np.arange(n) + upper, 4).tolist(), at) for upper in (1, 0))
        return (above - below).reshape(8 * n, self.n_dofs)

    @override
    def drift_matrix(self) -> Array:
        n = self.n_masses
        drift = np.eye(n) - np.eye(n, k=-1)
        rows = [drift / self.gyration_m if d == "torsion" else drift for d in self.directions]
        out = np.zeros((len(rows), n, len(rows), n))
        for i, of_direction in enumerate(rows):
            out[i, :, i] = of_direction
        return out.reshape(self.n_dofs, self.n_dofs)

    @override
    def single_springs(self) -> NDArray[np.bool_]:
        return np.ones(self.n_stories, dtype=bool)

    @override
    def stiffness_matrix(self) -> Array:
        drift = self.drift_matrix()
        return np.asarray(drift.T @ (self.stiffness_n_per_m[:, None] * drift))

    @override
    def stiffness_derivatives(self) -> Array:
        drift = self.drift_matrix()
        return np.asarray(drift[:, :, None] * drift[:, None, :])

    @override
    def mass_matrix(self) -> Array:
        return np.tensordot(self.masses_kg, self.mass_derivatives(), axes=1)

    def added_mass(self, floor: int) -> Array:
        """The mass is spread as the floor's own."""
        return np.asarray(self.mass_derivatives()[floor])

    @override
    def mass_derivatives(self) -> Array:
        n, (x, y) = self.n_masses, self.eccentricity_m.T / self.gyration_m
        one, none = np.ones(n), np.zeros(n)
        floor = np.array([[one, none, -y], [none, one, x], [-y, x, 1.0 + x**2 + y**2]])
        kept = [DIRECTIONS.index(d) for d in self.directions]
        out = np.zeros((n, len(kept), n, len(kept), n))
        for j in range(n):
            out[j, :, j, :, j] = floor[np.ix_(kept, kept)][:, :, j]
        return out.reshape(n, self.n_dofs, self.n_dofs)


def frames_at_edges(stiffness_x: Array, stiffness_y: Array, plan_m: Annotated[Array, "n 2"]) -> Annotated[Array, "n"]:
    """Compute the torsional stiffness of storeys whose frames stand at the edges of the plan, N m/rad.

    Examples
    --------
    >>> frames_at_edges(np.array([1.0]), np.array([2.0]), np.array([[10.0, 4.0]]))
    array([54.])
    """
    a, b = plan_m.T
    return np.asarray(stiffness_x * b**2 / 4.0 + stiffness_y * a**2 / 4.0)
