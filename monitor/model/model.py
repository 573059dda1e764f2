"""``Model = structure + effects``: the model that updating, simulation and diagnosis share."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from scipy.linalg import lapack

from monitor.core import Array
from monitor.model.effects import Effect
from monitor.model.structures import Structure


@dataclass(frozen=True, eq=False, slots=True)
class Modes:
    """Undamped modes of a model, lowest frequency first."""

    eigenvalues: Annotated[Array, "n"]
    """(rad/s)^2."""
    shapes: Annotated[Array, "n n"]
    """shapes[:, i] is mode i at the floors, with unit modal mass."""

    @property
    def frequencies_hz(self) -> Annotated[Array, "n"]:
        """Natural frequencies, Hz."""
        return np.asarray(np.sqrt(self.eigenvalues) / (2.0 * np.pi))


@dataclass(frozen=True, eq=False, slots=True)
class Model:
    """A structure and the effects that its drawing leaves out.

    Examples
    --------
    >>> import numpy as np
    >>> from monitor.model import Model, ShearFrame
    >>> frame = Model(ShearFrame(np.array([100.0, 100.0]), np.array([1e6, 1e6]), damping_ratio=0.01))
    >>> frame.modes().frequencies_hz.round(2)
    array([ 9.84, 25.75])
    """

    structure: Structure
    effects: tuple[Effect, ...] = ()
    correction: Annotated[Array, "n n"] | None = None
    """Stiffness that neither the structure's form nor an effect explains, the persistent model error; N/m."""
    modal_damping: Annotated[Array, "n"] | None = None
    """Damping ratio of every mode, in place of the structure's Rayleigh damping."""

    def with_stiffness(self, stiffness_n_per_m: Array) -> Model:
        """Return the model with other story stiffnesses, N/m."""
        return replace(self, structure=self.structure.with_stiffness(stiffness_n_per_m))

    def as_built(self) -> Model:
        """Return the model with its present stiffnesses recorded as those that were built.

        Later changes of the stiffnesses then leave unchanged what is sized by them, as the girders of a shear frame.
        """
        return replace(self, structure=self.structure.changed(np.zeros(self.structure.n_stories)))

    def with_masses(self, masses_kg: Array) -> Model:
        """Return the model with other floor masses, kg."""
        return replace(self, structure=self.structure.with_masses(masses_kg))

    def altered_structure(self) -> Structure:
        """Return the structure with the effects that change its members and joints."""
        structure = self.structure
        # Changes of members come first, since joints and a base act on the members after all changes.
        for effect in self.effects:
            structure = effect.altered(structure)
        return structure

    def structural_matrices(self) -> tuple[Annotated[Array, "n n"], Annotated[Array, "n n"]]:
        """Assemble the mass and stiffness matrices (kg, N/m), with the effects that are linear at every level of vibration."""
        structure = self.altered_structure()
        mass, stiffness = structure.mass_matrix(), structure.stiffness_matrix()
        for effect in self.effects:
            mass, stiffness = effect.structural(mass, stiffness, structure)
        return mass, stiffness if self.correction is None else stiffness + self.correction

    def mass_matrix(self) -> Array:
        """Assemble the mass matrix, kg."""
        return self.structural_matrices()[0]

    def stiffness_matrix(self) -> Array:
        """Assemble the stiffness matrix, N/m."""
        return self.structural_matrices()[1]

    def damping_ratios(self) -> Annotated[Array, "n"]:
        """Compute the damping ratio of every mode."""
        if self.modal_damping is not None:
            return self.modal_damping
        modes = self.modes()
        modal = np.einsum("ai,ab,bi->i", modes.shapes, self.damping_matrix(), modes.shapes)
        return np.asarray(modal / (2.0 * np.sqrt(modes.eigenvalues)))

    def damping_matrix(self) -> Array:
        """Assemble the damping matrix, N s/m.

        The damping is modal where `modal_damping` is given.  Otherwise it is Rayleigh damping with the structure's damping ratio
        in modes 1 and 2.
        """
        omega = np.sqrt(self.modes().eigenvalues)
        if self.modal_damping is not None:
            carried = self.mass_matrix() @ self.modes().shapes
            return np.asarray((carried * (2.0 * self.modal_damping * omega)) @ carried.T)
        first, second = omega[0], omega[min(1, omega.size - 1)]
        ratio = self.structure.damping_ratio
        if omega.size == 1:
            return np.asarray(2.0 * ratio * first * self.mass_matrix())
        alpha = 2.0 * ratio * first * second / (first + second)
        beta = 2.0 * ratio / (first + second)
        return np.asarray(alpha * self.mass_matrix() + beta * self.stiffness_matrix())

    def stiffness_derivatives(self) -> Annotated[Array, "stories n n"]:
        """Differentiate the stiffness matrix by the story stiffnesses: dK / dk_j.

        The derivatives are exact for the structure without effects, and central differences with effects.
        """
        if not self.effects:
            return self.structure.stiffness_derivatives()
        stiffness = self.structure.stiffness_n_per_m
        step = 1e-5 * stiffness

        def at(change: Array) -> Array:
            return self.with_stiffness(stiffness + change).stiffness_matrix()

        return np.array([(at(e) - at(-e)) / (2.0 * h) for e, h in zip(np.diag(step), step, strict=True)])

    def modes(self) -> Modes:
        """Solve the undamped eigenvalue problem K phi = lambda M phi.

        Raises LinAlgError if the mass matrix is not positive definite, or mass or stiffness is not finite.
        """
        mass, stiffness = self.structural_matrices()
        if not (np.isfinite(mass).all() and np.isfinite(stiffness).all()):
            raise np.linalg.LinAlgError("mass or stiffness is not finite")
        eigenvalues, shapes, failed = lapack.dsygvd(stiffness, mass)  # without the checks of `eigh`, which take longer
        if failed:
            raise np.linalg.LinAlgError("the mass matrix is not positive definite")
        return Modes(eigenvalues, shapes)
