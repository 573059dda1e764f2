"""Interface of every structure: mass and stiffness matrices that follow from its masses and stiffnesses."""

from __future__ import annotations

from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array


class Structure(Protocol):
    """Structure of N degrees of freedom ("floors") and p stiffnesses ("stories"), the parameters that updating estimates."""

    @property
    def masses_kg(self) -> Array:
        """Diagonal of the mass matrix, shape (N,), kg."""

    @property
    def stiffness_n_per_m(self) -> Array:
        """Stiffnesses, shape (p,), N/m."""

    @property
    def damping_ratio(self) -> float:
        """Damping ratio of modes 1 and 2 (Rayleigh damping)."""

    @property
    def story_heights_m(self) -> Array | None:
        """Heights of the stories, shape (p,), m; None where stories have no heights."""

    @property
    def n_dofs(self) -> int:
        """Number N of degrees of freedom and of modes."""

    @property
    def n_stories(self) -> int:
        """Number p of stiffnesses."""

    def with_stiffness(self, stiffness_n_per_m: Array) -> Self:
        """Return the structure with other stiffnesses, shape (p,), N/m."""

    def changed(self, relative: Array) -> Self:
        """Change the stiffnesses by shares of the stiffnesses as built, shape (p,).

        Members that are sized by the stiffnesses as built, as girders, do not change.
        """

    def with_masses(self, masses_kg: Array) -> Self:
        """Return the structure with other masses, shape (N,), kg."""

    def drift_matrix(self) -> Array:
        """Return the matrix from displacements to the elongations of the stories' springs, shape (p, N): dK_j = d_j d_j^T."""

    def single_springs(self) -> NDArray[np.bool_]:
        """Tell which stories are a single spring (dK_j of rank one), whose drift is one motion, shape (p,)."""

    def mass_matrix(self) -> Array:
        """Assemble the mass matrix, shape (N, N), kg; symmetric, positive definite."""

    def stiffness_matrix(self) -> Array:
        """Assemble the stiffness matrix, shape (N, N), N/m; symmetric."""

    def mass_derivatives(self) -> Array:
        """Differentiate the mass matrix by the masses: dM / dm_i, shape (N, N, N), first axis the mass."""

    def stiffness_derivatives(self) -> Array:
        """Differentiate the stiffness matrix by the stiffnesses: dK / dk_j, shape (p, N, N), first axis the story."""
