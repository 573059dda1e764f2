"""Comparisons: equals are told to differ as rarely as is stated, and a loss of a story is found."""

from __future__ import annotations

import pytest

from tests.statistics.compared import KINDS, LOSSES, days, halves, line, share
from tests.support.campaign import each

pytestmark = pytest.mark.slow
RATE, PAIRS = 0.05, 200


def test_halves_of_one_record_are_told_to_differ_at_most_twice_as_often_as_stated() -> None:
    told = each(halves, [(KINDS[seed % len(KINDS)], seed, 0.0) for seed in range(PAIRS)], keep=True)
    print(line("halves", told))
    assert share(told) <= 2.0 * RATE
    assert sum(one.differs is None for one in told) <= 0.1 * PAIRS


def test_records_of_different_days_are_told_to_differ_at_most_twice_as_often_as_stated() -> None:
    told = each(days, [(seed, 0.0) for seed in range(PAIRS)], keep=True)
    print(line("days", told))
    assert share(told) <= 2.0 * RATE


@pytest.mark.parametrize(("loss", "least"), list(zip(LOSSES, (0.4, 0.6, 0.75), strict=True)))
def test_a_loss_of_a_story_is_told(loss: float, least: float) -> None:
    told = each(halves, [(KINDS[seed % len(KINDS)], seed, loss) for seed in range(30)], keep=True)
    print(line(f"loss of {100 * loss:g} %", told))
    assert share(told) >= least
