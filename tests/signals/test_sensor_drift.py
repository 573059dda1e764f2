"""Drift of one channel and the bins that it spoils."""

from __future__ import annotations

import numpy as np
import pytest

from monitor.model import Model
from monitor.signals.sensor_drift import Drift, find_drift
from tests.support.simulated import PAPER_FRAME, ambient, segments_of

RATE, N, FIRST = 100.0, 2000, 40


def motion(seed: int) -> np.ndarray:
    return ambient(Model(PAPER_FRAME), 400.0, RATE, seed, noise=0.05)


def found(x: np.ndarray) -> tuple[Drift, ...]:
    return find_drift(segments_of(x, RATE, N, 721)[0], FIRST)


def walk(x: np.ndarray, size: float) -> np.ndarray:
    steps = np.random.default_rng(4).standard_normal(len(x)).cumsum()
    return size * float(x.std()) * (steps - steps.mean()) / steps.std()


def test_a_random_walk_is_found_and_reaches_further_up_the_stronger_it_is() -> None:
    reach = []
    for size in (1.0, 5.0):
        x = motion(1)
        x[:, 1] += walk(x, size)
        (drift,) = found(x)
        assert (drift.channel, drift.exponent) == (1, 2)
        assert drift.ruled[0] and (np.diff(drift.density) < 0.0).all()
        reach.append(int(drift.ruled.sum()))
    assert reach[0] < reach[1]


@pytest.mark.parametrize("seed", range(10))
def test_nothing_is_found_in_sound_records(seed: int) -> None:
    assert found(motion(seed)) == ()


def test_what_all_channels_share_is_no_drift() -> None:
    """The ground's slow motion moves every sensor."""
    x = motion(1)
    assert found(x + walk(x, 1.0)[:, None]) == ()


def test_offsets_do_not_count() -> None:
    assert found(motion(1) + np.array([3.0, -50.0, 0.0])) == ()


def test_a_dead_channel_is_no_error() -> None:
    x = motion(1)
    x[:, 2] = 0.0
    assert found(x) == ()
