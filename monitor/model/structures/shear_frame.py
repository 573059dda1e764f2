"""A shear frame: rigid floors on columns that only shear (the paper's frame, section 4)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Self

import numpy as np

from monitor.core import Array


@dataclass(frozen=True, eq=False, slots=True)
class ShearFrame:
    """Floors 1 (top) to n (lowest); story j joins floors j and j + 1, story n reaches the ground.

    Its parameters are the story stiffnesses: K is linear in them.
    """

    masses_kg: Array
    """Shape (n,)."""
    stiffness_n_per_m: Array
    """Shape (n,), story 1 first."""
    damping_ratio: float
    """Rayleigh damping: this ratio in modes 1 and 2 (in mode 1 alone for a single floor)."""
    story_heights_m: Array | None = None
    """Shape (n,)."""
    built_n_per_m: Array | None = None
    """Story stiffnesses before they changed, to which girders were built, shape (n,); None: those of `stiffness_n_per_m`."""
    column_to_girder: float = 0.0
    """(E I_c / h) / (E I_g / L_g): one column as built, the mean over stories, over one girder of a one-bay frame; 0: rigid."""

    @property
    def n_stories(self) -> int:
        """Number of stories, and of floors."""
        return int(self.masses_kg.size)

    @property
    def n_dofs(self) -> int:
        """Number of floors, and of stories."""
        return int(self.masses_kg.size)

    def with_stiffness(self, stiffness_n_per_m: Array) -> Self:
        """See `Structure.with_stiffness`."""
        return replace(self, stiffness_n_per_m=stiffness_n_per_m)

    def changed(self, relative: Array) -> Self:
        """See `Structure.changed`."""
        built = self._built
        return replace(self, stiffness_n_per_m=self.stiffness_n_per_m + relative * built, built_n_per_m=built)

    @property
    def _built(self) -> Array:
        return self.stiffness_n_per_m if self.built_n_per_m is None else self.built_n_per_m

    def with_masses(self, masses_kg: Array) -> Self:
        """See `Structure.with_masses`."""
        return replace(self, masses_kg=masses_kg)

    def drift_matrix(self) -> Array:
        """Drift of every story from the floors' displacements, shape (n, n): upper floor minus lower."""
        return _drift_matrix(self.n_stories)

    def mass_matrix(self) -> Array:
        """Shape (n, n), kg."""
        return np.diag(self.masses_kg)

    def stiffness_matrix(self) -> Array:
        """Shape (n, n), N/m."""
        drift = self.drift_matrix()
        rigid = np.asarray(drift.T @ (self.stiffness_n_per_m[:, None] * drift))
        return rigid if self.column_to_girder == 0.0 else rigid - self._lost_by_rotation()

    def _lost_by_rotation(self) -> Array:
        """What joints that rotate, those of a floor alike, take of the stiffness once condensed, shape (n, n).

        Heights are taken equal where none are given.

        References
        ----------
        A. K. Chopra, Dynamics of Structures, section 9.3 (beam-to-column stiffness ratio) and 9.4 (condensation).
        """
        n = self.n_stories
        heights = np.ones(n) if self.story_heights_m is None else self.story_heights_m
        column = self.stiffness_n_per_m * heights**2 / 24.0  # E I_c / h of one of the two columns
        girder = float((self._built * heights**2 / 24.0).mean()) / self.column_to_girder
        # Story j's rotations: its upper floor's and, but for the clamped ground, its lower floor's.
        rotation_sum = np.eye(n) + np.eye(n, k=1)
        k_theta = 12.0 * girder * np.eye(n)  # one girder bent in double curvature, both ends
        for j in range(n):
            ends = [j] if j == n - 1 else [j, j + 1]
            for a in ends:
                for b in ends:
                    k_theta[a, b] += column[j] * (8.0 if a == b else 4.0)
        coupling = -(self.drift_matrix().T * (12.0 * column / heights)) @ rotation_sum
        return np.asarray(coupling @ np.linalg.solve(k_theta, coupling.T))

    def mass_derivatives(self) -> Array:
        """dM / dm_i, shape (n, n, n): first axis is the floor."""
        n = self.n_dofs
        unit = np.zeros((n, n, n))
        unit[np.arange(n), np.arange(n), np.arange(n)] = 1.0
        return unit

    def stiffness_derivatives(self) -> Array:
        """dK / dk_j of rigid joints, shape (n, n, n): first axis is the story."""
        return _drift_products(self.n_stories)


@cache
def _drift_products(n: int) -> Array:
    """Of every story's drift with itself, shape (n, n, n)."""
    drift = _drift_matrix(n)
    products = drift[:, :, None] * drift[:, None, :]
    products.setflags(write=False)
    return products


@cache
def _drift_matrix(n: int) -> Array:
    matrix = np.eye(n) - np.eye(n, k=1)
    matrix.setflags(write=False)
    return matrix
