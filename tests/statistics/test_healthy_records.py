"""Healthy records bring up nothing that is at fault with the logger, its clock or the order of its modes."""

from __future__ import annotations

import pytest

from tests.statistics.healthy_records import trial
from tests.support.campaign import each


@pytest.mark.parametrize("seed", [71001, 71002, 71003])
def test_a_healthy_record_brings_up_nothing(seed: int) -> None:
    what, wrong = trial(seed)
    assert not wrong, what


@pytest.mark.slow
def test_forty_healthy_records_bring_up_nothing() -> None:
    told = each(trial, [(72000 + k,) for k in range(40)], keep=True)
    assert not [one for one in told if one[1]]
