"""A shear frame: rigid floors on columns that only shear (the paper's frame, section 4)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Self

import numpy as np

from monitor.results import Array


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
        built = self.stiffness_n_per_m if self.built_n_per_m is None else self.built_n_per_m
        return replace(self, stiffness_n_per_m=self.stiffness_n_per_m * (1.0 + relative), built_n_per_m=built)

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
        return np.asarray(drift.T @ (self.stiffness_n_per_m[:, None] * drift))

    def mass_derivatives(self) -> Array:
        """dM / dm_i, shape (n, n, n): first axis is the floor."""
        n = self.n_dofs
        unit = np.zeros((n, n, n))
        unit[np.arange(n), np.arange(n), np.arange(n)] = 1.0
        return unit

    def stiffness_derivatives(self) -> Array:
        """dK / dk_j, shape (n, n, n): first axis is the story."""
        drift = self.drift_matrix()
        return np.asarray(np.einsum("ja,jb->jab", drift, drift))


@cache
def _drift_matrix(n: int) -> Array:
    matrix = np.eye(n) - np.eye(n, k=1)
    matrix.setflags(write=False)
    return matrix
