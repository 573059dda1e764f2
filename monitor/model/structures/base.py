"""Interface of every structure: mass and stiffness matrices that follow from its masses and stiffnesses."""

from __future__ import annotations

from typing import Annotated, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array


class Structure(Protocol):
    """Structure of N degrees of freedom ("floors") and p stiffnesses ("stories"), the parameters that updating estimates."""

    @property
    def masses_kg(self) -> Annotated[Array, "N"]:
        """Diagonal of the mass matrix."""

    @property
    def stiffness_n_per_m(self) -> Annotated[Array, "p"]:
        """Stiffnesses of the stories."""

    @property
    def damping_ratio(self) -> float:
        """Damping ratio of modes 1 and 2 (Rayleigh damping)."""

    @property
    def story_heights_m(self) -> Annotated[Array, "p"] | None:
        """Heights of the stories; None where stories have no heights."""

    @property
    def n_dofs(self) -> int:
        """Number N of degrees of freedom and of modes."""

    @property
    def n_stories(self) -> int:
        """Number p of stiffnesses."""

    def with_stiffness(self, stiffness_n_per_m: Array) -> Self:
        """Return the structure with other stiffnesses."""

    def changed(self, relative: Array) -> Self:
        """Change the stiffnesses by shares of the stiffnesses as built.

        Members that are sized by the stiffnesses as built, as girders, do not change.
        """

    def with_masses(self, masses_kg: Array) -> Self:
        """Return the structure with other masses."""

    def drift_matrix(self) -> Array:
        """Return the matrix from displacements to the elongations of the stories' springs, shape (p, N): dK_j = d_j d_j^T."""

    def single_springs(self) -> Annotated[NDArray[np.bool_], "p"]:
        """Tell which stories are a single spring (dK_j of rank one), whose drift is one motion."""

    def mass_matrix(self) -> Annotated[Array, "N N"]:
        """Assemble the mass matrix, kg; symmetric, positive definite."""

    def stiffness_matrix(self) -> Annotated[Array, "N N"]:
        """Assemble the stiffness matrix, N/m; symmetric."""

    def mass_derivatives(self) -> Annotated[Array, "N N N"]:
        """Differentiate the mass matrix by the masses: dM / dm_i, first axis the mass."""

    def stiffness_derivatives(self) -> Annotated[Array, "p N N"]:
        """Differentiate the stiffness matrix by the stiffnesses: dK / dk_j, first axis the story."""
