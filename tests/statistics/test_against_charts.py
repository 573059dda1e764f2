"""The table compares at equal false readings, counts what is not judged as not found, and puts in the change that it states."""

from __future__ import annotations

import math

import numpy as np
import pytest

from monitor.core import Alarm, FeatureReading, Level, WindowResult
from monitor.damage import FeatureTable
from tests.statistics import charts, product_readings
from tests.statistics.against_charts import Chart, Told, at_equal, level_with, limit_of, rows, told
from tests.statistics.product_readings import Features, Modes, Record
from tests.statistics.recorded_sets import KEPT, stretched

NEVER = math.inf


def chart(statistic: list[float], changed: int) -> Chart:
    """A chart without runs, whose last readings are changed."""
    return Chart(charts.Chart(np.array(statistic), 1), np.arange(len(statistic)) >= len(statistic) - changed)


def test_a_limit_is_moved_to_the_false_readings_of_the_other_and_at_least_one() -> None:
    judge = chart([0.1, 0.5, 3.0, 0.7, 0.6, 0.9], 2)
    for false, limit, found in ((0, 0.7, 1), (1, 0.7, 1), (2, 0.5, 2), (3, 0.1, 2)):
        moved = limit_of(judge, Told(false, 4, 0, 2, 0, NEVER))
        assert moved == pytest.approx(limit, rel=1e-6)
        assert told(judge, moved * (1.0 + 1e-6)).found == found


def test_both_are_moved_to_the_other() -> None:
    a, b = chart([2.0, 0.1, 0.2, 0.3, 3.0, 0.4], 2), chart([0.1, 0.2, 0.3, 0.4, 0.5, 0.6], 2)
    found = at_equal(a, b)
    assert [found[of].false for of in ("product", "chart", "chart_as_product", "product_as_chart")] == [1, 0, 1, 1]
    assert found["chart_as_product"].found == 2


def test_a_reading_that_is_not_judged_is_not_found() -> None:
    nan = float("nan")
    assert told(chart([0.1, nan, nan, 2.0], 2)) == Told(0, 2, 1, 2, 2, 2.0)


@pytest.mark.parametrize(
    ("found", "delay", "level"), [(98, 6, True), (97, 4, False), (100, 7, False), (99, NEVER, False)]
)
def test_a_product_is_level_within_two_percent_and_two_readings(found: int, delay: float, level: bool) -> None:
    assert level_with(Told(0, 9, found, 100, 0, delay), Told(0, 9, 100, 100, 0, 4)) == level


def test_seeds_of_a_row_are_summed() -> None:
    of = {"false": 1, "healthy": 10, "found": 2, "changed": 4, "unjudged": 0, "delay": 3}
    lines = [
        {"row": "a", "key": k, **dict.fromkeys(("product", "chart", "chart_as_product", "product_as_chart"), of)}
        for k in "12"
    ]
    assert list(rows(lines))[2].startswith("| a | 2/20, 4/8, 3 | 2/20, 4/8, 3 |")


def test_a_refused_series_and_records_without_a_baseline_are_not_judged() -> None:
    t_ns = 3_600_000_000_000 * np.arange(20)
    table = FeatureTable(t_ns, {"f1": np.linspace(1.0, 2.0, 20)}, {})
    refused = Features(table, int(t_ns[4]), np.arange(15) >= 5)
    assert told(refused) == Told(0, 5, 0, 10, 15, NEVER)
    noise = np.random.default_rng(1).standard_normal((3, 1000, 1))
    short = Modes(Record(100.0, 4.0, noise[:1], noise[1:2], noise[2:]))
    assert told(short) == Told(0, 13, 0, 13, 26, NEVER)


def test_a_limit_is_moved_until_as_many_healthy_readings_are_announced(monkeypatch: pytest.MonkeyPatch) -> None:
    t_ns = np.arange(6)
    in_years = [2.0, 0.1, 0.1, 100.0, 3.0]

    def judge_features(table: FeatureTable, until_ns: int) -> tuple[None, list[WindowResult]]:
        levels = [Level.WARNING if years > 10.0 else Level.NORMAL for years in in_years]
        readings = [
            FeatureReading(np.zeros(1), np.eye(1), names=("f1",), sigma=np.zeros(1), years=years) for years in in_years
        ]
        said = [Alarm(level, (), "") for level in levels]
        return None, [
            WindowResult(t, t, 0.0, None, None, None, alarm, None, features=reading)
            for t, (alarm, reading) in enumerate(zip(said, readings, strict=True))
        ]

    monkeypatch.setattr(product_readings, "judge_features", judge_features)
    judge = Features(FeatureTable(t_ns, {}, {}), 0, np.arange(5) >= 3)
    assert told(judge) == Told(0, 3, 1, 2, 0, 1.0)
    moved = told(judge, limit_of(judge, Told(1, 3, 0, 2, 0, NEVER)))
    assert (moved.false, moved.found) == (1, 2)


def test_frequencies_fall_by_what_is_put_in() -> None:
    t = np.arange(8000) / 100.0
    tone = np.sin(2 * np.pi * 8.0 * t)[:, None]

    def peak_hz(x: np.ndarray) -> float:
        spectrum = np.abs(np.fft.rfft(x[:, 0] * np.hanning(len(x)), 2**18))
        return float(spectrum.argmax() * KEPT * 100.0 / 2**18)

    assert peak_hz(stretched(tone)) == pytest.approx(8.0, rel=1e-4)
    assert peak_hz(stretched(tone, 0.02)) == pytest.approx(0.98 * 8.0, rel=1e-4)
