"""False alarms and detection: a seeded sample in CI, the whole with `make test-slow`."""

from __future__ import annotations

import numpy as np
import pytest

from monitor.core import DamageReading, Level
from monitor.damage import AlarmSettings, alarm, sequential_test
from tests.damage.alarm_twin import HOP_S, TWIN, WINDOW, WINDOW_S, evidence, ideal, limit
from tests.statistics.alarms import (
    THRESHOLD,
    delay,
    detection,
    false_alarms,
    ramp,
    raw_baseline,
    raw_detection,
    raw_readings,
)
from tests.support.results import damage_reading


def readings(hops: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return TWIN.readings(hops, 14400.0, np.random.default_rng(seed))


def reading(ddi: np.ndarray, variance: np.ndarray, common: np.ndarray) -> DamageReading:
    return damage_reading(ddi, np.diag(variance + common), common_covariance=np.diag(common))


def end_ns(k: int) -> int:
    return round((WINDOW_S + HOP_S * k) * 1e9)


def test_the_twin_judges_as_the_alarm_does() -> None:
    """Beyond the eight hours over which standard deviations are smoothed."""
    ddi, variance, common = readings(3300, 3)
    ddi[2900:3200, 1] += 0.004
    fast = evidence(ddi, variance, common, -9.0)
    history, judged = sequential_test.begin(3, WINDOW_S), []
    for k, row in enumerate(ddi):
        seen = reading(row, variance[k], common)
        history, found = sequential_test.look(history, seen, end_ns(k), AlarmSettings().model_form)
        judged.append((found.z, found.lasting))
    np.testing.assert_allclose(np.swapaxes(judged, 0, 1), fast, rtol=1e-9)


def test_the_twin_confirms_as_the_alarm_does() -> None:
    ddi, variance, common = readings(400, 4)
    ddi[:, 2] += 0.01 * ramp(2000.0, 400)
    z, lasting = evidence(ddi, variance, common, 0.0)
    state = alarm.start(3, WINDOW_S)
    warned = None
    for k, row in enumerate(ddi):
        state, verdict = alarm.step(state, reading(row, variance[k], common), end_ns(k), AlarmSettings())
        if warned is None and verdict.level is Level.WARNING:
            warned = k
    assert warned == delay(z[:, 2], lasting[:, 2], 0, THRESHOLD)


def test_as_many_false_announcements_as_are_allowed_and_fewer_of_them_confirmed() -> None:
    """Half a year; a sample of `tests.statistics.alarms`."""
    announced, confirmed = false_alarms(0.5, np.array([limit(40.0), limit(10.0), THRESHOLD]), seed=101, twin=ideal(3))
    assert 9 <= announced[0] <= 33, "20 by the rate: the Poisson limits of 0.5 and 99.5 %"
    assert announced[1] <= 12 and announced[2] == 0
    assert confirmed[0] < announced[0]


@pytest.mark.slow
@pytest.mark.parametrize(("parts", "either_side"), [(3, False), (10, False), (3, True)])
def test_thirty_years_have_the_stated_false_announcements(parts: int, either_side: bool) -> None:
    thresholds = np.array([limit(10.0, parts, either_side=either_side)])
    (count,), _ = false_alarms(30.0, thresholds, seed=113, twin=ideal(parts), either_side=either_side)
    assert 240 <= count <= 360


def test_weather_alike_in_all_stories_raises_no_storys_alarm() -> None:
    assert false_alarms(1.0 / 12.0, np.array([THRESHOLD]), weather=0.015, seed=102)[0, 0] == 0


@pytest.mark.parametrize("story", [0, 1, 2])
def test_small_losses_are_found_in_time(story: int) -> None:
    one, half = detection(0.01, story, 800.0, 200, seed=103), detection(0.005, story, 3600.0, 100, seed=104)
    assert one.found >= 0.97 and one.wrong == 0
    assert half.found >= 0.95 and half.wrong == 0


@pytest.mark.engine
def test_a_raw_record_is_judged_like_the_twin() -> None:
    healthy = raw_baseline(1200.0, 105)
    windows = raw_readings([(600.0, {}), (600.0, {3: 0.03})], 106, healthy, hop_s=25.0)
    assert {r.alarm.level for r in windows if r.t_end_ns <= 600e9} == {Level.NORMAL}
    assert windows[-1].alarm.level is Level.WARNING and windows[-1].alarm.stories == (3,)
    assert {j for r in windows for j in r.alarm.active} == {3}


@pytest.mark.slow
def test_thirty_years_without_a_false_alarm_at_six_and_a_half() -> None:
    thresholds = np.array([5.0, 5.5, 6.0, 6.5])
    for baseline_s in (1200.0, 14400.0):
        counts, _ = false_alarms(30.0, thresholds, baseline_s=baseline_s, seed=107)
        print(f"\nbaseline {baseline_s:g} s, 30 years at {thresholds}: {counts}")
        assert counts[-1] == 0


@pytest.mark.slow
@pytest.mark.parametrize("story", [0, 1, 2])
def test_a_loss_of_one_percent_is_found_within_800_s_in_99_of_100_trials(story: int) -> None:
    one = detection(0.01, story, 800.0, 4000, seed=108, baseline_s=86400.0)
    half = detection(0.005, story, 3600.0, 2000, seed=109, baseline_s=86400.0)
    print(f"\nstory {story + 1}: 1 % {one}, 0.5 % {half}")
    assert one.found >= 0.985 and one.wrong <= 0.001
    assert half.found >= 0.95 and half.wrong <= 0.001


@pytest.mark.slow
def test_raw_records_agree_with_the_twin() -> None:
    healthy = raw_baseline(14400.0, 110)
    raw = [r.damage for r in raw_readings([(20_000.0, {})], 111, healthy) if r.damage is not None]
    ddi = np.array([d.ddi for d in raw])
    own = np.array([np.diag(d.covariance - d.common_covariance) for d in raw])
    error = ddi - ddi.mean(axis=0)
    np.testing.assert_allclose(error.std(axis=0), TWIN.std, rtol=0.3)  # fifty independent windows
    np.testing.assert_allclose(np.sqrt(own.mean(axis=0)), TWIN.std, rtol=0.1)
    for lag in (1, 5, 10, 20):
        correlation = (error[lag:] * error[:-lag]).mean(axis=0) / error.var(axis=0)
        np.testing.assert_allclose(correlation, 1.0 - lag / WINDOW, atol=0.01 + 0.01 * lag)
    found = raw_detection(0.01, 800.0, 6, seed=112)
    print("\n" + "\n".join(found))
    assert sum("never" in line for line in found) <= 1
