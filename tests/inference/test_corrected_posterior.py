"""Laws that cannot stand, and motion that is not stationary, have no likelihood."""

from __future__ import annotations

import numpy as np
import pytest

from monitor.inference.corrected_posterior import bound_corrections
from monitor.inference.linearization import forced_motion
from monitor.model import parse_effect
from tests.diagnosis.jointed_frame import posed

pytestmark = pytest.mark.engine


def test_a_law_that_cannot_stand_has_no_likelihood() -> None:
    unknown = np.full((1, 2, 3, 3), np.nan, dtype=complex)
    deep = -2.0 * np.eye(3) + np.zeros((1, 2, 3, 3), dtype=complex)
    both = bound_corrections(np.concatenate([unknown, deep]))
    assert np.isnan(both[0]).all()
    assert np.linalg.eigvalsh(both[1]) == pytest.approx(-0.85 * np.ones((2, 3)))


def test_a_trial_step_without_stationary_motion_has_none_and_no_warning() -> None:
    law = parse_effect("cubic_stiffness:story 2:k3_n_per_m3=1e8")
    problem, null = posed(law)
    x = null.x.copy()
    assert (forced_motion(problem, x, (law,), [law]) > 0.0).all()
    x[problem.layout.damping] += 60.0  # so overdamped that the slow poles round to 0
    with np.errstate(divide="raise"):
        assert np.isnan(forced_motion(problem, x, (law,), [law])).all()
