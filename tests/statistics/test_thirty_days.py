"""Weather is no damage, and hides none: two days of it in CI, thirty with `make test-slow`."""

from __future__ import annotations

import numpy as np
import pytest

from tests.statistics.thirty_days import PER_DEGC, Month, month


def _judge(result: Month) -> None:
    law = result.baselines["with the channel"].law
    assert law is not None
    low, high = law.axes[0].range
    change, std = law.over_range("temperature")
    assert (np.abs(change - np.expm1(PER_DEGC * (high - low))) < 4.0 * std).all()
    for name, seen in result.raw.items():
        assert not seen.story_alarms and not result.twin[name].story_alarms, name
        for hurt in (result.raw_loss[name], result.twin_loss[name]):
            assert {story for _, story in hurt.story_alarms} == {2}, name
            assert min(t for t, _ in hurt.story_alarms) > result.onset_s, name
    # The channel leaves what a steady temperature would; without it the weather stands in every story.
    assert (result.raw["with the channel"].ddi.std(axis=0) < 0.35 * result.raw["without it"].ddi.std(axis=0)).all()


def test_two_days_of_weather() -> None:
    result = month(days=2, seed=5, calibration_days=1, loss_hours=4, twin_days=0.2)
    _judge(result)
    for z in result.unexplained.values():  # the twin is like the raw windows
        assert (np.sqrt((z**2).mean(axis=0)) < 1.8).all() and (np.sqrt((z**2).mean(axis=0)) > 0.5).all()


@pytest.mark.slow
def test_thirty_days_of_weather() -> None:
    result = month(days=30, seed=20261201)
    print("\n" + result.report())
    _judge(result)
    for z in result.unexplained.values():
        assert (np.sqrt((z**2).mean(axis=0)) < 1.4).all() and (np.sqrt((z**2).mean(axis=0)) > 0.7).all()
