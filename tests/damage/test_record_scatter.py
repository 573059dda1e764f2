"""Scatter between records: the left-out z-scores have the stated law, and few records do not give five sigma."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import kstest, t

from monitor.core import Array
from monitor.damage.record_scatter import RecordScatter, learn_scatter

WINDOW_NS = 10**10
STATED = np.array([1.0, 4.0, 0.25])


def learned(rng: np.random.Generator, records: int, windows: int, between: float) -> tuple[RecordScatter, Array]:
    """Scatter of records of some windows, whose means have the variance `between` over what a window states; and their mean."""
    means = rng.standard_normal((records, 1, 3)) * np.sqrt(between)
    values = ((means + rng.standard_normal((records, windows, 3))) * np.sqrt(STATED)).reshape(-1, 3)
    numbers = np.repeat(np.arange(records), windows)
    t_ns = [WINDOW_NS * (k + 100 * int(r)) for k, r in enumerate(numbers)]

    def predict(rest: Array, left: Array) -> tuple[Array, Array]:
        return np.tile(values[rest].mean(axis=0), (left.size, 1)), np.zeros((left.size, 3))

    scatter = learn_scatter(values, STATED, t_ns, numbers.tolist(), WINDOW_NS, [slice(0, 3)], predict)
    return scatter, values.mean(axis=0)


@pytest.mark.parametrize(("records", "windows", "between"), [(5, 1, 50.0), (5, 4, 3.0), (12, 3, 0.0), (1, 9, 0.0)])
def test_windows_of_a_record_that_was_not_learned_have_scores_of_students_t(
    records: int, windows: int, between: float
) -> None:
    levels = []
    for seed in range(400):
        rng = np.random.default_rng(seed)
        scatter, mean = learned(rng, records, windows, between)
        total = scatter.total + np.diag(scatter.of_mean(np.diag(STATED / (records * windows))))
        new = (rng.standard_normal(3) * np.sqrt(between) + rng.standard_normal(3)) * np.sqrt(STATED)
        levels.append(t.cdf((new - mean) / np.sqrt(total), scatter.freedom))
    levels = np.array(levels)
    assert np.quantile(np.abs(2.0 * levels - 1.0), 0.95) < 0.975, "scores lie too far out"
    assert kstest(levels[:, 0], "uniform").statistic < 0.12
    assert (np.abs(levels - 0.5) > 0.4995).mean() < 0.006, "one in a thousand is stated"


def test_five_records_do_not_give_five_sigma_and_components_that_agree_lend_each_other_theirs() -> None:
    scatter, _ = learned(np.random.default_rng(0), 5, 1, 50.0)
    assert (scatter.freedom >= 4.0).all()
    assert (scatter.freedom <= 12.0).all()
    chance = 2.0 * t.sf(5.0, scatter.freedom)
    assert (chance > 3e-4).all(), "five standard deviations of a normal distribution are one in 1.7 million"


def test_a_single_window_teaches_no_scatter() -> None:
    scatter, _ = learned(np.random.default_rng(0), 1, 1, 0.0)
    assert scatter.records == 1
    assert (scatter.freedom == 0.0).all()


def test_windows_that_overlap_are_not_judged_by_their_own_data() -> None:
    """Windows that begin every quarter of a window share data; a slow drift shows only if such neighbours are left out too."""
    drift = np.repeat(np.random.default_rng(1).standard_normal(12), 4)[:, None] * np.ones(3) * 10.0
    t_ns = [WINDOW_NS // 4 * (k + 1) for k in range(48)]

    def predict(rest: Array, left: Array) -> tuple[Array, Array]:
        assert np.abs(np.subtract.outer(np.array(t_ns)[rest], np.array(t_ns)[left])).min() >= WINDOW_NS
        return np.tile(drift[rest].mean(axis=0), (left.size, 1)), np.zeros((left.size, 3))

    scatter = learn_scatter(drift, np.ones(3), t_ns, [0] * 48, WINDOW_NS, [slice(0, 3)], predict)
    assert (scatter.beyond > 20.0).all()
    assert scatter.records == 12
