"""Estimates at their bounds, with intervals that hold: a seeded sample in CI, the whole with `make test-slow`."""

from __future__ import annotations

import numpy as np
import pytest

from tests.statistics.estimates import trials


@pytest.mark.engine
def test_a_sample_lies_near_the_bounds_and_inside_its_intervals() -> None:
    found = trials(1, 12, 0.0, seed=7, processes=1)
    assert found.skipped == 0
    assert found.refined == found.windows == 12
    # Twelve windows share one baseline: a wide net, which an error by half a deviation or a doubled interval still tears.
    assert found.estimates["frequency"].efficiency.mean() < 1.4
    assert found.estimates["stiffness"].efficiency.mean() < 1.4
    assert 0.4 < np.sqrt((found.estimates["ddi"].z ** 2).mean()) < 1.7
    # Read off the window's own 39 segments alone, the stated deviations would scatter by 12 %.
    stated = found.estimates["frequency"].std
    assert (stated.std(axis=0) / stated.mean(axis=0)).mean() < 0.08


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spread", "limits"),
    [
        (0.0, {"frequency": 1.1, "stiffness": 1.15, "ddi": 1.15, "subspace frequency": 1.3, "subspace stiffness": 1.6}),
        (0.35, {"ddi": 1.3}),
    ],
)
def test_intervals_hold_and_errors_meet_their_bounds(spread: float, limits: dict[str, float]) -> None:
    found = trials(100, 20, spread, seed=20261121, keep=True)
    print("\n" + found.report())
    assert found.skipped <= 0.005 * found.windows
    for name in ("frequency", "damping", "stiffness", "ddi"):
        held = found.estimates[name].coverage
        assert (held > 0.93).all() and (held < 0.97).all(), f"{name}: {held}"
    for name, limit in limits.items():
        efficiency = found.estimates[name].efficiency
        assert (efficiency < limit).all(), f"{name}: {efficiency}"
    # Alarms live on the far tail: a normal distribution has 6e-5 beyond four deviations.
    assert (np.abs(found.estimates["ddi"].z) > 4.0).mean() < 1e-3
