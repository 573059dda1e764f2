"""Modes of a known structure without error."""

from __future__ import annotations

import numpy as np

from monitor.config import Configuration
from monitor.core import ModalEstimate
from monitor.model import Model, ShearFrame, parse_effect
from tests.support.frames import shear_frame
from tests.support.results import modal_estimate

MASSES = np.array([0.3253, 0.3514, 0.3129])
STIFFNESS = np.array([2909.4511, 1514.8507, 1897.6986])
HEIGHTS = [0.093, 0.093, 0.1]
JOINTS = (parse_effect("joint_flexibility:frame:girder_to_column_ratio=10"),)


def truth(loss: tuple[float, float, float], effects: tuple = JOINTS) -> Model:
    return Model(ShearFrame(MASSES, STIFFNESS * (1 - np.array(loss)), 0.01, np.array(HEIGHTS)), effects)


def drawing(signs: tuple[int, int, int], **processing: float) -> Configuration:
    masses, stiffness = MASSES * (1 + 0.05 * np.array(signs)), [2251.8509, 2251.8509, 1811.292]
    return shear_frame(masses, stiffness, structure={"story_heights_m": HEIGHTS}, processing=processing)


def exact_modes(model: Model) -> ModalEstimate:
    """Modes without error, weighted as a 400 s record would be."""
    modes = model.modes()
    shapes = modes.shapes.T / np.take_along_axis(modes.shapes.T, abs(modes.shapes.T).argmax(axis=1)[:, None], axis=1)
    deviations = np.zeros((3 * 8, 3, 8))
    for row, (mode, column) in enumerate(np.ndindex(3, 8)):
        deviations[row, mode, column] = (9e-4, 5e-4, 5e-4)[mode] if column == 0 else 3e-3
    return modal_estimate(modes.frequencies_hz, shapes, deviations=deviations, order=10)
