"""Steps of a fit."""

from __future__ import annotations

import numpy as np
import pytest

from monitor.inference.map_estimate import maximize_posterior, shortened_steps
from tests.support.turning_frame import posterior


def test_a_long_step_is_shortened_in_two_ways() -> None:
    at = posterior(np.ones(3))
    step = np.zeros(at.layout.n_nuisance)
    step[at.layout.stiffness], step[at.layout.forces] = 1.0, 0.5
    bounded, scaled = shortened_steps(at, step, ())
    assert bounded[at.layout.forces] == pytest.approx(0.5) and scaled[at.layout.forces] == pytest.approx(0.05)
    assert bounded[at.layout.stiffness] == pytest.approx(0.1) == scaled[at.layout.stiffness]
    assert len(shortened_steps(at, 0.1 * step, ())) == 1


def test_a_fit_that_begins_at_no_structure_has_no_likelihood() -> None:
    at = posterior(np.ones(3))
    nowhere = np.zeros(at.layout.n_nuisance)
    nowhere[at.layout.stiffness] = 800.0  # the logarithm: beyond all numbers
    with np.errstate(over="ignore", invalid="ignore"):
        found = maximize_posterior(at, nowhere)
    assert found.log_posterior == -np.inf
    assert not found.converged
