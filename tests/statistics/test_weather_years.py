"""A year of weather and gales: compensation leaves no false warning, without it there are; losses are found at once."""

from __future__ import annotations

import pytest

from tests.statistics.weather_years import UNITS, one


@pytest.mark.slow
@pytest.mark.parametrize("case", ["level and temperature", "level"])
def test_a_year_of_weather_announces_nothing_and_hides_no_loss(case: str) -> None:
    assert one(100, 2026, UNITS[case], 0.0)["false_warnings"] == 0
    assert one(100, 2026, UNITS["none"], 0.0)["false_warnings"]
    for loss in (0.02, 0.05):
        delay_h = one(100, 2026, UNITS[case], loss)["delay_h"]
        assert isinstance(delay_h, int)
        assert delay_h <= 72
