"""Recordings that repeat themselves, and such as only resemble themselves, in vibrations whose truth is known."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from monitor.diagnosis import cross_validation
from monitor.diagnosis.repetition import find_repetition, state_repetition
from tests.support.vibration import RATE_HZ, segments, vibration


@dataclass(frozen=True)
class _Diagnosis:
    """What of a diagnosis the verdict on a repetition needs."""

    verdict: str
    causes: tuple[str, ...]
    left_over: tuple[object, ...]


@pytest.mark.parametrize("period_s", [20.48, 33.0, 61.7])
@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_a_period_is_found_beneath_noise(period_s: float, noise: float) -> None:
    one = vibration(7)[: round(period_s * RATE_HZ)]
    samples = np.tile(one, (6, 1))
    samples = samples + noise * one.std() * np.random.default_rng(1).standard_normal(samples.shape)
    found = find_repetition(segments(samples))
    assert found is not None
    repeats = found / period_s
    assert repeats == pytest.approx(round(repeats), abs=0.01)


@pytest.mark.parametrize("seed", range(6))
def test_random_motion_does_not_repeat(seed: int) -> None:
    assert find_repetition(segments(vibration(seed))) is None


def test_a_strong_tone_is_no_repetition() -> None:
    samples = vibration(3)
    t = np.arange(len(samples)) / RATE_HZ
    assert find_repetition(segments(samples + 10.0 * samples.std() * np.sin(2 * np.pi * 5.0 * t)[:, None])) is None


def test_a_strong_motion_and_its_aftermath_are_no_repetition() -> None:
    samples = vibration(4) * (1.0 + 100.0 * np.exp(-((np.arange(20000) / RATE_HZ - 60.0) ** 2) / 50.0))[:, None]
    assert find_repetition(segments(samples)) is None


def test_blows_by_hand_are_no_repetition() -> None:
    rng, n = np.random.default_rng(5), 20000
    response = np.exp(-np.arange(300) / 60.0)[:, None] * np.sin(np.outer(np.arange(300), [0.2, 0.5, 0.9]))
    samples, force, at = np.zeros((n, 3)), np.zeros((n, 1)), 0
    while (at := at + round(RATE_HZ * rng.uniform(2.5, 4.0))) < n - 300:
        samples[at : at + 300] += response
        force[at] = 1.0
    samples += 0.01 * rng.standard_normal(samples.shape)
    assert find_repetition(segments(samples, force)) is None


def test_gaps_do_not_hide_a_period() -> None:
    given = segments(np.tile(vibration(7)[:2048], (10, 1)))
    kept = np.random.default_rng(2).random(given.t_s.size) > 0.3
    assert find_repetition(given.part(kept)) == pytest.approx(20.48, abs=0.05)


def test_causes_are_listed_unconfirmed_and_a_clean_recording_stays_clean() -> None:
    given = segments(np.tile(vibration(7)[:2048], (10, 1)))
    diagnosis = _Diagnosis("named", ("cause",), ())
    found, gain = cross_validation.confirm_on_held_out(given, diagnosis)  # type: ignore[arg-type]
    assert found.verdict == "unexplained" and found.causes == ("cause",)
    assert "repeats itself every 20.5 s" in found.left_over[0].says and "20.5 s" in gain.withheld
    assert state_repetition(replace(diagnosis, verdict="none"), 20.5).verdict == "none"  # type: ignore[type-var]
