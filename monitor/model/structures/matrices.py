"""Structure given by its matrices: any linear model, from a finite-element program or by hand."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array

_SINGLE_SPRING = 1e-6
"""Sum of the other eigenvalues of dK_j over the largest, below which dK_j is one spring. [ratio; rounding]"""


@dataclass(frozen=True, eq=False, slots=True)
class MatrixStructure:
    """Structure given by its matrices.

    K is linear in the stiffnesses, ``K = K_fixed + sum_j k_j dK_j``.  A mass scales its row and its column of M alike.
    """

    masses_kg: Array
    """Diagonal of M, shape (N,), kg."""
    stiffness_n_per_m: Array
    """Shape (p,), N/m."""
    damping_ratio: float
    """Damping ratio of modes 1 and 2 (Rayleigh damping), of mode 1 alone for a single degree of freedom."""
    mass_coupling: Array
    """M over the square roots of its diagonal, shape (N, N): ones on the diagonal."""
    fixed_stiffness: Array
    """Part of K that depends on no parameter, shape (N, N), N/m."""
    slopes: Array
    """dK_j, shape (p, N, N)."""
    built_n_per_m: Array | None = None
    """Stiffnesses as built, before they changed, shape (p,), N/m; None: those of `stiffness_n_per_m`."""

    @classmethod
    def create(cls, mass: Array, stiffness: Array, slopes: Array, nominal: Array, damping_ratio: float) -> Self:
        """Make the structure from M and K at the nominal stiffnesses.

        Parameters
        ----------
        mass, stiffness : ndarray, shape (N, N), kg and N/m
            Symmetric.
        slopes : ndarray, shape (p, N, N)
            dK / dk_j.
        nominal : ndarray, shape (p,), N/m
            Stiffnesses at which K is given.
        damping_ratio : float
            Damping ratio of modes 1 and 2.
        """
        masses = np.diag(mass).copy()
        root = np.sqrt(masses)
        fixed = stiffness - np.tensordot(nominal, slopes, axes=1)
        return cls(masses, nominal, damping_ratio, mass / np.outer(root, root), fixed, slopes)

    @property
    def story_heights_m(self) -> Array | None:
        """None: the parameters of given matrices need not be stories with heights."""
        return None

    @property
    def n_stories(self) -> int:
        """Number p of stiffnesses."""
        return int(self.stiffness_n_per_m.size)

    @property
    def n_dofs(self) -> int:
        """Number N of degrees of freedom."""
        return int(self.masses_kg.size)

    def with_stiffness(self, stiffness_n_per_m: Array) -> Self:
        """See `Structure.with_stiffness`."""
        return replace(self, stiffness_n_per_m=stiffness_n_per_m)

    def changed(self, relative: Array) -> Self:
        """See `Structure.changed`."""
        built = self.stiffness_n_per_m if self.built_n_per_m is None else self.built_n_per_m
        return replace(self, stiffness_n_per_m=self.stiffness_n_per_m + relative * built, built_n_per_m=built)

    def with_masses(self, masses_kg: Array) -> Self:
        """See `Structure.with_masses`."""
        return replace(self, masses_kg=masses_kg)

    def drift_matrix(self) -> Array:
        """See `Structure.drift_matrix`.  Where dK_j is not a single spring, the row is its stiffest direction."""
        values, vectors = np.linalg.eigh(self.slopes)
        rows = vectors[:, :, -1] * np.sqrt(values[:, -1:])
        size = np.abs(rows)
        largest = (size > 0.999 * size.max(axis=1, keepdims=True)).argmax(axis=1)  # the first, where two are equal
        return np.asarray(rows * np.sign(np.take_along_axis(rows, largest[:, None], axis=1)))

    def single_springs(self) -> NDArray[np.bool_]:
        """See `Structure.single_springs`.  A bending element is none: it is bent in two ways, and rotations are no drift."""
        values = np.abs(np.linalg.eigvalsh(self.slopes))
        values.sort(axis=1)
        return np.asarray(values[:, :-1].sum(axis=1) < _SINGLE_SPRING * values[:, -1])

    def mass_matrix(self) -> Array:
        """Assemble the mass matrix, shape (N, N), kg."""
        root = np.sqrt(self.masses_kg)
        return np.asarray(self.mass_coupling * np.outer(root, root))

    def stiffness_matrix(self) -> Array:
        """Assemble the stiffness matrix, shape (N, N), N/m."""
        return np.asarray(self.fixed_stiffness + np.tensordot(self.stiffness_n_per_m, self.slopes, axes=1))

    def mass_derivatives(self) -> Array:
        """Differentiate the mass matrix: dM / dm_i, half of row and column i of M over m_i, shape (N, N, N)."""
        n, mass = self.n_dofs, self.mass_matrix()
        slopes = np.zeros((n, n, n))
        for i in range(n):
            slopes[i, i] = 0.5 * mass[i] / self.masses_kg[i]
            slopes[i] += slopes[i].T
        return slopes

    def stiffness_derivatives(self) -> Array:
        """Differentiate the stiffness matrix: dK / dk_j, shape (p, N, N), first axis the story."""
        return self.slopes
