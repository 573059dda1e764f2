"""The charts hold their rate on what they assume, and are blind or wrong where measured series differ from it."""

from __future__ import annotations

import numpy as np
import pytest

from monitor.damage import FeatureTable
from tests.statistics import charts

HOUR_NS = 3_600_000_000_000


def textbook(seed: int, w: int, change: float = 0.0) -> FeatureTable:
    """Three features that depend on temperature with a kink at 0 degC, with Gaussian noise; the last quarter is changed."""
    rng = np.random.default_rng(seed)
    degc = rng.uniform(-10.0, 20.0, w)
    law = -0.002 * np.maximum(degc, 0.0) - 0.01 * np.minimum(degc, 0.0)
    hz = {f"f{j}": j + law + 0.01 * rng.standard_normal(w) for j in (1, 2, 3)}
    hz["f1"][3 * w // 4 :] -= change
    return FeatureTable(HOUR_NS * np.arange(w), hz, {"air_temperature": degc})


def test_one_reading_of_a_thousand_is_beyond_the_limit_and_four_in_a_row_are_not() -> None:
    made = [textbook(seed, 5000) for seed in range(60)]
    told = [charts.of_series(table, int(table.t_ns[199])) for table in made]
    assert 0.0008 < np.mean([chart.statistic > 1.0 for chart in told]) < 0.0012
    assert not any(chart.announced().any() for chart in told)


def test_a_change_of_five_deviations_is_announced_from_the_fourth_reading_that_shows_it() -> None:
    table = textbook(2, 1000, 0.08)
    announced = charts.of_series(table, int(table.t_ns[499])).announced()
    assert not announced[:253].any()
    assert announced[260:].all()


def test_a_row_with_a_missing_value_is_not_judged_and_breaks_no_row_of_four() -> None:
    statistic = np.array([2.0, 2.0, np.nan, 2.0, 2.0, 2.0, 0.5])
    assert charts.Chart(statistic, 4).announced().tolist() == [False, False, False, False, True, True, False]


def test_ar_coefficients_are_those_that_made_the_record() -> None:
    rng = np.random.default_rng(3)
    x = np.zeros((200_000, 1))
    for n in range(2, len(x)):
        x[n] = 1.2 * x[n - 1] - 0.6 * x[n - 2] + rng.standard_normal()
    assert charts.ar_coefficients(x, len(x), 2)[0] == pytest.approx([1.2, -0.6], abs=0.01)


def test_two_samples_of_one_state_differ_at_the_rate_of_the_limit_and_of_two_states_always(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(4)
    monkeypatch.setattr(charts, "SURE", 0.9)
    same = [charts.between(rng.standard_normal((30, 4)), rng.standard_normal((20, 4))) for _ in range(2000)]
    assert 0.08 < np.mean(np.array(same) > 1.0) < 0.12
    assert charts.between(rng.standard_normal((30, 4)), 2.0 + rng.standard_normal((20, 4))) > 1.0


def test_fewer_segments_than_coefficients_judge_nothing() -> None:
    rng = np.random.default_rng(5)
    assert not charts.of_segments(rng.standard_normal((5, 8)), 99.0 * rng.standard_normal((3, 8))).announced().any()
