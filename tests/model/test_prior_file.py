"""The reference in a baseline's file: modes that the model lacks come back; parameters that are missing are refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag

from monitor.model import Model, ShearFrame, prior_from_drawing
from monitor.model.effects import UnmodelledMode
from monitor.model.prior_file import prior_content, read_prior

FRAME = Model(ShearFrame(np.array([0.33, 0.35, 0.31]), np.array([2900.0, 1500.0, 1900.0]), damping_ratio=0.01))
MODE = UnmodelledMode("frame", 9.0, 0.012, (1.0, 0.8), 0.6, (-0.04, 0.02, 0.01), (0.0, 0.1, 0.2))


def test_a_mode_comes_back_with_its_eccentricities_and_arms_and_without_them_is_refused() -> None:
    drawn = prior_from_drawing(FRAME, np.full(6, 0.05), n_channels=2, n_modes=1)
    prior = replace(
        drawn,
        model=replace(drawn.model, effects=(MODE,)),
        mean=np.concatenate([drawn.mean, MODE.coordinates]),
        precision=block_diag(drawn.precision, np.diag(np.arange(1.0, MODE.coordinates.size + 1.0))),
    )
    content = prior_content(prior)
    read = read_prior(content, FRAME, ("a1", "a2"))
    (mode,) = read.effects(read.mean)
    assert mode.values() == pytest.approx(MODE.values())
    np.testing.assert_array_equal(read.mean, prior.mean)
    np.testing.assert_array_equal(read.precision, prior.precision)
    for lacks in ("force_arm", "eccentricity"):
        values = {k: v for k, v in content["effects"][0]["parameters"].items() if not k.startswith(lacks)}
        n = len(values) - MODE.coordinates.size
        less = {"effects": [content["effects"][0] | {"parameters": values}], "mean": content["mean"][:n]}
        less["precision"] = [row[:n] for row in content["precision"][:n]]
        with pytest.raises((ValueError, KeyError)):
            read_prior(content | less, FRAME, ("a1", "a2"))
