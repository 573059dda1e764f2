"""Healthy records bring up nothing that is at fault with the logger, its clock or the order of its modes."""

from __future__ import annotations

import pytest

from drivers.base import ClockHealth, SourceHealth
from tests.statistics.healthy_records import learned, live, record, trial
from tests.support.campaign import each
from tests.support.site import Scripted


@pytest.mark.parametrize("seed", [71001, 71002, 71003])
def test_a_healthy_record_brings_up_nothing(seed: int) -> None:
    what, wrong = trial(seed)
    assert not wrong, what


class Fast(Scripted):
    """A source whose driver finds that its node samples 2 % more slowly than it states, as its timestamps do not tell."""

    def health(self) -> SourceHealth:
        return SourceHealth(True, {}, (ClockHealth("node 7", 0.0, -19_608.0, 3.0, 0),))


def test_a_rate_that_the_driver_alone_can_tell_reaches_the_state() -> None:
    one = record(71002)
    said = live(one, learned(one), Fast)
    assert any("by the clock of this machine (node 7)" in text and "off by 3.9 %" in text for text in said)


@pytest.mark.slow
def test_forty_healthy_records_bring_up_nothing() -> None:
    told = each(trial, [(72000 + k,) for k in range(40)], keep=True)
    assert not [one for one in told if one[1]]
