"""Years of weather and gales: with level and temperature no false warning, without compensation many; losses are found."""

from __future__ import annotations

import pytest

from tests.statistics.weather_years import UNITS, one


@pytest.mark.slow
@pytest.mark.parametrize("year", [100, 101])
def test_a_year_of_weather_announces_nothing_and_hides_no_loss(year: int) -> None:
    both = UNITS["level and temperature"]
    assert one(year, 2026, both, 0.0)["false_warnings"] == 0
    assert one(year, 2026, UNITS["none"], 0.0)["false_warnings"]
    for loss in (0.02, 0.05):
        delay_h = one(year, 2026, both, loss)["delay_h"]
        assert isinstance(delay_h, int)
        assert delay_h <= 72
