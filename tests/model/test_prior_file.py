"""References of baselines of before, which held couplings where they hold eccentricities now."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import block_diag

from monitor.core import Array
from monitor.model import Model, ShearFrame, prior_from_drawing
from monitor.model.effects import UnmodelledMode
from monitor.model.prior_file import from_plain, to_plain

MASSES, CHANNELS = np.array([0.33, 0.35, 0.31]), ("a1", "a2")
FRAME = Model(ShearFrame(MASSES, np.array([2900.0, 1500.0, 1900.0]), damping_ratio=0.01))
MODE = UnmodelledMode("frame", 9.0, 0.012, (1.0, 0.8), 0.6, (0.0, 0.0, 0.0))
COUPLING = np.array([0.1, 0.12, 0.08])


def old_content(ln_frequency: float, coupling: Array) -> dict[str, Any]:
    """Write a reference as a baseline of before holds it."""
    drawn = prior_from_drawing(FRAME, np.full(6, 0.05), n_channels=2, n_modes=1)
    own = [ln_frequency, *MODE.coordinates[1:5], *coupling]
    content = to_plain(
        replace(
            drawn,
            model=replace(drawn.model, effects=(MODE,)),
            mean=np.concatenate([drawn.mean, own]),
            precision=block_diag(drawn.precision, np.diag([1e4, 4.0, 1.0, 1.0, 2.0, 400.0, 900.0, 100.0])),
        )
    )
    assert content is not None
    values = {"frequency_hz": float(np.exp(ln_frequency)), "damping_ratio": 0.012, "shape_1": 1.0, "shape_2": 0.8}
    named = {f"coupling_{j + 1}": float(c) for j, c in enumerate(coupling)}
    return {**content, "effects": [{**content["effects"][0], "parameters": {**values, "force_ratio": 0.6, **named}}]}


def test_couplings_of_a_baseline_become_the_eccentricities_of_the_same_springs() -> None:
    content = old_content(np.log(9.0), COUPLING)
    read = from_plain(content, FRAME, CHANNELS)
    assert read is not None
    (mode,) = read.effects(read.mean)
    assert isinstance(mode, UnmodelledMode)
    springs = -((2.0 * np.pi * 9.0) ** 2) * np.sqrt(MASSES.mean() * MASSES) * COUPLING
    assert FRAME.structure.stiffness_matrix() @ mode.eccentricity == pytest.approx(springs, rel=1e-9)
    # The forces' arms, which such a baseline does not have either, stay what they were.
    assert mode.force_arm == (0.0, 0.0, 0.0)
    assert np.sqrt(np.diag(np.linalg.inv(read.precision)))[-3:] == pytest.approx(1e-6)
    # What is as far from the mean in the old coordinates is as far in the new ones.
    step = 1e-5 * np.array([0.3, 1.0, -2.0, 1.5])
    other, old = from_plain(old_content(np.log(9.0) + step[0], COUPLING + step[1:]), FRAME, CHANNELS), content["mean"]
    assert other is not None
    moved, before = other.mean - read.mean, np.array(content["precision"])
    changed = np.r_[np.zeros(len(old) - 8), step[0], np.zeros(4), step[1:]]
    assert moved @ read.precision @ moved == pytest.approx(changed @ before @ changed, rel=1e-3)
