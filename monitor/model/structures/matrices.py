"""Structure given by its matrices: any linear model, from a finite-element program or by hand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from monitor.core import Array
from monitor.model.structures.base import Structure

_SINGLE_SPRING = 1e-6
"""Sum of the other eigenvalues of dK_j over the largest, below which dK_j is one spring. [ratio; rounding]"""


@dataclass(frozen=True, eq=False, slots=True)
class MatrixStructure(Structure):
    """Structure given by its matrices.

    K is linear in the stiffnesses, ``K = K_fixed + sum_j k_j dK_j``.  A mass scales its row and its column of M alike.
    """

    mass_coupling: Annotated[Array, "N N"]
    """M over the square roots of its diagonal: ones on the diagonal."""
    fixed_stiffness: Annotated[Array, "N N"]
    """Part of K that depends on no parameter, N/m."""
    slopes: Annotated[Array, "p N N"]
    """dK_j."""

    @classmethod
    def create(cls, mass: Array, stiffness: Array, slopes: Array, nominal: Array, damping_ratio: float) -> Self:
        """Make the structure from symmetric M and K (kg, N/m) at the nominal stiffnesses, and the slopes dK / dk_j.

        The damping ratio is that of modes 1 and 2.
        """
        masses = np.diag(mass).copy()
        root = np.sqrt(masses)
        fixed = stiffness - np.tensordot(nominal, slopes, axes=1)
        return cls(masses, nominal, damping_ratio, mass / np.outer(root, root), fixed, slopes)

    def drift_matrix(self) -> Array:
        """Where dK_j is not a single spring, the row is its stiffest direction."""
        values, vectors = np.linalg.eigh(self.slopes)
        rows = vectors[:, :, -1] * np.sqrt(values[:, -1:])
        size = np.abs(rows)
        largest = (size > 0.999 * size.max(axis=1, keepdims=True)).argmax(axis=1)  # the first, where two are equal
        return np.asarray(rows * np.sign(np.take_along_axis(rows, largest[:, None], axis=1)))

    def single_springs(self) -> NDArray[np.bool_]:
        """A bending element is none: it is bent in two ways, and rotations are no drift."""
        values = np.abs(np.linalg.eigvalsh(self.slopes))
        values.sort(axis=1)
        return np.asarray(values[:, :-1].sum(axis=1) < _SINGLE_SPRING * values[:, -1])

    @override
    def in_file(self) -> dict[str, Array]:
        """As numbers, not as names of files, which would be looked for beside a new file."""
        matrices = {"mass_matrix": self.mass_matrix(), "stiffness_matrix": self.stiffness_matrix()}
        return {
            "stiffness_n_per_m": self.stiffness_n_per_m,
            **matrices,
            "stiffness_derivatives": self.stiffness_derivatives(),
        }

    @override
    def mass_matrix(self) -> Array:
        root = np.sqrt(self.masses_kg)
        return np.asarray(self.mass_coupling * np.outer(root, root))

    @override
    def stiffness_matrix(self) -> Array:
        return np.asarray(self.fixed_stiffness + np.tensordot(self.stiffness_n_per_m, self.slopes, axes=1))

    def mass_derivatives(self) -> Array:
        """Differentiate the mass matrix: dM / dm_i, half of row and column i of M over m_i."""
        n, mass = self.n_dofs, self.mass_matrix()
        slopes = np.zeros((n, n, n))
        for i in range(n):
            slopes[i, i] = 0.5 * mass[i] / self.masses_kg[i]
            slopes[i] += slopes[i].T
        return slopes

    @override
    def stiffness_derivatives(self) -> Array:
        return self.slopes
