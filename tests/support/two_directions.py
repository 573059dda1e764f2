"""Modes of a building that moves along two axes."""

from __future__ import annotations

import numpy as np

from monitor.model import MatrixStructure, Model


def two_directions(stiffness: np.ndarray) -> Model:
    """Two stories that sway along x (floors 1, 2) and along y (3, 4), each for itself."""
    slopes = np.zeros((4, 4, 4))
    for j, place in enumerate((slice(0, 2), slice(1, 2), slice(2, 4), slice(3, 4))):
        slopes[j, place, place] = [[1.0, -1.0], [-1.0, 1.0]] if j % 2 == 0 else 1.0
    structure = MatrixStructure.create(
        0.3 * np.eye(4), np.tensordot(stiffness, slopes, axes=1), slopes, stiffness, 0.01
    )
    return Model(structure)


HEALTHY = np.array([775.0, 775.0, 838.0, 838.0])
