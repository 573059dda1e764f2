"""Intervals of short records hold what they state: few trials of the campaign `short_records`."""

from __future__ import annotations

import numpy as np
import pytest

from tests.statistics.short_records import CASES, table, trial


@pytest.mark.parametrize(("name", "seconds", "seeds"), [("3 floors", 20.0, 8), ("10 floors", 30.0, 2)])
def test_intervals_of_a_short_record_hold_the_truth(name: str, seconds: float, seeds: int) -> None:
    """By the scatter of two or three blocks alone, 68 and 78 % of the frequencies lie in their 95 % interval."""
    z = np.array([row[:2] for seed in range(seeds) for row in trial(name, seconds, seed)["rows"]])
    assert len(z) >= 20
    assert ((np.abs(z) < 1.96).mean(axis=0) > 0.9).all()


def test_the_table_counts_what_is_refused_apart() -> None:
    row = {"name": "3 floors", "seconds": 20.0, "modes": 3, "false": 0, "refined": False}
    text = table([{**row, "rows": [[0.5, np.nan, 0.01, np.nan, 2.0], [3.0, 1.0, 0.01, 0.2, 6.0]]}])
    assert "50.0 % (2, 1 %)" in text
    assert "100.0 % (1, 20 %)" in text
    assert set(CASES) >= {"3 floors", "10 floors", "one channel", "gusts"}
