"""Stretches in which no channel changes: a dead logger is told, a quiet night is not."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from monitor.core import STILL, Gap
from monitor.model import Model
from monitor.pipeline import Pipeline
from monitor.signals import sensor_health, stillness
from monitor.signals.alignment import Piece
from monitor.signals.sensor_health import HealthSettings, HealthState
from tests.support.frames import settings_of
from tests.support.samples import FRAME
from tests.support.simulated import PAPER_FRAME, ambient, windows_of

RATE, WINDOW_S, HOP_S, T0_NS = 100.0, 60.0, 5.0, 1_767_225_600_000_000_000


@pytest.fixture(scope="module")
def motion() -> np.ndarray:
    """200 s of a frame, of RMS 1 in each channel."""
    floors = ambient(Model(PAPER_FRAME), 200.0, RATE, 1, noise=0.2)
    return np.asarray(floors / floors.std(axis=0))


def told(values: np.ndarray, sizes: Sequence[int] = (500,)) -> list[str | None]:
    """What is said of the window that ends with each hop."""
    state, out, at, k, hop = stillness.start(values.shape[1]), [], 0, 0, round(HOP_S * RATE)
    health, names = HealthState(), tuple(map(str, range(values.shape[1])))
    while at < len(values):
        part = values[at : at + min(sizes[k % len(sizes)], hop - at % hop)]
        piece = Piece(T0_NS + round(at / RATE * 1e9), part, None, RATE)
        state = stillness.step(state, piece, HOP_S, WINDOW_S)
        health, _ = sensor_health.step(health, piece, 0, names, HealthSettings(), WINDOW_S)
        at, k = at + len(part), k + 1
        if at % hop == 0:
            end_ns = T0_NS + round(at / RATE * 1e9)
            saturated = partial(sensor_health.saturated, health)
            found = stillness.check(state, end_ns - round(WINDOW_S * 1e9), end_ns, saturated)
            out.append(None if found is None else found.reason)
    return out


@pytest.mark.parametrize("value", [0.0, None], ids=["zeros", "the last sample held"])
@pytest.mark.parametrize("resolution", [1e-6, 0.5], ids=["fine", "coarse"])
def test_a_logger_that_dies_is_told_with_the_next_hop(
    motion: np.ndarray, value: float | None, resolution: float
) -> None:
    spoilt = np.round(motion / resolution) * resolution
    spoilt[10_100:] = spoilt[10_099] if value is None else value
    said = told(spoilt)
    assert said[:20] == [None] * 20
    assert all(reason is not None and reason.startswith(STILL) for reason in said[20:])
    assert "since 2026-01-01 00:01 UTC" in str(said[20])


def test_sensors_at_the_ends_of_their_ranges_are_told_apart_from_a_logger_that_stood_still(motion: np.ndarray) -> None:
    spoilt = motion.copy()
    spoilt[10_100:10_400] = spoilt[10_099]
    (still,) = set(told(spoilt)[20:-1]) - {None}
    assert str(still).endswith("the logger stood still")
    spoilt[10_100:10_400] = 2.0 * np.abs(motion).max() * np.array([1.0, -1.0, 1.0])
    (ends,) = set(told(spoilt)[20:-1]) - {None}
    assert str(ends).endswith("the logger stood still, or all sensors were at the ends of their ranges")


def test_a_logger_that_stood_still_for_a_while_is_told_until_the_window_has_passed_it(motion: np.ndarray) -> None:
    spoilt = motion.copy()
    spoilt[10_100:10_400] = spoilt[10_099]
    said = told(spoilt)
    assert all("stood still" in str(reason) for reason in said[20:32])
    assert said[:20] == [None] * 20 and said[33:] == [None] * 7


def test_one_channel_that_moves_is_enough(motion: np.ndarray) -> None:
    spoilt = motion.copy()
    spoilt[5000:, 1:] = 0.0
    assert told(spoilt) == [None] * 40


def test_lost_samples_of_a_channel_hide_no_dead_logger(motion: np.ndarray) -> None:
    spoilt = motion.copy()
    spoilt[10_100:] = 0.0
    spoilt[10_300:15_000, 0] = np.nan
    assert all(str(reason).startswith(STILL) for reason in told(spoilt)[20:])


@pytest.mark.parametrize("level", [0.15, 0.2, 0.3, 0.5, 1.0, 5.0])
@pytest.mark.parametrize("evening", ["none", "slow", "at once"])
def test_quiet_nights_near_the_resolution_are_real(motion: np.ndarray, level: float, evening: str) -> None:
    """Motion of a few bits and less, all night, from a slow evening on or from one second to the next."""
    n = len(motion)
    course = {
        "none": np.full(n, level),
        "slow": 20.0 * (level / 20.0) ** np.linspace(0.0, 1.0, n),
        "at once": np.where(np.arange(n) < 7700, 20.0, level),
    }[evening]
    offset = np.random.default_rng(2).uniform(-0.5, 0.5, 3)
    quiet = 0.001 * np.round(course[:, None] * motion + offset)
    assert told(quiet) == [None] * 40


def test_a_stretch_of_one_sample_that_ends_a_rest_says_nothing() -> None:
    quiet = np.zeros((600, 2))
    quiet[::50] = 0.001
    state = stillness.step(stillness.start(2), Piece(T0_NS, quiet[:540], None, RATE), HOP_S, WINDOW_S)
    lone = Piece(T0_NS + 6 * 10**9, np.full((1, 2), 0.001), Gap(T0_NS + 5_400_000_000, 0.6, "lost"), RATE)
    state = stillness.step(state, lone, HOP_S, WINDOW_S)
    state = stillness.step(state, Piece(T0_NS + 8 * 10**9, quiet[:1], Gap(T0_NS, 1.0, "lost"), RATE), HOP_S, WINDOW_S)
    assert [s.n for s in state.stretches] == [500, 40, 1]
    assert stillness.check(state, T0_NS, T0_NS + 60 * 10**9, lambda begin_ns, end_ns: np.zeros(3, dtype=bool)) is None


@given(sizes=st.lists(st.integers(1, 700), min_size=1, max_size=6))
@settings(deadline=None, max_examples=15)
def test_what_is_told_does_not_depend_on_how_the_samples_came(motion: np.ndarray, sizes: list[int]) -> None:
    spoilt = 0.001 * np.round(0.5 * motion)
    spoilt[10_100:10_900] = 0.0
    spoilt[14_000:] = 0.003
    assert told(spoilt, sizes) == told(spoilt)


@pytest.mark.parametrize("size", [70, 100_000], ids=["small blocks", "one block"])
def test_windows_with_a_dead_logger_are_not_judged(motion: np.ndarray, size: int) -> None:
    pipeline = Pipeline(settings_of(FRAME))
    spoilt = motion.copy()
    spoilt[6_100:8_950] = spoilt[6_099]
    results = windows_of(pipeline, spoilt, RATE, size=size)
    said = [None if r.skipped is None else r.skipped.reason for r in results]
    ends_s = [round(r.t_end_ns * 1e-9, 3) for r in results]
    while_dead = [str(s).startswith(STILL) for s, end in zip(said, ends_s, strict=True)]
    assert while_dead == [65.0 <= end < 90.0 for end in ends_s]
    assert [str(s).startswith("no reading") for s in said] == [65.0 <= end < 110.0 for end in ends_s]
