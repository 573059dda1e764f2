"""The test of constancy on fits of which all is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from tests.hidden.constancy import Constancy, Linear, constancy

ROWS, P, BLOCKS = 600, 5, 6


def fitted(seed: int, deviation: float = 0.0) -> tuple[Linear, float]:
    """A linear fit of unit noise, and its size; coordinate 0 is 1, and deviates from block to block."""
    rng = np.random.default_rng(seed)
    slopes = rng.standard_normal((ROWS, P))
    slopes[:, 0] += 0.5 * slopes[:, 1]
    block = np.arange(ROWS) * BLOCKS // ROWS
    size = 1.0 + deviation * rng.standard_normal(BLOCKS)
    data = slopes[:, 0] * size[block] + rng.standard_normal(ROWS)
    covariance = np.linalg.inv(slopes.T @ slopes)
    x = covariance @ slopes.T @ data
    return Linear(slopes, data - slopes @ x, covariance, np.arange(ROWS), block), float(x[0])


def judged(seed: int, deviation: float = 0.0) -> tuple[Constancy, float]:
    """Its constancy, and the error of the common size over its standard deviation."""
    fit, size = fitted(seed, deviation)
    found = constancy(fit, 0, fit.classes)
    return found, (size + found.change - 1.0) / found.std


def test_a_right_model_is_rejected_as_often_as_stated() -> None:
    found = [judged(seed)[0] for seed in range(1000)]
    rejected = np.mean([chi2.sf(one.statistic, one.rank) < 0.05 for one in found])
    assert 0.03 < rejected < 0.07
    assert {one.rank for one in found} == {BLOCKS - 1}


@pytest.mark.parametrize("deviation", [0.0, 0.3])
def test_intervals_hold_what_differs_between_blocks(deviation: float) -> None:
    errors = np.abs([judged(seed, deviation)[1] for seed in range(400)])
    assert np.mean(errors < 1.96) > 0.9


def test_a_right_model_loses_little() -> None:
    fit, _ = fitted(3)
    assert constancy(fit, 0, fit.classes).std < 1.5 * np.sqrt(fit.covariance[0, 0])


def test_ranges_hold_equal_efficient_information() -> None:
    fit, _ = fitted(4)
    parts = np.bincount(fit.ranges(0), fit.efficient(0))
    assert parts == pytest.approx(parts.mean(), rel=0.2)
