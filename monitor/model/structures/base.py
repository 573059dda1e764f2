"""What every structure is: mass and stiffness matrices that follow from its masses and stiffnesses."""

from __future__ import annotations

from typing import Protocol, Self

from monitor.core import Array


class Structure(Protocol):
    """N degrees of freedom ("floors") and p stiffnesses ("stories"), the parameters that updating moves."""

    @property
    def masses_kg(self) -> Array:
        """Diagonal of the mass matrix, shape (N,)."""

    @property
    def stiffness_n_per_m(self) -> Array:
        """Shape (p,)."""

    @property
    def damping_ratio(self) -> float:
        """Rayleigh damping: this ratio in modes 1 and 2."""

    @property
    def story_heights_m(self) -> Array | None:
        """Shape (p,), where stories have heights."""

    @property
    def n_dofs(self) -> int:
        """N, the number of degrees of freedom and of modes."""

    @property
    def n_stories(self) -> int:
        """p, the number of stiffnesses."""

    def with_stiffness(self, stiffness_n_per_m: Array) -> Self:
        """The same structure with other stiffnesses, shape (p,)."""

    def changed(self, relative: Array) -> Self:
        """After its stiffnesses changed by these shares of what was built, shape (p,); what is sized by them stays."""

    def with_masses(self, masses_kg: Array) -> Self:
        """The same structure with other masses, shape (N,)."""

    def drift_matrix(self) -> Array:
        """How far each story's spring is stretched, from the displacements, shape (p, N): dK_j = d_j d_j^T."""

    def mass_matrix(self) -> Array:
        """Shape (N, N), kg; symmetric, positive definite."""

    def stiffness_matrix(self) -> Array:
        """Shape (N, N), N/m; symmetric."""

    def mass_derivatives(self) -> Array:
        """dM / dm_i, shape (N, N, N): first axis is the mass."""

    def stiffness_derivatives(self) -> Array:
        """dK / dk_j, shape (p, N, N): first axis is the story."""
