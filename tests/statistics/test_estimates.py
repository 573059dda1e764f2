"""Estimates at their bounds, with intervals that hold: a seeded sample in CI, the whole with `make test-slow`."""

from __future__ import annotations

import numpy as np
import pytest

from tests.statistics.estimates import FREQUENCY_BOUND, STIFFNESS_BOUND, trials


def test_a_sample_lies_near_the_bounds_and_inside_its_intervals() -> None:
    errors = trials(1, 12, 0.0, seed=7, processes=1)
    assert errors.skipped == 0
    # Twelve windows share one baseline: a wide net, which an error by half a deviation or a doubled interval still tears.
    assert np.sqrt((errors.frequency**2).mean(axis=0) / FREQUENCY_BOUND**2).mean() < 1.5
    z = errors.ddi / errors.ddi_std
    assert 0.4 < np.sqrt((z**2).mean()) < 1.7


@pytest.mark.slow
@pytest.mark.parametrize(("spread", "efficiency"), [(0.0, 1.15), (0.35, 1.3)])
def test_intervals_hold_and_errors_meet_their_bounds(spread: float, efficiency: float) -> None:
    errors = trials(100, 20, spread, seed=20261121)
    print("\n" + errors.report())
    assert errors.skipped <= 0.005 * 2000
    for name in ("frequency", "damping", "ddi"):
        held = errors.coverage(name)
        assert (held > 0.93).all() and (held < 0.97).all(), f"{name}: {held}"
    index_bound = STIFFNESS_BOUND * np.sqrt(1.0 + 400.0 / 1200.0)
    assert (np.sqrt((errors.ddi**2).mean(axis=0)) / index_bound < efficiency).all()
