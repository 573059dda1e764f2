"""Years of weather and gales: no false warning with level and temperature, nor with the level alone; losses are found."""

from __future__ import annotations

import pytest

from tests.damage.weather_years import CASES, LOSSES, one

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("case", ["level and temperature", "level"])
@pytest.mark.parametrize("year", [100, 101])
def test_a_year_of_weather_announces_nothing_and_hides_no_loss(year: int, case: str) -> None:
    assert one(year, 2026, CASES[case], LOSSES["intact"])["false_warnings"] == 0
    for loss in ("2 %", "5 %"):
        delay_h = one(year, 2026, CASES[case], LOSSES[loss])["delay_h"]
        assert isinstance(delay_h, int)
        assert delay_h <= 72


@pytest.mark.parametrize("year", [2, 5, 6])
def test_frost_that_stiffens_the_stories_unevenly_is_not_announced(year: int) -> None:
    """Years in which it was, 14, 4 and 3 times: nothing was learned of frost, or little beside all the other weather."""
    assert one(year, 2027, CASES["level, uneven"], LOSSES["intact"])["false_warnings"] == 0


@pytest.mark.parametrize("year", [100, 101])
def test_the_same_year_without_compensation_is_announced(year: int) -> None:
    assert one(year, 2026, CASES["none"], LOSSES["intact"])["false_warnings"]
