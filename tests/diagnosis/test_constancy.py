"""What ranges of frequency say together of a coordinate, on fits of which all is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from monitor.diagnosis.constancy import CommonSize, LinearFit

ROWS, P, RANGES = 600, 5, 6


def fitted(seed: int, deviation: float = 0.0, size: float = 1.0, noise: float = 1.0) -> tuple[CommonSize, float]:
    """A linear fit of noise; coordinate 0 deviates from range to range by `deviation`.  Return its common size and the fitted."""
    rng = np.random.default_rng(seed)
    slopes = rng.standard_normal((ROWS, P))
    slopes[:, 0] += 0.5 * slopes[:, 1]
    block = np.arange(ROWS) * RANGES // ROWS
    sizes = size + deviation * rng.standard_normal(RANGES)
    data = slopes[:, 0] * sizes[block] + noise * rng.standard_normal(ROWS)
    covariance = np.linalg.inv(slopes.T @ slopes)
    x = covariance @ slopes.T @ data
    return LinearFit(slopes, data - slopes @ x, covariance, np.arange(ROWS)).common_size(0), float(x[0])


def test_a_right_model_is_rejected_as_often_as_stated() -> None:
    found = [fitted(seed)[0] for seed in range(1000)]
    rejected = np.mean([chi2.sf(one.statistic, one.rank) < 0.05 for one in found])
    assert 0.03 < rejected < 0.07
    assert {one.rank for one in found} == {RANGES - 1}


@pytest.mark.parametrize(
    ("deviation", "noise", "least"), [(0.0, 1.0, 0.93), (0.3, 1.0, 0.9), (1.0, 1.0, 0.9), (0.0, np.sqrt(30.0), 0.9)]
)
def test_intervals_hold_what_the_model_does_not_know(deviation: float, noise: float, least: float) -> None:
    """Sizes that differ by three and ten times their error in a range, and spectra whose variance is wrong by a factor of 30."""
    found = [fitted(seed, deviation, noise=noise) for seed in range(500)]
    errors = np.array([(x - 1.0) / common.std for common, x in found])
    assert least < np.mean(np.abs(errors) < 1.96) < 0.98


@pytest.mark.parametrize(("deviation", "noise"), [(0.0, 1.0), (0.3, 1.0), (1.0, 1.0), (0.0, np.sqrt(30.0))])
def test_what_is_not_there_is_hardly_ever_certain(deviation: float, noise: float) -> None:
    """Once in a hundred by chance 0.5 % of either sign; the seeds allow for three times that."""
    chances = [common.chance_of_none(x) for common, x in (fitted(seed, deviation, 0.0, noise) for seed in range(1000))]
    assert np.mean(np.array(chances) < 0.5e-2) < 3e-2


def test_what_is_there_stays_certain() -> None:
    common, x = fitted(3)
    assert common.std == pytest.approx(1.0 / np.sqrt(ROWS), rel=0.1)
    assert common.chance_of_none(x) < 1e-9 and common.chance_of_none(-x) < 1e-9
    for_nothing, x = fitted(3, size=0.0)
    assert for_nothing.chance_of_none(x) > 0.01


def test_a_coordinate_that_only_the_prior_knows_has_its_own_interval() -> None:
    slopes = np.zeros((10, 1))
    common = LinearFit(slopes, np.ones(10), np.eye(1), np.arange(10)).common_size(0)
    assert (common.std, common.rank) == (1.0, 0)
