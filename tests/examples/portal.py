"""A portal frame by its matrices: two columns and a girder that bend, so that the joints rotate.

python -m tests.examples.portal portal.toml
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from tests.examples.beam import element

HEIGHT_M, SPAN_M, PARTS = 4.0, 6.0, 2
"""The left column, the right one and the girder are of two elements each."""
BENDING_N_M2 = (4e7, 4e7, 6e7)
KG_PER_M = (150.0, 150.0, 3000.0)
"""With the floor that the girder carries."""


def write_portal(path: Path) -> None:
    """Write the frame: three stiffnesses, the E I of left column, right column and girder.

    Degrees of freedom 1 sway of the girder, 2, 3 sway of the middles of the columns, 4 sag of the girder's middle, then the
    rotations of the two middles, of the two joints and of the girder's middle.  Members do not stretch, and feet are clamped.
    """
    members = [  # sway and rotation at both ends of each element, -1 for a clamped end, and its number
        (0, (-1, -1, 1, 4)), (0, (1, 4, 0, 6)), (1, (-1, -1, 2, 5)), (1, (2, 5, 0, 7)), (2, (-1, 6, 3, 8)), (2, (3, 8, -1, 7)),
    ]  # fmt: skip
    n = 9
    slopes, mass = np.zeros((3, n + 1, n + 1)), np.zeros((n + 1, n + 1))
    for number, dofs in members:
        stiffness, inertia = element((SPAN_M if number == 2 else HEIGHT_M) / PARTS)
        # A rotation dx/dz of a joint is -dz/dx for the girder.
        turn = np.outer(*2 * [[1.0, -1.0, 1.0, -1.0] if number == 2 else np.ones(4)])
        slopes[number][np.ix_(dofs, dofs)] += (
            turn * stiffness
        )  # what is clamped goes into the last row, which is dropped
        mass[np.ix_(dofs, dofs)] += turn * KG_PER_M[number] * inertia
    slopes, mass = slopes[:, :n, :n], mass[:n, :n]
    mass[0, 0] += KG_PER_M[2] * SPAN_M  # the girder sways as one
    whole = np.tensordot(BENDING_N_M2, slopes, axes=1)
    np.savez(path.with_suffix(".npz"), mass_matrix=mass, stiffness_matrix=whole, stiffness_derivatives=slopes)
    file = f'"{path.stem}.npz"'
    text = f"""[structure]
kind = "matrices"
name = "{path.stem}"
mass_matrix = {file}
stiffness_matrix = {file}
stiffness_derivatives = {file}
stiffness_n_per_m = {list(BENDING_N_M2)}
story_names = ["left column", "right column", "girder"]
"""
    nodes = ["", "z = 2.0\ndof_x = 2", "z = 4.0\ndof_x = 1", "x = 3.0\nz = 4.0\ndof_x = 1\ndof_z = 4",
             "x = 6.0\nz = 4.0\ndof_x = 1", "x = 6.0\nz = 2.0\ndof_x = 3", "x = 6.0"]  # fmt: skip
    text += "".join(f"\n[[nodes]]\n{node}\n" for node in nodes)
    for i, story in enumerate((1, 1, 3, 3, 2, 2), start=1):
        text += f"\n[[lines]]\nnodes = [{i}, {i + 1}]\nstory = {story}\n"
    text += "".join(f'\n[[sensors]]\nchannel = "a{i}"\nfloor = {i}\n' for i in range(1, 5))
    path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    write_portal(Path(sys.argv[1]))
