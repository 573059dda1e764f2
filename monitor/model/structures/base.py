"""Base class of every structure: mass and stiffness matrices that follow from its masses and stiffnesses."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array


@dataclass(frozen=True, eq=False, slots=True)
class Structure(ABC):
    """Structure of N degrees of freedom, b masses and p stiffnesses ("stories"), the parameters that updating estimates."""

    masses_kg: Annotated[Array, "b"]
    """Masses; by default one a degree of freedom, the diagonal of the mass matrix, floor 1 (the top one) first."""
    stiffness_n_per_m: Annotated[Array, "p"]
    """Stiffnesses, story 1 (the top one) first."""
    damping_ratio: float
    """Damping ratio of modes 1 and 2 (Rayleigh damping), of mode 1 alone for a single degree of freedom."""
    built_n_per_m: Annotated[Array, "p"] | None = field(default=None, kw_only=True)
    """Stiffnesses as built, before they changed; None: those of `stiffness_n_per_m`."""

    @property
    def story_heights_m(self) -> Annotated[Array, "p"] | None:
        """Heights of the stories; None where stories have no heights."""
        return None

    @property
    def n_dofs(self) -> int:
        """Number N of degrees of freedom and of modes."""
        return self.n_masses

    @property
    def n_masses(self) -> int:
        """Number b of masses."""
        return int(self.masses_kg.size)

    @property
    def n_stories(self) -> int:
        """Number p of stiffnesses."""
        return int(self.stiffness_n_per_m.size)

    @property
    def inertia_kg(self) -> Annotated[Array, "N"]:
        """Inertia of each degree of freedom alone, the diagonal of the mass matrix, kg."""
        return self.masses_kg

    @property
    def rides(self) -> Annotated[Array, "N"]:
        """Displacement of each degree of freedom as the ground moves by one, with the structure at rest on it."""
        return np.ones(self.n_dofs)

    @property
    def story_places(self) -> tuple[str, ...]:
        """Places of the stiffnesses, as effects name them."""
        return tuple(f"story {j + 1}" for j in range(self.n_stories))

    @property
    def floor_places(self) -> tuple[str, ...]:
        """Places of the degrees of freedom, on which forces act."""
        return tuple(f"floor {j + 1}" for j in range(self.n_dofs))

    @property
    def mass_places(self) -> tuple[str, ...]:
        """Places of the masses."""
        return tuple(f"floor {j + 1}" for j in range(self.n_masses))

    @property
    def built(self) -> Annotated[Array, "p"]:
        """Stiffnesses as built, N/m."""
        return self.stiffness_n_per_m if self.built_n_per_m is None else self.built_n_per_m

    def with_stiffness(self, stiffness_n_per_m: Array) -> Self:
        """Return the structure with other stiffnesses."""
        return replace(self, stiffness_n_per_m=stiffness_n_per_m)

    def changed(self, relative: Array) -> Self:
        """Change the stiffnesses by shares of the stiffnesses as built.

        Members that are sized by the stiffnesses as built, as girders, do not change.
        """
        stiffness = self.stiffness_n_per_m + relative * self.built
        return replace(self, stiffness_n_per_m=stiffness, built_n_per_m=self.built)

    def with_masses(self, masses_kg: Array) -> Self:
        """Return the structure with other masses."""
        return replace(self, masses_kg=masses_kg)

    def in_file(self) -> dict[str, Array]:
        """Return what a structure file holds of masses and stiffnesses, by its keys."""
        return {"stiffness_n_per_m": self.stiffness_n_per_m, "masses_kg": self.masses_kg}

    @abstractmethod
    def drift_matrix(self) -> Annotated[Array, "p N"]:
        """Return the matrix from displacements to the elongations of the stories' springs: dK_j = d_j d_j^T."""

    @abstractmethod
    def single_springs(self) -> Annotated[NDArray[np.bool_], "p"]:
        """Tell which stories are a single spring (dK_j of rank one), whose drift is one motion."""

    @abstractmethod
    def mass_matrix(self) -> Annotated[Array, "N N"]:
        """Assemble the mass matrix, kg; symmetric, positive definite."""

    @abstractmethod
    def stiffness_matrix(self) -> Annotated[Array, "N N"]:
        """Assemble the stiffness matrix, N/m; symmetric."""

    @abstractmethod
    def mass_derivatives(self) -> Annotated[Array, "b N N"]:
        """Differentiate the mass matrix by the masses: dM / dm_i, first axis the mass."""

    def added_mass(self, floor: int) -> Annotated[Array, "N N"]:
        """Assemble the mass matrix of one kilogram on a floor (0 = first), by default on its degree of freedom alone."""
        one = np.eye(self.n_dofs)[floor]
        return np.outer(one, one)

    @abstractmethod
    def stiffness_derivatives(self) -> Annotated[Array, "p N N"]:
        """Differentiate the stiffness matrix by the stiffnesses: dK / dk_j, first axis the story."""
