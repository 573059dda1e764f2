"""Clocks of single channels that run fast or slow, in vibrations whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from monitor.diagnosis.clock_drift import clock_drift_in_words, correct_clock_drifts
from tests.measured.sensor_faults import fast_clock
from tests.support.vibration import CONFIG, RATE_HZ, segments, vibration


@pytest.mark.parametrize("seed", range(4))
def test_clocks_that_agree_are_left_alone(seed: int) -> None:
    given = segments(vibration(seed))
    corrected, drifts = correct_clock_drifts(given, CONFIG.diagnosis)
    assert drifts == () and corrected is given


@pytest.mark.parametrize(("channel", "relative"), [(0, 2e-4), (1, -1e-4), (2, 5e-4)])
def test_a_clock_that_drifts_is_found_with_its_rate_and_taken_out(channel: int, relative: float) -> None:
    wrong = segments(fast_clock(vibration(channel), RATE_HZ, channel=channel, relative=relative))
    corrected, (drift,) = correct_clock_drifts(wrong, CONFIG.diagnosis)
    assert drift.channel == channel
    assert drift.relative == pytest.approx(relative, rel=0.02) and drift.std < 0.02 * abs(relative)
    healthy = segments(vibration(channel)).values
    before, after = (np.abs(s.values - healthy)[:, :, channel].mean() for s in (wrong, corrected))
    assert after < 0.1 * before
    assert correct_clock_drifts(corrected, CONFIG.diagnosis)[1] == ()


def test_a_constant_delay_is_no_drift() -> None:
    late = vibration(0).copy()
    late[1:, 1] = late[:-1, 1]
    assert correct_clock_drifts(segments(late), CONFIG.diagnosis)[1] == ()


def test_a_ground_whose_clock_drifts_is_told_from_floors_that_do() -> None:
    ground = vibration(0)[:, :1]
    floors = np.column_stack([lfilter([0.6, 0.3 * k], [1.0, -0.2 * k], ground[:, 0]) for k in (1, 2, 3)])
    floors += 0.02 * np.random.default_rng(1).standard_normal(floors.shape)
    slow = fast_clock(ground, RATE_HZ, channel=0, relative=-1e-3)
    corrected, (drift,) = correct_clock_drifts(segments(floors, slow), CONFIG.diagnosis)
    assert drift.channel == 3 and drift.relative == pytest.approx(-1e-3, rel=0.02)
    assert correct_clock_drifts(corrected, CONFIG.diagnosis)[1] == ()
    assert clock_drift_in_words(drift, ("a1", "a2", "a3"), corrected.drive) == (
        "the delay of the ground falls by 1 ms a second: its clock runs 0.1 % slow"
    )
