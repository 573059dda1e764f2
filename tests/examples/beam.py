"""A beam of bending elements as a structure file: a bridge on two bearings or a mast clamped at its foot.

python -m tests.examples.beam bridge.toml
python -m tests.examples.beam mast.toml
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np


def element(length_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return stiffness and mass of a bending element with E I = 1 and 1 kg/m, for sway and rotation of both ends."""
    h = length_m
    stiffness = np.array([[12, 6 * h, -12, 6 * h], [6 * h, 4 * h**2, -6 * h, 2 * h**2],
                          [-12, -6 * h, 12, -6 * h], [6 * h, 2 * h**2, -6 * h, 4 * h**2]]) / h**3  # fmt: skip
    mass = np.array([[156, 22 * h, 54, -13 * h], [22 * h, 4 * h**2, 13 * h, -3 * h**2],
                     [54, 13 * h, 156, -22 * h], [-13 * h, -3 * h**2, -22 * h, 4 * h**2]]) * h / 420  # fmt: skip
    return stiffness, mass


def write_beam(
    path: Path, n: int, length_m: float, bending_n_m2: float, kg_per_m: float, *, clamped: bool = False
) -> None:
    """Write a beam of `n` elements, whose E I are watched; a sensor is at every node that is not held.

    Node 0 is the left bearing, or the foot of a mast (`clamped`).  Degrees of freedom are the sways first, then the rotations.
    """
    held = {0, 1} if clamped else {0, 2 * n}  # of sway and rotation of node 0, of node 1, ..
    free = [i for i in (*range(0, 2 * n + 2, 2), *range(1, 2 * n + 2, 2)) if i not in held]
    stiffness, mass = element(length_m / n)
    slopes, whole = np.zeros((n, 2 * n + 2, 2 * n + 2)), np.zeros((2 * n + 2, 2 * n + 2))
    for j in range(n):
        slopes[j, 2 * j : 2 * j + 4, 2 * j : 2 * j + 4] = stiffness
        whole[2 * j : 2 * j + 4, 2 * j : 2 * j + 4] += kg_per_m * mass
    slopes = slopes[:, free][:, :, free]
    np.savez(path.with_suffix(".npz"), mass_matrix=whole[np.ix_(free, free)], stiffness_derivatives=slopes,
             stiffness_matrix=bending_n_m2 * slopes.sum(axis=0))  # fmt: skip
    file = f'"{path.stem}.npz"'
    text = f"""[structure]
kind = "matrices"
name = "{path.stem}"
mass_matrix = {file}
stiffness_matrix = {file}
stiffness_derivatives = {file}
stiffness_n_per_m = {[bending_n_m2] * n}
story_names = {[f"element {j}" for j in range(1, n + 1)]}
""".replace("'", '"')
    along, sway = ("z", "dof_x") if clamped else ("x", "dof_z")
    for i in range(n + 1):
        text += f"\n[[nodes]]\n{along} = {i * length_m / n:g}\n"
        if 2 * i in free:
            text += f"{sway} = {free.index(2 * i) + 1}\n"
    for j in range(1, n + 1):
        text += f"\n[[lines]]\nnodes = [{j}, {j + 1}]\nstory = {j}\n"
    for i in range(n + 1):
        if 2 * i in free:
            text += f'\n[[sensors]]\nchannel = "a{free.index(2 * i) + 1}"\nfloor = {free.index(2 * i) + 1}\n'
    path.write_text(text, encoding="utf-8")


def bridge(path: Path) -> None:
    """Write a bridge of 30 m on two bearings: 6 elements, 12 degrees of freedom, 5 sensors."""
    write_beam(path, 6, length_m=30.0, bending_n_m2=8e9, kg_per_m=3000.0)


def mast(path: Path) -> None:
    """Write a mast of 24 m that is clamped at its foot: 4 elements, 8 degrees of freedom, 4 sensors."""
    write_beam(path, 4, length_m=24.0, bending_n_m2=4e8, kg_per_m=250.0, clamped=True)


if __name__ == "__main__":
    file = Path(sys.argv[1])
    {"bridge": bridge, "mast": mast}[file.stem](file)
