"""Clocks of single channels that run fast or slow, in vibrations whose truth is known."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from scipy.signal import lfilter

from drivers.base import ACCELERATION, GROUND, SampleBlock
from monitor.config import Configuration
from monitor.diagnosis.clock_drift import clock_drift_in_words, correct_clock_drifts
from monitor.inference import Segments, gather
from tests.measured.sensor_faults import fast_clock

RATE_HZ = 100.0
SHAPES = np.array([[1.0, 0.8, 0.4], [-0.6, 0.5, 1.0], [0.5, -1.0, 0.9]])
MODES_HZ = (3.0, 9.0, 14.0)
CONFIG = Configuration.model_validate(
    {
        "structure": {
            "kind": "shear_frame",
            "masses_kg": [1.0, 1.0, 1.0],
            "stiffness_n_per_m": [2000.0, 2000.0, 2000.0],
        },
        "sensors": [{"channel": f"a{i}", "floor": i} for i in (1, 2, 3)],
    }
)


@lru_cache
def vibration(seed: int, duration_s: float = 200.0) -> np.ndarray:
    """Three modes under forces whose level doubles half way, and 5 % noise, shape (n, 3)."""
    rng, n = np.random.default_rng(seed), round(duration_s * RATE_HZ)
    out = np.zeros((n, 3))
    for hz, shape in zip(MODES_HZ, SHAPES, strict=True):
        r, angle = np.exp(-0.01 * 2.0 * np.pi * hz / RATE_HZ), 2.0 * np.pi * hz / RATE_HZ
        mode = lfilter([1.0, -1.0], [1.0, -2.0 * r * np.cos(angle), r**2], rng.standard_normal(n))
        out += np.outer(mode / mode.std(), shape)
    out *= np.where(np.arange(n) < n // 2, 1.0, 2.0)[:, None]
    return np.asarray(out + 0.05 * out.std(axis=0) * rng.standard_normal(out.shape))


def segments(samples: np.ndarray, ground: np.ndarray | None = None) -> Segments:
    """Segments of a recording on one time base, as the reader sees it."""
    blocks = [SampleBlock(ACCELERATION, 0, 0, RATE_HZ, ("a1", "a2", "a3"), "m/s^2", samples.astype(np.float32))]
    if ground is not None:
        blocks.insert(0, SampleBlock(GROUND, 0, 0, RATE_HZ, ("g",), "m/s^2", ground.astype(np.float32)))
    return gather(blocks, CONFIG.front_end())


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
