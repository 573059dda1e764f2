"""Drift of one channel and the bins that it spoils."""

from __future__ import annotations

import numpy as np
import pytest

from monitor.model import Model, ShearFrame, simulate
from monitor.signals.sensor_drift import Drift, find_drift
from monitor.signals.welch import SegmentDesign, transform

RATE, N, FIRST = 100.0, 2000, 40
FRAME = Model(ShearFrame(np.array([0.3253, 0.3514, 0.3129]), np.array([2909.4511, 1514.8507, 1897.6986]), 0.01))


def motion(seed: int) -> np.ndarray:
    return np.asarray(simulate(FRAME, duration_s=400.0, rate_hz=RATE, noise=0.05, seed=seed).floors)


def found(x: np.ndarray) -> tuple[Drift, ...]:
    design = SegmentDesign(RATE, N, 721)
    segments = np.stack([transform(design, x[a : a + N]) for a in range(0, len(x) - N + 1, N // 2)])
    return find_drift(segments, FIRST)


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
