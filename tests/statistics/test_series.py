"""The simulated feature series have what they state, and say what is true of them."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.series import HOUR_NS, HOW, NATURES, START_NS, Series, records, series, years


def left(made: Series) -> np.ndarray:
    """What a reading has beyond its expectation and the change."""
    return np.log(np.column_stack(list(made.table.features.values()))) - made.expected - made.change


@pytest.mark.parametrize("name", NATURES)
def test_a_seed_gives_one_series_and_its_change_is_all_that_differs(name: str) -> None:
    healthy, changed = series(name, 3), series(name, 3, 0.02)
    put_in = {f: np.log(changed.table.features[f] / v) for f, v in healthy.table.features.items()}
    after = healthy.table.t_ns >= healthy.changed_from_ns
    assert np.nanmax(np.abs(put_in["f1"][after] - np.log(0.98))) < 1e-9
    assert np.nanmax(np.abs(put_in["f1"][~after])) == 0.0
    assert np.nanmax(np.abs(put_in["f2"])) == 0.0


@pytest.mark.parametrize(("how", "of_second"), [("one", 0.0), ("all", 1.0), ("slow", 0.0)])
def test_a_change_is_of_one_of_all_or_grows(how: str, of_second: float) -> None:
    assert how in HOW
    change = series("palace", 1, 0.01, how).change
    assert change[-1, 0] == pytest.approx(np.log(0.99), rel=1e-3)
    assert change[-1, 1] == pytest.approx(of_second * np.log(0.99))
    halfway = change[(change[:, 0] != 0.0).argmax() + 1, 0]
    assert (abs(halfway) < 1e-4) == (how == "slow")


def test_the_noise_is_of_heavy_tails_and_five_times_larger_in_frost() -> None:
    made = series("bridge", 5)
    noise = left(made)[:, 0]
    noise = noise[np.isfinite(noise)]
    kept = np.isfinite(left(made)[:, 0])
    z = noise / made.scatter[kept]
    assert made.scatter.max() / made.scatter.min() == pytest.approx(5.0)
    assert np.quantile(np.abs(z), 0.95) == pytest.approx(2.78 / np.sqrt(2.0), rel=0.1)
    assert np.mean(np.abs(z) > 4.0) > 20 * 6.3e-5


def test_modes_are_missing_in_calm_hours_rather_than_in_others() -> None:
    made = series("mast", 2)
    level, lost = made.table.covariates["level"], np.isnan(made.table.features["f4"])
    assert 0.3 < lost.mean() < 0.5
    calm = level < np.nanmedian(level)
    assert lost[calm].mean() > 1.5 * lost[~calm].mean()


def test_years_follow_what_is_learned_and_days_with_a_change_follow_them() -> None:
    made = years("mast", 0.5, 7, 0.01, days=10)
    assert made.changed_from_ns - made.learned_until_ns == pytest.approx(0.5 * 8766 * HOUR_NS, rel=0.01)
    assert made.table.t_ns[-1] - made.changed_from_ns == pytest.approx(240 * HOUR_NS, abs=30 * HOUR_NS)
    assert made.changed_from_ns > START_NS
    after = made.table.t_ns >= made.changed_from_ns
    assert not made.change[~after].any()
    assert made.change[after, 0] == pytest.approx(np.log(0.99))


def test_coefficients_of_records_scatter_as_estimates_do_and_from_record_to_record() -> None:
    made = records(4, 0.03, learned=400, later=40)
    a1 = made.table.features["a1"]
    assert np.std(made.expected[:400, 0]) > 2.0 * np.std(a1[:400] - made.expected[:400, 0])
    assert len(made.table.features) == 10
    assert made.change[-1, 0] == 0.03 and made.change[400, 0] == 0.0
