"""A structure from a finite element program: a three-story frame of OpenSeesPy, its matrices condensed, as a structure file.

Run: ``python -m tests.examples.opensees_frame frame.toml``.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import openseespy.opensees as ops

from monitor.model.structures import condense_massless

STORIES, HEIGHT_M, SPAN_M = 3, 3.5, 6.0
MASS_KG, MODULUS_PA, AREA_M2 = 20e3, 210e9, 0.012
COLUMN_M4, GIRDER_M4 = 8e-5, 2.5e-4
"""Second moments of area of a column and of a girder."""


def build(columns: Sequence[float] = (1.0, 1.0, 1.0)) -> None:
    """Build the frame in OpenSees: story j (1 = top) has columns of `columns[j - 1]` times their nominal inertia.

    Nodes 1 and 2 are the feet, 3 and 4 the lowest floor.  A floor's mass moves sideways with its left node, to which the right
    one is tied.  No mass turns or moves up and down, so five of a floor's six degrees of freedom have none or are tied.
    """
    ops.wipe()
    ops.model("basic", "-ndm", 2, "-ndf", 3)
    ops.geomTransf("Linear", 1)
    for level in range(STORIES + 1):
        left, right = 2 * level + 1, 2 * level + 2
        ops.node(left, 0.0, HEIGHT_M * level)
        ops.node(right, SPAN_M, HEIGHT_M * level)
        if level == 0:
            ops.fix(left, 1, 1, 1)
            ops.fix(right, 1, 1, 1)
            continue
        ops.mass(left, MASS_KG, 0.0, 0.0)
        ops.equalDOF(left, right, 1)
        inertia = COLUMN_M4 * columns[STORIES - level]
        for side in (left, right):
            ops.element("elasticBeamColumn", 10 * level + side, side - 2, side, AREA_M2, MODULUS_PA, inertia, 1)
        ops.element("elasticBeamColumn", 1000 + level, left, right, AREA_M2, MODULUS_PA, GIRDER_M4, 1)


def matrices() -> tuple[np.ndarray, np.ndarray]:
    """Take mass and stiffness matrix of the model that is built, shape (N, N), kg and N/m (N, and Nm of rotations)."""
    ops.wipeAnalysis()
    ops.system("FullGeneral")
    ops.numberer("Plain")
    ops.constraints("Transformation")
    ops.algorithm("Linear")
    found = []
    for factors in ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)):
        ops.integrator("GimmeMCK", *factors)  # the matrix to be solved is this mixture of M, C and K
        ops.analysis("Transient")
        ops.analyze(1, 0.0)
        size = ops.systemSize()
        found.append(np.array(ops.printA("-ret")).reshape(size, size))
    return found[0], found[1]


def frequencies_hz() -> np.ndarray:
    """Ask OpenSees itself for the natural frequencies, Hz."""
    return np.sqrt(ops.eigen("-fullGenLapack", STORIES)) / (2.0 * np.pi)


def write_structure(path: Path) -> np.ndarray:
    """Write the structure file and return the frequencies that OpenSees gives, Hz."""
    build()
    mass, stiffness = matrices()
    own_hz = frequencies_hz()
    equations = [ops.nodeDOFs(2 * level + 1)[0] for level in range(STORIES, 0, -1)]
    # K is linear in the columns' inertia: the difference to doubled columns is the derivative by that factor.
    nominal = 2 * 12.0 * MODULUS_PA * COLUMN_M4 / HEIGHT_M**3
    slopes = []
    for story in range(STORIES):
        build([2.0 if k == story else 1.0 for k in range(STORIES)])
        slopes.append((matrices()[1] - stiffness) / nominal)
    mass, stiffness, condensed, kept = condense_massless(mass, stiffness, np.array(slopes))
    order = [list(kept).index(equation) for equation in equations]  # degree of freedom 1 is the top
    square = np.ix_(order, order)
    np.savez(
        path.with_suffix(".npz"),
        mass_matrix=mass[square],
        stiffness_matrix=stiffness[square],
        stiffness_derivatives=condensed[:, square[0], square[1]],
    )
    sensors = "".join(f'\n[[sensors]]\nchannel = "a{i}"\nfloor = {i}\n' for i in range(1, STORIES + 1))
    path.write_text(
        f"""[structure]
kind = "matrices"
name = "three-story frame from OpenSees"
mass_matrix = "{path.stem}.npz"
stiffness_matrix = "{path.stem}.npz"
stiffness_derivatives = "{path.stem}.npz"
stiffness_n_per_m = {[nominal] * STORIES}
story_names = ["columns of story 1", "columns of story 2", "columns of story 3"]
damping_ratio = 0.02
{sensors}""",
        encoding="utf-8",
    )
    return own_hz


if __name__ == "__main__":
    print("OpenSees:", *(f"{f:.6f} Hz" for f in write_structure(Path(sys.argv[1]))))
