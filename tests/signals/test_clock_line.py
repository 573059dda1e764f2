"""Rate and numbers of samples come out of stamps that are cut, jittered, interrupted or of a clock that wanders."""

from __future__ import annotations

import numpy as np
import pytest

from monitor.core import BadInputError
from monitor.signals import sample_clock

MS = 10**6


def stamps(
    rate_hz: float,
    chance: np.random.Generator,
    *,
    n: int = 6000,
    cut_ns: int = 1000,
    jitter_s: float = 0.0,
    pauses: int = 0,
) -> np.ndarray:
    """Stamps of a logger, ns; its pauses last a second to half a minute and keep no phase."""
    t = np.arange(n) / rate_hz + chance.normal(scale=jitter_s, size=n)
    for at in chance.choice(np.arange(50, n - 50), pauses, replace=False):
        t[at:] += chance.uniform(1.0, 30.0)
    t = np.maximum.accumulate(t) + chance.uniform(1.0, 2.0)
    return np.floor(np.round(t * 1e9) / cut_ns).astype(np.int64) * cut_ns


@pytest.mark.parametrize("rate_hz", [60.0, 100.0, 120.0, 128.0, 150.0, 200.0, 256.0, 400.0, 512.0, 97.3, 333.3])
def test_a_rate_is_found_from_stamps_cut_to_milliseconds_with_pauses(rate_hz: float) -> None:
    chance = np.random.default_rng(round(rate_hz))
    for _ in range(5):
        clock = sample_clock(stamps(rate_hz, chance, cut_ns=MS, pauses=3))
        # Near a third of the stamps' rate the cut stamps are off by a pattern that lasts as long as the record.
        known = 3e-5 if abs(rate_hz - 333.3) > 0.1 else 3.0 * clock.rate_std_hz / rate_hz
        assert abs(clock.rate_hz / rate_hz - 1.0) < known < 5e-4 and clock.pauses == 3


@pytest.mark.parametrize("jitter_s", [0.5e-3, 1e-3, 1.5e-3, 3e-3])
def test_jitter_of_the_stamps_loses_no_sample_and_hardly_any_rate(jitter_s: float) -> None:
    chance = np.random.default_rng(9)
    for _ in range(5):
        rate_hz = float(chance.uniform(90.0, 110.0))
        clock = sample_clock(stamps(rate_hz, chance, jitter_s=jitter_s))
        assert abs(clock.rate_hz / rate_hz - 1.0) < 1e-4 and clock.pauses == 0
        np.testing.assert_array_equal(clock.numbers, np.arange(6000))
        assert np.diff(clock.even_ns).std() < 2e-3 * 1e9 / rate_hz


def test_samples_that_are_lost_one_by_one_leave_jumps() -> None:
    numbers = np.delete(np.arange(6000), [500, 1777, 1778, 4000])
    clock = sample_clock(np.floor(numbers * 1e3 / 128.0).astype(np.int64) * MS)
    np.testing.assert_array_equal(clock.numbers, numbers)
    assert clock.rate_hz == 128.0


@pytest.mark.parametrize(("rate_hz", "share"), [(100.0, 0.1), (100.0, 0.3), (512.0, 0.1)])
def test_samples_that_are_lost_at_random_leave_jumps(rate_hz: float, share: float) -> None:
    numbers = np.flatnonzero(np.random.default_rng(5).random(6000) > share)
    clock = sample_clock(np.round(numbers * 1e9 / rate_hz).astype(np.int64))
    np.testing.assert_array_equal(clock.numbers, numbers - numbers[0])
    assert clock.rate_hz == rate_hz and clock.rate_std_hz < 1e-5 * rate_hz


@pytest.mark.parametrize(("rate_hz", "cut_ns"), [(92.0, 10 * MS), (55.0, 10 * MS), (900.0, MS), (850.0, MS)])
@pytest.mark.parametrize("jitter", [0.0, 0.1])
def test_stamps_cut_to_nearly_the_period_are_no_lost_samples(rate_hz: float, cut_ns: int, jitter: float) -> None:
    chance = np.random.default_rng(3)
    for _ in range(3):
        clock = sample_clock(stamps(rate_hz, chance, cut_ns=cut_ns, jitter_s=jitter * cut_ns * 1e-9, pauses=3))
        assert (clock.rate_hz, clock.pauses) == (rate_hz, 3)


def test_one_late_stamp_is_no_pause() -> None:
    times = np.arange(2000) * 10 * MS
    times[700] += 9 * MS
    clock = sample_clock(times)
    assert clock.pauses == 0 and clock.rate_hz == 100.0


def test_a_clock_that_wanders_knows_its_rate_less_well() -> None:
    chance = np.random.default_rng(2)
    away = []
    for _ in range(20):
        t = (
            np.arange(6000) / 104.2
            + np.cumsum(chance.normal(scale=1e-4, size=6000))
            + chance.normal(scale=1e-3, size=6000)
        )
        clock = sample_clock(np.round(np.maximum.accumulate(t) * 1e9).astype(np.int64))
        away.append((clock.rate_hz - 104.2) / clock.rate_std_hz)
        assert clock.rate_std_hz > 1e-5 * 104.2
    assert np.abs(away).max() < 5.0


def test_whole_seconds_tell_the_rate_of_a_long_record() -> None:
    clock = sample_clock(np.floor(np.arange(60_000) / 100.0).astype(np.int64) * 10**9)
    assert clock.rate_hz == pytest.approx(100.0, rel=1e-4)


@pytest.mark.parametrize("kind", ["random", "still"])
def test_stamps_without_a_pace_are_refused(kind: str) -> None:
    steps = np.random.default_rng(1).uniform(5.0, 15.0, size=500) if kind == "random" else np.zeros(500)
    with pytest.raises(BadInputError, match=r"not evenly spaced|do not rise"):
        sample_clock(np.cumsum(np.round(steps * MS).astype(np.int64)))


def _interleaved(away_s: float) -> np.ndarray:
    return np.sort(np.concatenate([np.arange(3000) / 100.0, np.arange(3000) / 100.0 + away_s]))


@pytest.mark.parametrize(
    "t",
    [
        _interleaved(0.0031),
        np.concatenate([np.arange(3000) / 100.0, 30.0 + np.arange(3000) / 101.0]),
        np.concatenate([np.arange(3000) / 100.0, 29.0 + np.arange(3000) / 100.0]),
        np.arange(6000) / 100.0 + np.random.default_rng(0).exponential(0.03, 6000),
        np.floor(np.flatnonzero(np.random.default_rng(5).random(6000) > 0.1) / 0.512) * 1e-3,
        np.array([0.0, 0.01, 0.05]),
    ],
    ids=["two sensors", "rate changes", "clock set back", "late by periods", "lost and cut", "three stamps"],
)
def test_stamps_that_no_line_fits_are_refused(t: np.ndarray) -> None:
    with pytest.raises(BadInputError, match=r"not evenly spaced|whole number of samples|rate changes"):
        sample_clock(np.round(np.maximum.accumulate(t) * 1e9).astype(np.int64))
