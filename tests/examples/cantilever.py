"""A structure without code of its own: a cantilever's matrices, from whatever program makes them, in a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def write_cantilever(path: Path, n: int = 4, height_m: float = 2.0, stiffness_n_m2: float = 900.0) -> None:
    """A mast with `n` lumped masses; its parameters are the bending stiffnesses E I of its lower and upper half.

    Forces at the masses move them by the flexibility of a clamped beam, whose inverse is K.  dK / d(E I) of a part is
    found by taking that part 1 % stiffer.
    """
    at = height_m * np.arange(n, 0, -1) / n  # degree of freedom 1 is the top
    parts = np.array([stiffness_n_m2, stiffness_n_m2])

    def stiffness(parts: np.ndarray) -> np.ndarray:
        x = np.linspace(0.0, height_m, 2001)
        bending = np.clip(at[:, None] - x, 0.0, None)  # moment of a unit force at each mass
        rigidity = np.where(x < 0.5 * height_m, parts[0], parts[1])
        return np.linalg.inv(np.trapezoid(bending[:, None] * bending / rigidity, x, axis=2))

    whole = stiffness(parts)
    slopes = [(stiffness(parts * (1.0 + 0.01 * row)) - whole) / (0.01 * stiffness_n_m2) for row in np.eye(2)]
    np.savez(
        path.with_suffix(".npz"), mass_matrix=0.5 * np.eye(n), stiffness_matrix=whole, stiffness_derivatives=slopes
    )
    sensors = "".join(f'\n[[sensors]]\nchannel = "x{i}"\nfloor = {i}\n' for i in range(1, n + 1))
    path.write_text(
        f"""[structure]
kind = "matrices"
mass_matrix = "{path.stem}.npz"
stiffness_matrix = "{path.stem}.npz"
stiffness_derivatives = "{path.stem}.npz"
stiffness_n_per_m = [{stiffness_n_m2}, {stiffness_n_m2}]
story_names = ["lower half", "upper half"]
{sensors}""",
        encoding="utf-8",
    )
