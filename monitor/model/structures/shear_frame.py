"""Shear frame: rigid floors on columns that only shear (the paper's frame, section 4)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from monitor.core import Array
from monitor.model.structures.base import Structure


@dataclass(frozen=True, eq=False, slots=True)
class ShearFrame(Structure):
    """Shear frame of n floors, numbered from 1 (top) to n (lowest).

    Story j joins floors j and j + 1; story n joins floor n and the ground.  The parameters are the story stiffnesses, in which K
    is linear.

    Examples
    --------
    >>> import numpy as np
    >>> from monitor.model import ShearFrame
    >>> ShearFrame(np.ones(2), np.array([1000.0, 2000.0]), damping_ratio=0.01).stiffness_matrix()
    array([[ 1000., -1000.],
           [-1000.,  3000.]])
    """

    story_heights_m: Annotated[Array, "n"] | None = None
    column_to_girder: float = 0.0
    """(E I_c / h) / (E I_g / L_g): one column as built, the mean over stories, over one girder of a one-bay frame; 0 for rigid
    girders."""

    @override
    def drift_matrix(self) -> Array:
        return _drift_matrix(self.n_stories)

    @override
    def single_springs(self) -> NDArray[np.bool_]:
        return np.ones(self.n_stories, dtype=bool)

    @override
    def mass_matrix(self) -> Array:
        return np.diag(self.masses_kg)

    @override
    def stiffness_matrix(self) -> Array:
        drift = self.drift_matrix()
        rigid = np.asarray(drift.T @ (self.stiffness_n_per_m[:, None] * drift))
        return rigid if self.column_to_girder == 0.0 else rigid - self._stiffness_lost_by_rotation()

    def joint_rotations(self) -> Annotated[Array, "n n"]:
        """Compute how the joints of every floor rotate with the floors' displacements relative to the ground, rad/m.

        Positive where a joint turns as the chord of a column does when its upper end moves ahead; zero with rigid
        girders.  Raises ValueError if the stories' heights are not known: without them there are stiffnesses and no angles.

        Examples
        --------
        A portal with a girder that is as stiff as a column: the joint turns by 6/10 of the chord's rotation.

        >>> import numpy as np
        >>> one = np.ones(1)
        >>> ShearFrame(one, 1000.0 * one, 0.01, story_heights_m=2.0 * one, column_to_girder=1.0).joint_rotations().round(3)
        array([[0.3]])
        """
        if self.story_heights_m is None:
            raise ValueError("joints turn by angles that depend on the heights of the stories: state story_heights_m")
        if self.column_to_girder == 0.0:
            return np.zeros((self.n_stories, self.n_stories))
        coupling, k_theta = self._rotation_terms()
        return np.asarray(-np.linalg.solve(k_theta, coupling.T))

    def girder_rotation(self, floor: int, mounted: str) -> Annotated[Array, "n"]:
        """Compute how the girders of a floor (1 = top) turn at a ``joint`` or at ``midspan``, as `joint_rotations`, rad/m.

        A girder in double curvature turns in its middle by half as much as at its ends, the other way.
        """
        return np.asarray((-0.5 if mounted == "midspan" else 1.0) * self.joint_rotations()[floor - 1])

    def _stiffness_lost_by_rotation(self) -> Array:
        """Compute the stiffness that the joints' rotation takes away, by static condensation, N/m."""
        coupling, k_theta = self._rotation_terms()
        return np.asarray(coupling @ np.linalg.solve(k_theta, coupling.T))

    def _rotation_terms(self) -> tuple[Annotated[Array, "n n"], Annotated[Array, "n n"]]:
        """Assemble the stiffness between floors and rotations, N, and that of the rotations, N m.

        All joints of a floor rotate alike.  Heights are taken as equal where none are given.

        References
        ----------
        A. K. Chopra, Dynamics of Structures, section 9.3 (beam-to-column stiffness ratio) and 9.4 (condensation).
        """
        n = self.n_stories
        heights = np.ones(n) if self.story_heights_m is None else self.story_heights_m
        column = self.stiffness_n_per_m * heights**2 / 24.0  # E I_c / h of one of the two columns
        girder = float((self.built * heights**2 / 24.0).mean()) / self.column_to_girder
        # The rotations of story j are those of its upper floor and, unless that is the clamped ground, of its lower floor.
        rotation_sum = np.eye(n) + np.eye(n, k=1)
        k_theta = 12.0 * girder * np.eye(n)  # one girder bent in double curvature, both ends
        for j in range(n):
            ends = [j] if j == n - 1 else [j, j + 1]
            for a in ends:
                for b in ends:
                    k_theta[a, b] += column[j] * (8.0 if a == b else 4.0)
        coupling = -(self.drift_matrix().T * (12.0 * column / heights)) @ rotation_sum
        return coupling, k_theta

    @override
    def mass_derivatives(self) -> Array:
        n = self.n_dofs
        unit = np.zeros((n, n, n))
        unit[np.arange(n), np.arange(n), np.arange(n)] = 1.0
        return unit

    def stiffness_derivatives(self) -> Array:
        """Differentiate the stiffness matrix of rigid joints: dK / dk_j, first axis the story."""
        return _drift_products(self.n_stories)


@cache
def _drift_products(n: int) -> Annotated[Array, "n n n"]:
    """Return the outer product of every story's drift row with itself."""
    drift = _drift_matrix(n)
    products = drift[:, :, None] * drift[:, None, :]
    products.setflags(write=False)
    return products


@cache
def _drift_matrix(n: int) -> Array:
    """Build the drift matrix of n stories once."""
    matrix = np.eye(n) - np.eye(n, k=1)
    matrix.setflags(write=False)
    return matrix
