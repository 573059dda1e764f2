"""The smallest detectable loss: it is seen as often as it says, and says less when less was seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from monitor.core import Array, DamageReading, Level
from monitor.damage import alarm
from monitor.damage.alarm import AlarmSettings, AlarmState
from monitor.damage.detectable_loss import PROBABILITY, WITHIN_S, smallest_detectable_loss
from monitor.damage.kernels import seen_by_most
from monitor.damage.limits import Scores
from tests.support.results import damage_reading

HOP_S, WINDOW_S, N = 10.0, 400.0, 40
SETTINGS = AlarmSettings()
TESTS = Scores(3, 0)
STD = np.array([0.00108, 0.00137, 0.00152])


def reading(
    ddi: Array, std: Array = STD, common: Array = 0.3 * STD, unidentified: tuple[int, ...] = ()
) -> DamageReading:
    own, shared = np.diag(std**2), np.diag(common**2)
    return damage_reading(ddi, own + shared, common_covariance=shared, unidentified=unidentified)


def after(hours: float, std: Array = STD) -> AlarmState:
    state = alarm.start(std.size, WINDOW_S)
    for k in range(int(hours * 3600.0 / HOP_S)):
        state, _ = alarm.step(state, reading(np.zeros(std.size), std, 0.3 * std), int(k * HOP_S * 1e9), SETTINGS)
    return state


def smallest(state: AlarmState, std: Array = STD, **more: tuple[int, ...]) -> Array:
    return smallest_detectable_loss(reading(0.0 * std, std, 0.3 * std, **more), state.history, SETTINGS, TESTS)


def seen(loss: float, story: int, rng: np.random.Generator) -> bool:
    """Whether the alarm itself warns of a sudden loss within the stated time; windows overlap, so their errors are correlated."""
    healthy, looks = 8 * N, int(WITHIN_S / HOP_S)
    increments = rng.standard_normal((healthy + looks, 3)) * STD * np.sqrt(N)
    increments[healthy:, story] += loss
    total = np.vstack([np.zeros(3), np.cumsum(increments, axis=0)])
    state, off = alarm.start(3, WINDOW_S), rng.standard_normal(3) * 0.3 * STD
    for i in range(N, len(total)):
        damage = reading((total[i] - total[i - N]) / N + off, STD * np.exp(0.13 * rng.standard_normal()))
        state, said = alarm.step(state, damage, int(i * HOP_S * 1e9), SETTINGS)
        if i > healthy and said.active.get(story + 1, Level.NORMAL).rank >= Level.WARNING.rank:
            return True
    return False


def power(trials: int, seed: int) -> float:
    rng, loss = np.random.default_rng(seed), smallest(after(2.0))
    return float(np.mean([seen(float(loss[k % 3]), k % 3, rng) for k in range(trials)]))


@pytest.mark.engine
def test_it_is_seen_about_as_often_as_stated() -> None:
    assert power(30, 1) > 0.75, "by the binomial 1 % limit of 90 %"


@pytest.mark.slow
def test_of_500_such_losses_the_stated_share_is_seen() -> None:
    assert abs(power(500, 2) - PROBABILITY) < 0.05


def test_fewer_false_announcements_and_fewer_degrees_of_freedom_see_less() -> None:
    history, damage = after(2.0).history, reading(0.0 * STD)
    losses = [
        smallest_detectable_loss(
            replace(damage, freedom=freedom), history, AlarmSettings(false_announcements_per_year=rate), TESTS
        )
        for rate, freedom in ((10.0, np.inf), (0.1, np.inf), (0.1, 10.0), (0.1, 3.0))
    ]
    assert (np.diff(losses, axis=0) > 0.0).all()


def test_readings_that_come_once_an_hour_see_a_loss_too_by_as_many_of_them() -> None:
    state = alarm.start(3, WINDOW_S)
    for hour in range(12):
        state, _ = alarm.step(state, reading(0.0 * STD), hour * 3_600_000_000_000, SETTINGS)
    assert (smallest(state) < 1.1 * smallest(after(2.0))).all()


def test_a_young_run_sees_less_and_one_window_confirms_nothing() -> None:
    first, hour, day = (smallest(after(h)) for h in (HOP_S / 3600.0, 0.3, 2.0))
    assert np.isinf(first).all()
    assert (hour > 1.2 * day).all()


def test_scale_follows_the_deviations_and_what_the_modes_do_not_see_is_never_seen() -> None:
    small, large = smallest(after(2.0)), smallest(after(2.0, 3.0 * STD), 3.0 * STD)
    assert large / small == pytest.approx(3.0 * np.ones(3), rel=0.1)
    assert np.isinf(smallest(after(2.0), unidentified=(2,))).tolist() == [False, True, False]
    again = smallest(after(2.0))
    assert (again == small).all(), "the same state gives the same number"


@pytest.mark.parametrize(("n", "looks"), [(3, 30), (3, 9), (2, 30), (1, 30)])
def test_leaving_out_trials_that_need_little_changes_nothing(n: int, looks: int) -> None:
    rng, trials, first, unseen = np.random.default_rng(5), 60, 33, 6
    lengths = np.array([4, 8, 16, 32])
    total = np.cumsum(rng.standard_normal((trials, n, first + looks + 3)), axis=2)
    factor = np.maximum(lengths[:, None] / np.arange(1, looks + 1), 1.0)
    of_error, of_alone = rng.standard_normal((2, 4, n, n)) / lengths[:, None, None]
    off, alone_off = 0.1 * rng.standard_normal((trials, n)), 0.1 * rng.standard_normal((4, trials, n))
    needed, square = rng.uniform(1.0, 2.0, (2, 4, n))
    leak = rng.uniform(0.5, 1.0, (4, n))
    leak[:2, 0], leak[:, 1:2] = 0.0, -1.0  # of the first story two stretches say nothing, of the second all
    needs = np.full((trials, n, looks), np.inf)
    for s, length in enumerate(lengths):
        passed = total[:, :, first : first + looks] - total[:, :, first - length : first + looks - length]
        error, alone = of_error[s] @ passed + off[:, :, None], of_alone[s] @ passed + alone_off[s, :, :, None]
        with np.errstate(all="ignore"):
            a = leak[s, :, None]
            alike = (np.sqrt((1.0 - a) * alone**2 + a * square[s, :, None]) - alone) / a
        loss = factor[s] * np.maximum(needed[s, :, None] - error, alike)
        needs = np.where(a > 0.0, np.minimum(needs, loss), needs)
    rest = needed, leak, square, unseen
    seen = seen_by_most(total, first, lengths, factor, of_error, off, of_alone, alone_off, *rest)
    np.testing.assert_allclose(seen, np.sort(needs.min(axis=2), axis=0)[-1 - unseen], rtol=1e-9)
    assert np.isinf(seen).tolist() == [False, True, False][:n]
