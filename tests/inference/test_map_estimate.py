"""Steps of a fit."""

from __future__ import annotations

import numpy as np
import pytest

from monitor.inference.map_estimate import maximize_posterior, shortened_steps
from monitor.inference.starting_point import guess_levels
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


@pytest.mark.parametrize(
    ("group", "off"), [("forces", 0.5), ("forces", 1.0), ("damping", -2.0), ("damping", 0.5), ("noise", 1.0)]
)
def test_a_step_bends_along_a_curved_valley(monkeypatch: pytest.MonkeyPatch, group: str, off: float) -> None:
    """Spectra are exponential in these logarithms."""
    at = posterior(np.ones(3))
    x, ratio = guess_levels(at)
    x[at.layout.forces], x[at.layout.levels] = at.first_levels(ratio)
    x[getattr(at.layout, group)] += off
    bent = maximize_posterior(at, x, iterations=2)
    monkeypatch.setattr("monitor.inference.map_estimate._bent", lambda _, __, ___, step, ____: step)
    assert bent.log_posterior > maximize_posterior(at, x, iterations=2).log_posterior + 5.0
