"""What the stories do together without a channel: learned from healthy weeks, taken out, and no story's own loss hidden by it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from monitor.core import WHOLE, encode
from monitor.damage import AlarmSettings, alarm, slow_learning
from monitor.damage.common_change import EVERY_NS, UNMEASURED, Expected, learn_common, nothing_learned
from monitor.damage.covariate_law import CovariateLaw
from monitor.damage.covariates import Change, CovariateSettings, common_words, learn_law, read_law
from tests.support.results import damage_reading

HOUR_NS = 3_600_000_000_000
STD = np.array([1.0e-3, 1.7e-3, 1.8e-3])
FOLLOWS = np.array([1.0e-3, 1.5e-3, 0.8e-3])
"""Relative change of the stories' stiffness a K, which no channel measures."""
NOISE = np.diag(STD**2)
UNEVENNESS = CovariateSettings().unevenness
ANYWHERE = np.array([[-1.0] * 5, [1.0] * 5])
"""Losses that were all seen."""


def air(hours: np.ndarray) -> np.ndarray:
    """Temperature about its mean: days, spells of five days, and a season."""
    day = hours / 24.0
    return 4.0 * np.sin(2 * np.pi * day) + 3.0 * np.sin(2 * np.pi * day / 5.3) + 12.0 * np.sin(2 * np.pi * day / 365.0)


def changes_of(
    hours: np.ndarray, seed: int, lost: np.ndarray | float = 0.0, follows: np.ndarray = FOLLOWS
) -> np.ndarray:
    noise = STD * np.random.default_rng(seed).standard_normal((hours.size, 3))
    return np.asarray(-air(hours)[:, None] * follows + noise + np.log1p(-np.asarray(lost)))


def law_of(days: int, seed: int = 1, follows: np.ndarray = FOLLOWS) -> CovariateLaw:
    """Learned at a steady level of motion, in windows of an hour."""
    hours = np.arange(24.0 * days)
    x = changes_of(hours, seed, follows=follows)
    level = {"level": np.array([-120.0])}
    changes = [
        Change(np.expm1(row - x.mean(axis=0)), np.diag(STD), tuple((True, 3 * k + j) for j in range(3)), level, t)
        for k, (row, t) in enumerate(zip(x, (hours * HOUR_NS).astype(int).tolist(), strict=True))
    ]
    law = learn_law(changes, 0.0, {"level": "dB"}, CovariateSettings())
    assert law is not None
    return law


@pytest.fixture(scope="module")
def expected() -> Expected:
    learned = law_of(60).together(UNEVENNESS)
    assert learned is not None
    return learned


def test_what_the_stories_do_together_is_learned(expected: Expected) -> None:
    assert abs(float(expected.leading @ FOLLOWS) / np.linalg.norm(FOLLOWS)) > 0.999
    assert expected.stretches == pytest.approx(29.0, abs=0.05)  # of 60 days, the last two wait


def test_too_little_and_mere_noise_teach_nothing_and_it_is_said() -> None:
    short, still = law_of(8), law_of(20, follows=np.zeros(3))
    assert short.together(UNEVENNESS) is None and still.together(UNEVENNESS) is None
    assert common_words(short) == "not learned: 3 of 4 stretches of two days"
    assert "nothing beyond the noise" in str(common_words(still))
    assert str(common_words(law_of(20))).startswith("learned from 9")


@pytest.mark.parametrize("degc", [-5.0, 5.0, 15.0])
@pytest.mark.parametrize("lost", [(), (0,), (1,), (2,), (0, 1), (1, 2), (0, 2)])
def test_a_loss_is_seen_where_it_is_in_any_weather(expected: Expected, degc: float, lost: tuple[int, ...]) -> None:
    loss = degc * FOLLOWS
    loss[list(lost)] += 0.05
    beside = expected.beside_others(loss, NOISE / 8.0)
    z = beside.loss / beside.std
    assert (z[list(lost)] > 6.5).all()
    np.testing.assert_allclose(beside.loss[list(lost)], 0.05, atol=0.005)
    assert (np.delete(z, list(lost)) < 3.0).all()


def test_a_loss_of_all_as_in_the_weather_is_not_told_from_it(expected: Expected) -> None:
    beside = expected.beside_others(0.05 * FOLLOWS / FOLLOWS.max(), NOISE)
    assert (np.abs(beside.loss / beside.std) < 1.0).all()


def test_a_change_of_all_alike_is_no_storys() -> None:
    """Snow on a structure of five stories, whose weather has another pattern."""
    follows = np.array([1.0, 1.5, 0.8, 0.3, 1.2])
    learned = Expected(1e-5 * np.outer(follows, follows), follows / np.linalg.norm(follows), 30.0, ANYWHERE, UNEVENNESS)
    beside = learned.beside_others(0.004 * follows + 0.03, 1e-6 * np.eye(5))
    assert (np.abs(beside.loss / beside.std) < 3.0).all()


def test_the_uncertainty_grows_with_the_weather_and_less_was_learned(expected: Expected) -> None:
    def std(degc: float, stretches: float) -> np.ndarray:
        return replace(expected, stretches=stretches, unevenness=0.0).beside_others(degc * FOLLOWS, NOISE).std

    assert (std(30.0, 10.0) > 1.5 * std(3.0, 10.0)).all()
    assert (std(30.0, 10.0) > 1.5 * std(30.0, 100.0)).all()


@pytest.mark.parametrize("lost", [(), (0,), (1,), (2,), (0, 1), (1, 2), (0, 2)])
def test_beyond_what_was_learned_the_stories_may_part_and_a_great_loss_is_seen(
    expected: Expected, lost: tuple[int, ...]
) -> None:
    """A frost of 10 K with 4, 2 and 6 times the slope, of which the months of learning had none."""
    expected = replace(expected, stretches=150.0)
    loss = -10.0 * FOLLOWS * np.array([4.0, 2.0, 6.0])
    narrow = replace(expected, unevenness=0.0).beside_others(loss, NOISE)
    assert (narrow.loss / narrow.std).max() > 6.5
    beside = expected.beside_others(loss, NOISE)
    assert (beside.loss / beside.std).max() < 3.0
    assert beside.beyond_words(0.015) == "what the stories do together goes beyond anything learned"
    # Where the others stay within what was learned, a loss does not hide itself.
    loss = 5.0 * FOLLOWS
    loss[list(lost)] += 0.2
    beside = expected.beside_others(loss, NOISE)
    assert (beside.loss[list(lost)] > 6.5 * beside.std[list(lost)]).all()
    # Beside two lost stories the third is compared with them alone, and little is known of it.
    assert bool(beside.beyond_words(0.015)) == (len(lost) == 2)


def test_a_change_counts_as_learned_once_enough_stretches_went_as_far() -> None:
    """Three stories: four stretches of two days, one after the other or with weather of another kind between them."""
    common, per = nothing_learned(3), 48
    for stretch in range(8):
        for k in range(per):
            cold = stretch % 2 == 0 and k == 7
            common = common.add(np.zeros(3), np.array([0.03, 0.04, -0.02]) if cold else np.zeros(3))
        reached = -np.expm1([0.03, 0.04, -0.02]) if stretch >= 6 else np.zeros(3)
        np.testing.assert_allclose(common.seen(), [np.minimum(reached, 0.0), np.maximum(reached, 0.0)], atol=1e-12)


def test_the_index_and_its_deviation_are_of_what_is_left(expected: Expected) -> None:
    rng, common = np.random.default_rng(3), np.diag(STD**2) / 100.0
    z = []
    for degc in rng.normal(0.0, 4.0, 300):
        ddi = degc * FOLLOWS + STD * rng.standard_normal(3)
        measured = damage_reading(ddi, NOISE + common, 1e6, common_covariance=common)
        reading = expected.take_out(measured, expected.beside_others(ddi, NOISE + common))
        np.testing.assert_allclose(reading.ddi - reading.covariate_effect[UNMEASURED], ddi)
        np.testing.assert_allclose(reading.loss_n_per_m, 1e6 * reading.ddi)
        z.append(reading.ddi / reading.ddi_std)
    assert 0.8 < np.std(z) < 1.1


def test_a_slow_loss_is_not_learned() -> None:
    """Six weeks of 1 % a month in story 2, never announced, teach the same as without."""
    law = law_of(20)
    healthy, hurt = slow_learning.start(law, 480 * HOUR_NS), slow_learning.start(law, 480 * HOUR_NS)
    hours = np.arange(480.0, 480.0 + 1080.0)
    lost = np.outer((hours - 480.0) / 720.0, [0.0, 0.01, 0.0])
    under = {"level": np.array([-120.0])}
    for t, one, other in zip(hours, changes_of(hours, 2), changes_of(hours, 2, lost), strict=True):
        t_ns = int(t) * HOUR_NS
        healthy = slow_learning.step(healthy, under, one, t_ns, 0.5, normal=True)
        hurt = slow_learning.step(hurt, under, other, t_ns, 0.5, normal=True)
    one_law, other_law = healthy.law.together(UNEVENNESS), hurt.law.together(UNEVENNESS)
    assert one_law.stretches > 29.0
    assert float(one_law.leading @ other_law.leading) > 0.9999
    np.testing.assert_allclose(other_law.covariance, one_law.covariance, rtol=0.1, atol=1e-7)


def test_a_sudden_loss_that_was_not_announced_is_not_learned_as_weather() -> None:
    """5 % of two stories after six weeks; the windows before it and after it all pass for healthy."""
    state, under = slow_learning.start(law_of(40), 960 * HOUR_NS), {"level": np.array([-120.0])}
    hours = np.arange(960.0, 960.0 + 240.0)
    lost = np.outer(hours >= 1032.0, [0.05, 0.0, 0.05])
    for t, row in zip(hours, changes_of(hours, 2, lost), strict=True):
        state = slow_learning.step(state, under, row, int(t) * HOUR_NS, 0.5, normal=True)
    learned = state.law.together(UNEVENNESS)
    assert learned is not None and learned.stretches > 22.9
    assert abs(learned.leading @ FOLLOWS) > 0.98 * np.linalg.norm(FOLLOWS)
    beside = replace(learned, seen=ANYWHERE[:, :3]).beside_others(np.array([0.05, 0.0, 0.05]), NOISE)
    assert (beside.loss[[0, 2]] > 6.5 * beside.std[[0, 2]]).all()


def test_the_alarm_is_silent_in_uneven_weather_and_finds_a_loss(expected: Expected) -> None:
    """In the hottest weeks; without what was learned, the weather itself is announced as a loss."""
    settings = AlarmSettings()

    def announced(lost: float, learned: Expected | None) -> set[int]:
        state, told = alarm.start(3, 400.0), set()
        hours = np.arange(1900.0, 2200.0)
        for t, row in zip(hours, changes_of(hours, 4) + np.log1p(-lost) * np.array([0.0, 1.0, 0.0]), strict=True):
            ddi = -np.expm1(row)
            reading = damage_reading(ddi, 1.01 * NOISE, common_covariance=0.01 * NOISE)
            state, verdict = alarm.step(state, reading, int(t) * HOUR_NS, settings, learned)
            told |= {story for story in verdict.active if story != WHOLE}
        return told

    assert announced(0.0, expected) == set()
    assert announced(0.02, expected) == {2}
    assert announced(0.0, None)


def test_it_survives_the_baselines_file() -> None:
    law = law_of(20)
    content = encode(law)
    read = read_law(content, 3)
    np.testing.assert_array_equal(read.common.square, law.common.square)
    assert read.common.windows == law.common.windows
    np.testing.assert_array_equal(read.common.lowest, law.common.lowest)
    none = read_law({**content, "common": None}, 3)
    assert none is not None and none.together(UNEVENNESS) is None
    for damage in ({"square": [[1.0]]}, {"lowest": [[1.0]]}, {"windows": -1}):
        with pytest.raises(ValueError, match=r"common|covariates are damaged"):
            read_law({**content, "common": content["common"] | damage}, 3)


def test_windows_an_hour_apart_are_taken_however_many_there_are() -> None:
    hours = np.arange(24.0 * 20)
    x = changes_of(hours, 1)
    once = learn_common(x, (hours * HOUR_NS).astype(np.int64), np.diag(STD))
    often = learn_common(np.repeat(x, 4, axis=0), np.repeat((hours * HOUR_NS).astype(np.int64), 4), np.diag(STD))
    assert once.windows == often.windows == 24 * 18 and EVERY_NS == HOUR_NS
    np.testing.assert_array_equal(once.square, often.square)
