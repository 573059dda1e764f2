"""Learning in service: a new season is learned, a slow loss is not, and what was announced is never learned from."""

from __future__ import annotations

import numpy as np
import pytest

from monitor.damage import slow_learning
from monitor.damage.covariate_law import CovariateLaw
from monitor.damage.covariates import Change, CovariateSettings, learn_law

HOUR_NS = 3_600_000_000_000
STD = 1.5e-3
SLOPES = np.array([1.0e-3, 1.5e-3, 0.6e-3])
FROST = 4.0
SETTINGS = CovariateSettings()


def weather(day: np.ndarray) -> np.ndarray:
    """A year from late April on, with days of +-5 K and spells of some days."""
    spells = 3.0 * np.sin(2 * np.pi * day / 5.3) + 2.0 * np.sin(2 * np.pi * day / 2.7 + 1.0)
    return 10.0 + 13.0 * np.sin(2 * np.pi * day / 365.0) + 5.0 * np.sin(2 * np.pi * day) + spells


def healthy_change(degc: np.ndarray) -> np.ndarray:
    return -(np.maximum(degc, 0.0) + FROST * np.minimum(degc, 0.0) - 10.0)[:, None] * SLOPES


def calibrated(seed: int, days: int = 20) -> CovariateLaw:
    rng, degc = np.random.default_rng(seed), weather(np.arange(24 * days) / 24.0)
    x = healthy_change(degc) + STD * rng.standard_normal((degc.size, 3))
    mean = x.mean(axis=0)
    changes = [
        Change(
            np.expm1(row - mean),
            STD * np.eye(3),
            tuple((True, 3 * k + j) for j in range(3)),
            {"temperature": np.array([t])},
        )
        for k, (row, t) in enumerate(zip(x, degc, strict=True))
    ]
    law = learn_law(changes, 0.0, {"temperature": "degC"}, SETTINGS)
    assert law is not None
    return law


def served(law: CovariateLaw, seed: int, days: int, loss_a_month: float, normal_until: float = np.inf):
    """State after service of some days from day 20 on, and the loss that the index would read for a day, shape (days, 3)."""
    rng, read = np.random.default_rng(seed), []
    start = weather(np.arange(480) / 24.0)
    reference = healthy_change(start).mean(axis=0)
    state = slow_learning.start(law, 480 * HOUR_NS)
    for day in range(days):
        hours = 20.0 + day + np.arange(24) / 24.0
        degc = weather(hours)
        lost = np.outer(hours - 20.0, [0.0, loss_a_month / 30.0, 0.0])
        x = healthy_change(degc) - reference + np.log1p(-lost) + STD * rng.standard_normal((24, 3))
        index = []
        for t, row, at in zip(hours, x, degc, strict=True):
            under = {"temperature": np.array([at])}
            index.append(1.0 - np.exp(row) / (1.0 + state.law.expected(under).relative))
            t_ns = round(t * 24) * HOUR_NS
            state = slow_learning.step(state, under, row, t_ns, SETTINGS.unevenness, normal=t < normal_until)
        read.append(np.mean(index, axis=0))
    return state, np.array(read)


@pytest.mark.parametrize("seed", [31, pytest.param(32, marks=pytest.mark.slow)])
def test_a_slow_loss_of_one_percent_a_month_is_not_learned(seed: int) -> None:
    """Six months in which summer comes and goes; nothing is announced, so that the worst is assumed."""
    _, read = served(calibrated(seed), seed + 100, 180, 0.01)
    assert np.abs(read[-10:].mean(axis=0) - [0.0, 0.0575, 0.0]).max() < 0.008
    at = np.arange(180.0) / 30.0 * 0.01
    assert np.abs(read[20:, 1] - at[20:]).max() < 0.015


@pytest.mark.parametrize("seed", [41, pytest.param(42, marks=pytest.mark.slow)])
def test_a_year_with_frost_is_learned(seed: int) -> None:
    law = calibrated(seed)
    state, read = served(law, seed + 100, 345, 0.0)
    cold = {"temperature": np.array([-6.0])}
    before, after = law.expected(cold), state.law.expected(cold)
    true = healthy_change(np.array([-6.0]))[0] - healthy_change(weather(np.arange(480) / 24.0)).mean(axis=0)
    assert (np.sqrt(after.covariance.diagonal()) < 0.35 * np.sqrt(before.covariance.diagonal())).all()
    assert np.abs(np.log1p(after.relative) - true).max() < 0.006 < np.abs(np.log1p(before.relative) - true).max()
    assert np.abs(read[-20:].mean(axis=0)).max() < 0.004
    assert state.law.axes[0].range[0] < -5.0 < law.axes[0].range[0]


def test_what_was_announced_is_never_learned_from() -> None:
    law = calibrated(51)
    state, _ = served(law, 151, 30, 0.0, normal_until=0.0)
    assert state.t_ns.size == 0
    np.testing.assert_array_equal(state.law.slopes, law.slopes)
    waiting, _ = served(law, 151, 2, 0.0)
    assert waiting.t_ns.size > 40
    np.testing.assert_array_equal(waiting.law.slopes, law.slopes)  # nothing has waited long enough
    dropped = slow_learning.step(waiting, {}, np.zeros(3), 10**18, 0.5, normal=False)
    assert dropped.t_ns.size == 0
