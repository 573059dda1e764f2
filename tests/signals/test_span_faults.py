"""Faults within one span of 10 s."""

from __future__ import annotations

import numpy as np
import pytest

from monitor.model import Model
from monitor.signals.span_faults import SpanFaults, find_span_faults
from tests.support.simulated import PAPER_FRAME, ambient

RATE, SPAN = 200.0, 2000


@pytest.fixture(scope="module")
def floors() -> np.ndarray:
    """400 s, rounded to float32 as sources do."""
    moved = ambient(Model(PAPER_FRAME), 400.0, RATE, 1, noise=0.05, level_spread=0.35)
    return moved.astype(np.float32).astype(float)


def told(x: np.ndarray) -> list[list[SpanFaults]]:
    return [find_span_faults(np.ascontiguousarray(x[a : a + SPAN].T), RATE) for a in range(0, len(x), SPAN)]


def test_sound_channels_have_no_faults(floors: np.ndarray) -> None:
    for span in told(floors):
        for one in span:
            assert (one.resolution_m_s2, one.step_m_s2, one.held_s, one.hum_hz) == (0.0, 0.0, 0.0, None)
            assert abs(one.drift_m_s2) < 0.5 * floors.std()


@pytest.mark.parametrize("share", [0.05, 0.5])
def test_a_coarse_resolution_is_read_off_the_values(floors: np.ndarray, share: float) -> None:
    step = share * float(floors.std())
    coarse = (np.round(floors / step) * step).astype(np.float32).astype(float)
    for span in told(coarse):
        assert [one.resolution_m_s2 for one in span] == pytest.approx([step] * 3, rel=1e-3)
        assert [one.held_s for one in span] == [0.0] * 3


def test_a_fine_resolution_about_gravity_is_read_beside_the_rounding_of_the_source() -> None:
    step = 6.2e-6  # 6.5 times the spacing of 32-bit numbers at 9.8 m/s^2
    levels = np.random.default_rng(0).integers(-200, 200, (SPAN, 1))
    ((one,),) = told((9.80665 + step * levels).astype(np.float32).astype(float))
    assert one.resolution_m_s2 == pytest.approx(step, rel=0.1)


def test_a_step_of_the_offset_is_sized(floors: np.ndarray) -> None:
    x, step = floors[:SPAN].copy(), 10.0 * float(floors[:, 1].std())
    x[900:, 1] += step
    ((first, second, third),) = told(x)
    assert second.step_m_s2 == pytest.approx(step, rel=0.05) and second.drift_m_s2 == 0.0
    assert first.step_m_s2 == third.step_m_s2 == 0.0


def test_a_drift_is_no_step(floors: np.ndarray) -> None:
    x = floors[:SPAN].copy()
    x[:, 1] += 10.0 * float(x.std()) * np.arange(SPAN) / SPAN
    ((_, second, _),) = told(x)
    assert second.step_m_s2 == 0.0 and second.drift_m_s2 == pytest.approx(10.0 * float(floors[:SPAN].std()), rel=0.1)


def test_dropouts_are_timed(floors: np.ndarray) -> None:
    x = floors[:SPAN].copy()
    x[500:600, 1] = 0.0
    x[1500:1540, 1] = x[1500, 1]
    ((first, second, _),) = told(x)
    assert second.held_s == pytest.approx(0.7, abs=0.02) and first.held_s == 0.0


def test_clipping_is_no_dropout(floors: np.ndarray) -> None:
    x = floors[:SPAN].copy()
    limit = 0.5 * float(x[:, 1].std())
    x[:, 1] = x[:, 1].clip(-limit, limit)
    assert told(x)[0][1].held_s == 0.0


def test_a_hum_of_one_channel_is_told_with_the_mains(floors: np.ndarray) -> None:
    x = floors[:SPAN].copy()
    x[:, 1] += float(x.std()) * np.sin(2.0 * np.pi * 50.05 * np.arange(SPAN) / RATE)
    ((first, second, _),) = told(x)
    assert second.hum_hz == pytest.approx(50.05, abs=0.1) and second.mains_hz == 50.0
    assert first.hum_hz is None


def test_a_stuck_channel_is_left_to_the_share_of_repeats(floors: np.ndarray) -> None:
    x = floors[:SPAN].copy()
    x[:, 1] = 2.5
    second = told(x)[0][1]
    assert second == SpanFaults(0.0, 0.0, 0.0, 0.0, None, None)
