"""Table ``[structure]`` of a structure file, by its ``kind``: the structure as drawn, not as it is."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, PrivateAttr, model_validator
from typing_extensions import override

from monitor.core import DIRECTION_WORDS, Array, Settings, floor_name
from monitor.model.structures.base import Structure
from monitor.model.structures.building import DIRECTIONS, Building, Direction, frames_at_edges
from monitor.model.structures.drawing import Drawing
from monitor.model.structures.matrices import MatrixStructure
from monitor.model.structures.shear_frame import ShearFrame

Positive = Annotated[float, Field(gt=0, le=1e30)]
"""Positive number; the square of one above the limit could exceed the range of a float."""
Range = tuple[Positive, Positive]
Matrix = tuple[tuple[float, ...], ...]
_SYMMETRY_TOLERANCE = 1e-6
"""Largest asymmetry of a matrix that counts as symmetric. [ratio; rounding]"""
_TORSION_STD = 0.5
"""Relative standard deviation of a storey's stiffness about z by frames at the edges. [ratio; derivation: frames spread over the
plan have a third, a stiff core less: a factor of two to three either way is two standard deviations]"""


class _Drawing(Settings):
    """Keys that every kind of structure has."""

    name: str = ""
    """Name of the structure, for people."""
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
    reference_temperature_degc: float | None = None
    """Temperature at which the stiffnesses are those stated; the recording's mean by default."""

    def structure(self) -> Structure:
        """Make the structure as drawn."""
        raise NotImplementedError

    @property
    def names(self) -> tuple[str, ...]:
        """What people call each stiffness."""
        raise NotImplementedError

    def default_std(self) -> Annotated[Array, "p"]:
        """Return the relative standard deviations of stiffnesses without a stated range."""
        return np.full(self.structure().n_stories, 0.2)

    def drawing(self) -> Drawing:
        """Return what is drawn of the structure where its file has no ``[[nodes]]``."""
        raise NotImplementedError

    def prior_std(self) -> Annotated[Array, "p+b"]:
        """Compute the relative standard deviations of stiffnesses, then masses."""

        def spread(ranges: tuple[Range, ...] | None, values: Array, default: Array) -> Array:
            if ranges is None:
                return default
            return np.asarray((np.array(ranges) @ [-1.0, 1.0]) / (4.0 * values))

        structure = self.structure()
        stiffness = spread(self.stiffness_range_n_per_m, structure.stiffness_n_per_m, self.default_std())
        masses = spread(self.masses_range_kg, structure.masses_kg, np.full(structure.n_masses, 0.05))
        return np.concatenate([stiffness, masses])

    def tolerance(self) -> Annotated[Array, "p+b"]:
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


class _Numbered(_Drawing):
    """Keys of a structure whose stiffnesses are a list."""

    stiffness_n_per_m: tuple[Positive, ...] = Field(min_length=1)
    """Stiffnesses as drawn, story 1 (the top one) first."""
    story_names: tuple[str, ...] | None = None
    """What each stiffness is, as ``girder 3`` or ``left bearing``; sentences name it beside its number."""

    _counted: ClassVar[str] = ""
    """Whence stories without a name are counted, in words."""

    @property
    @override
    def names(self) -> tuple[str, ...]:
        n, names = len(self.stiffness_n_per_m), self.story_names
        return tuple(f"story {j}" + (f" ({names[j - 1]})" if names else self._counted) for j in range(1, n + 1))


class ShearFrameTable(_Numbered):
    """Table of a shear frame, ``kind = "shear_frame"``."""

    kind: Literal["shear_frame"]
    _counted: ClassVar[str] = " from the top"
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


class MatricesTable(_Numbered):
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


class StoreyTable(Settings):
    """``[[storeys]]``: one storey of a building and the floor above it; they stand from the ground up."""

    name: str = ""
    """What people call the storey; sentences name it beside its number."""
    mass_kg: Positive
    """Mass of the floor above."""
    height_m: Positive = 3.0
    """Height, for the drawing and for drifts over the height."""
    plan_m: tuple[Positive, Positive]
    """Length along x and width along y of the floor above, for its rotary inertia."""
    stiffness_x_n_per_m: Positive
    """Stiffness along x as drawn."""
    stiffness_y_n_per_m: Positive
    """Stiffness along y as drawn."""
    stiffness_z_nm_per_rad: Positive | None = None
    """Stiffness about z as drawn; by default that of frames at the edges of the plan, known within a factor of about two."""
    eccentricity_m: tuple[float, float] = (0.0, 0.0)
    """Place of the floor's centre of mass, along x and y from the centre of stiffness, which is the plan's middle."""


class BuildingTable(_Drawing):
    """Table of a building, ``kind = "building"``; its ``[[storeys]]`` stand beside it."""

    kind: Literal["building"]
    ground_axis: Literal["x", "y"] = "x"
    """Direction of the motion on ``/acceleration/ground``."""
    _storeys: tuple[StoreyTable, ...] = PrivateAttr(default=())
    _directions: tuple[Direction, ...] = PrivateAttr(default=DIRECTIONS)

    def completed(self, storeys: tuple[StoreyTable, ...], axis: Literal["x", "y"] | None) -> BuildingTable:
        """Return the table with its storeys; with an axis that of a building which moves along it alone.

        Raises ValueError if the storeys are missing or do not fit.
        """
        out, ranges, n = self.model_copy(), self.stiffness_range_n_per_m, len(storeys)
        if axis is not None and ranges is not None and len(ranges) == 3 * n:
            first = DIRECTIONS.index(axis) * n
            out = self.model_copy(update={"stiffness_range_n_per_m": ranges[first : first + n]})
        out._storeys, out._directions = storeys, DIRECTIONS if axis is None else (axis,)
        out._check()
        return out

    def _check(self) -> None:
        """Check that the storeys and the keys fit each other."""
        n = len(self._storeys)
        if not n:
            raise ValueError('storeys: kind = "building" needs its [[storeys]], from the ground up')
        of_all = dict.fromkeys(("stiffness_range_n_per_m", "modal_damping_ratio"), n * len(self._directions))
        self._check_lengths({"masses_range_kg": n}, "storeys")
        self._check_lengths(of_all, "storeys in their directions")
        for i, storey in enumerate(self._storeys):
            if (2.0 * np.abs(storey.eccentricity_m) >= storey.plan_m).any():
                raise ValueError(f"storeys.{i}.eccentricity_m: the centre of mass lies outside the plan")
        self.correction()

    @property
    def masses_kg(self) -> tuple[float, ...]:
        """Mass of each floor, the lowest first, kg."""
        return tuple(storey.mass_kg for storey in self._storeys)

    @property
    def stiffness_n_per_m(self) -> tuple[float, ...]:
        """Stiffnesses as drawn, in the order of `Building`."""
        return tuple(self.structure().stiffness_n_per_m.tolist())

    @property
    def story_heights_m(self) -> tuple[float, ...]:
        """Height of each storey, the lowest first, m."""
        return tuple(storey.height_m for storey in self._storeys)

    def structure(self) -> Building:
        """Make the structure as drawn."""
        plan = np.array([s.plan_m for s in self._storeys])
        along = {"x": np.array([s.stiffness_x_n_per_m for s in self._storeys])}
        along["y"] = np.array([s.stiffness_y_n_per_m for s in self._storeys])
        at_edges = frames_at_edges(along["x"], along["y"], plan)
        stated = (s.stiffness_z_nm_per_rad for s in self._storeys)
        along["torsion"] = np.array([edge if k is None else k for k, edge in zip(stated, at_edges, strict=True)])
        return Building(
            np.array(self.masses_kg),
            np.concatenate([along[d] for d in self._directions]),
            self.damping_ratio,
            plan,
            np.array([s.eccentricity_m for s in self._storeys]),
            self._directions,
            self.ground_axis,
            np.array(self.story_heights_m),
        )

    @override
    def default_std(self) -> Array:
        known = [s.stiffness_z_nm_per_rad is not None for s in self._storeys]
        std = {d: np.full(len(known), 0.2) for d in DIRECTIONS}
        std["torsion"] = np.where(known, 0.2, _TORSION_STD)
        return np.concatenate([std[d] for d in self._directions])

    @property
    @override
    def names(self) -> tuple[str, ...]:
        between = [f"{floor_name(j)} to {floor_name(j + 1)} floor" for j in range(len(self._storeys))]
        between[0] = f"ground to {floor_name(1)} floor"
        own = [", ".join(filter(None, (s.name, b))) for s, b in zip(self._storeys, between, strict=True)]
        return tuple(
            f"storey {j} ({name}), {DIRECTION_WORDS[d]}" for d in self._directions for j, name in enumerate(own, 1)
        )

    def drawing(self) -> Drawing:
        """Draw the storeys by their plans and heights."""
        return Drawing.of_building(self.structure(), np.array(self.story_heights_m))


class ModalTable(Settings):
    """Table of a structure of which nothing is drawn, ``kind = "modal"``: its modes alone are monitored."""

    kind: Literal["modal"]
    name: str = ""
    """Name of the structure, for people."""


DrawnTable = ShearFrameTable | MatricesTable | BuildingTable
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
