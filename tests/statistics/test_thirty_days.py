"""Weather is no damage, and hides none: two days of it in CI, thirty with `make test-slow`."""

from __future__ import annotations

import numpy as np
import pytest

from tests.statistics.thirty_days import PER_DEGC, Case, month


def _judge(result: dict[str, Case]) -> None:
    law = result["with the channel"].baseline.law
    low, high = law.axes[0].range
    change, std = law.over_range("temperature")
    assert (np.abs(change - np.expm1(PER_DEGC * (high - low))) < 4.0 * std).all()
    for name, case in result.items():
        assert not case.raw.story_alarms and not case.twin.story_alarms, name
        for hurt in (case.raw_loss, case.twin_loss):
            assert {story for _, story in hurt.story_alarms} == {2}, name
            assert min(t for t, _ in hurt.story_alarms) > case.onset_s, name
    # The channel leaves what a steady temperature would; without it the weather stands in every story.
    left, whole = (result[name].raw.ddi.std(axis=0) for name in ("with the channel", "without it"))
    assert (left < 0.35 * whole).all()


def _assert_like_raw(result: dict[str, Case], least: float, most: float) -> None:
    """The twin is like the raw windows."""
    for case in result.values():
        rms = np.sqrt((case.unexplained**2).mean(axis=0))
        assert (rms < most).all() and (rms > least).all()


@pytest.mark.engine
def test_two_days_of_weather() -> None:
    result = month(days=2, seed=5, calibration_days=1, loss_hours=4, twin_days=0.2)
    _judge(result)
    _assert_like_raw(result, 0.5, 1.8)


@pytest.mark.slow
def test_thirty_days_of_weather() -> None:
    result = month(days=30, seed=20261201)
    print("".join(f"\n{name}: {case.report()}" for name, case in result.items()))
    _judge(result)
    _assert_like_raw(result, 0.7, 1.4)
