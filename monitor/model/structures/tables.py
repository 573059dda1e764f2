"""Table ``[structure]`` of a structure file, by its ``kind``: the structure as drawn, not as it is."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from monitor.core import Array, Settings
from monitor.model.structures.base import Structure
from monitor.model.structures.drawing import Drawing
from monitor.model.structures.matrices import MatrixStructure
from monitor.model.structures.shear_frame import ShearFrame

Positive = Annotated[float, Field(gt=0, le=1e30)]
"""Positive number; the square of one above the limit could exceed the range of a float."""
Range = tuple[Positive, Positive]
Matrix = tuple[tuple[float, ...], ...]
_SYMMETRY_TOLERANCE = 1e-6
"""Largest asymmetry of a matrix that counts as symmetric. [ratio; rounding]"""


class _Drawing(Settings):
    """Keys that every kind of structure has."""

    name: str = ""
    """Name of the structure, for people."""
    stiffness_n_per_m: tuple[Positive, ...] = Field(min_length=1)
    """Stiffnesses as drawn, story 1 (the top one) first."""
    damping_ratio: float = Field(default=0.01, gt=0, lt=1)
    """Damping ratio of modes 1 and 2 (Rayleigh damping)."""
    masses_range_kg: tuple[Range, ...] | None = None
    """Range of each mass as its prior (two standard deviations either way); 5 % either way by default."""
    stiffness_range_n_per_m: tuple[Range, ...] | None = None
    """Range of each stiffness as its prior; 40 % either way by default."""
    modal_damping_ratio: tuple[Positive, ...] | None = None
    """Damping ratio of every mode, in place of `damping_ratio`; as a diagnosis writes it, 1 or more for a mode that does not
    swing."""
    stiffness_correction_n_per_m: Matrix | None = None
    """Stiffness that the structure's form cannot represent, a symmetric matrix; as a diagnosis writes it."""
    story_names: tuple[str, ...] | None = None
    """What each stiffness is, as ``girder 3`` or ``left bearing``; sentences name it beside its number."""
    reference_temperature_degc: float | None = None
    """Temperature at which the stiffnesses are those stated; the recording's mean by default."""

    def structure(self) -> Structure:
        """Make the structure as drawn."""
        raise NotImplementedError

    def drawing(self) -> Drawing:
        """Return what is drawn of the structure where its file has no ``[[nodes]]``."""
        raise NotImplementedError

    def prior_std(self) -> Annotated[Array, "p+N"]:
        """Compute the relative standard deviations of stiffnesses, then masses."""

        def spread(ranges: tuple[Range, ...] | None, values: Array, default: float) -> Array:
            if ranges is None:
                return np.full(values.size, default)
            return np.asarray((np.array(ranges) @ [-1.0, 1.0]) / (4.0 * values))

        structure = self.structure()
        stiffness = spread(self.stiffness_range_n_per_m, structure.stiffness_n_per_m, 0.2)
        return np.concatenate([stiffness, spread(self.masses_range_kg, structure.masses_kg, 0.05)])

    def tolerance(self) -> Annotated[Array, "p+N"]:
        """Return the relative half widths of the stated ranges: stiffnesses, then masses; NaN for none."""
        structure = self.structure()
        stated = [self.stiffness_range_n_per_m is not None, self.masses_range_kg is not None]
        sizes = [structure.stiffness_n_per_m.size, structure.masses_kg.size]
        return np.where(np.repeat(stated, sizes), 2.0 * self.prior_std(), np.nan)

    def correction(self) -> Annotated[Array, "N N"] | None:
        """Return `stiffness_correction_n_per_m` as an array; None where it is not given."""
        if self.stiffness_correction_n_per_m is None:
            return None
        size = self.structure().n_dofs
        return _symmetric("stiffness_correction_n_per_m", self.stiffness_correction_n_per_m, size)

    def modal_damping(self) -> Annotated[Array, "N"] | None:
        """Return `modal_damping_ratio` as an array; None where it is not given."""
        return None if self.modal_damping_ratio is None else np.array(self.modal_damping_ratio)

    def _check_lengths(self, wanted: dict[str, int], what: str) -> None:
        """Check the lengths of the named keys' values, and that every range has its lower end first."""
        for name, n in wanted.items():
            value = getattr(self, name)
            if value is not None and len(value) != n:
                raise ValueError(f"{name} has {len(value)} values for {n} {what}")
        for name in ("masses_range_kg", "stiffness_range_n_per_m"):
            for i, (low, high) in enumerate(getattr(self, name) or ()):
                if low >= high:
                    raise ValueError(f"{name}.{i}: [{low:g}, {high:g}] is no range, the lower end comes first")


class ShearFrameTable(_Drawing):
    """Table of a shear frame, ``kind = "shear_frame"``."""

    kind: Literal["shear_frame"]
    masses_kg: tuple[Positive, ...] = Field(min_length=1)
    """Masses as drawn, floor 1 (the top one) first."""
    story_heights_m: tuple[Positive, ...] | None = None
    """Heights of the stories, for `gravity_softening` and the viewer."""

    @model_validator(mode="after")
    def _same_length(self) -> ShearFrameTable:
        names = ("stiffness_n_per_m", "story_heights_m", "story_names", "masses_range_kg", "stiffness_range_n_per_m")
        self._check_lengths(dict.fromkeys((*names, "modal_damping_ratio"), len(self.masses_kg)), "masses")
        self.correction()
        return self

    def structure(self) -> ShearFrame:
        """Make the structure as drawn."""
        heights = None if self.story_heights_m is None else np.array(self.story_heights_m)
        return ShearFrame(np.array(self.masses_kg), np.array(self.stiffness_n_per_m), self.damping_ratio, heights)

    def drawing(self) -> Drawing:
        """Draw the frame; all stories are equally high where it has no heights."""
        heights = self.story_heights_m
        return Drawing.of_frame(np.ones(len(self.masses_kg)) if heights is None else np.array(heights))


class MatricesTable(_Drawing):
    """Table of a structure given by its matrices, ``kind = "matrices"``: N degrees of freedom, p stiffnesses.

    `monitor.config.matrix_files` reads matrices from files.
    """

    kind: Literal["matrices"]
    mass_matrix: Matrix = Field(min_length=1)
    """Mass matrix, N rows of N, kg."""
    stiffness_matrix: Matrix
    """Stiffness matrix, N rows of N, N/m, at the nominal `stiffness_n_per_m`."""
    stiffness_derivatives: tuple[Matrix, ...]
    """dK / dk_j for each of `stiffness_n_per_m`, N rows of N."""

    @property
    def masses_kg(self) -> tuple[float, ...]:
        """Diagonal of the mass matrix, kg."""
        return tuple(row[i] for i, row in enumerate(self.mass_matrix))

    @property
    def story_heights_m(self) -> None:
        """None: matrices contain no heights."""
        return None

    @model_validator(mode="after")
    def _consistent(self) -> MatricesTable:
        n, p = len(self.mass_matrix), len(self.stiffness_n_per_m)
        names = ("stiffness_derivatives", "story_names", "stiffness_range_n_per_m")
        self._check_lengths(dict.fromkeys(names, p), "stiffnesses")
        mass = _symmetric("mass_matrix", self.mass_matrix, n)
        stiffness = _symmetric("stiffness_matrix", self.stiffness_matrix, n)
        for j, slope in enumerate(self.stiffness_derivatives):
            if not _symmetric(f"stiffness_derivatives.{j}", slope, n).any():
                raise ValueError(f"stiffness_derivatives.{j} is zero: nothing depends on this stiffness")
        for name, matrix in (("mass_matrix", mass), ("stiffness_matrix", stiffness)):
            if np.linalg.eigvalsh(matrix)[0] <= 0:
                raise ValueError(f"{name} is not positive definite")
        self._check_lengths({"masses_range_kg": n, "modal_damping_ratio": n}, "degrees of freedom")
        self.correction()
        return self

    def structure(self) -> MatrixStructure:
        """Make the structure as drawn."""
        n = len(self.mass_matrix)
        return MatrixStructure.create(
            _symmetric("mass_matrix", self.mass_matrix, n),
            _symmetric("stiffness_matrix", self.stiffness_matrix, n),
            np.array([_symmetric("stiffness_derivatives", s, n) for s in self.stiffness_derivatives]),
            np.array(self.stiffness_n_per_m),
            self.damping_ratio,
        )

    def drawing(self) -> Drawing:
        """Draw a list of the stiffnesses: matrices tell no form."""
        return Drawing.of_bars(len(self.stiffness_n_per_m))


class ModalTable(Settings):
    """Table of a structure of which nothing is drawn, ``kind = "modal"``: its modes alone are monitored."""

    kind: Literal["modal"]
    name: str = ""
    """Name of the structure, for people."""


DrawnTable = ShearFrameTable | MatricesTable
StructureTable = Annotated[DrawnTable | ModalTable, Field(discriminator="kind")]


def _symmetric(name: str, rows: Matrix, n: int) -> Array:
    """Check that a matrix is square and symmetric, and remove the asymmetry of rounding."""
    if len(rows) != n or any(len(row) != n for row in rows):
        widths = sorted({len(row) for row in rows})
        raise ValueError(f"{name} has {len(rows)} rows of {', '.join(map(str, widths))} values, not {n} of {n}")
    matrix = np.array(rows)
    if np.abs(matrix - matrix.T).max() > _SYMMETRY_TOLERANCE * np.abs(matrix).max():
        raise ValueError(f"{name} is not symmetric")
    return np.asarray(0.5 * (matrix + matrix.T))
