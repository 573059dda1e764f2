"""The alarm of a loss about its threshold: windows that overlap by 95 % raise it as before, and do not let it flip."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from monitor.core import Array, Level
from monitor.damage import AlarmSettings, alarm
from tests.support.results import damage_reading

WINDOW_S, HOP_S, HOPS = 400.0, 20.0, 20
STORY, ONSET, SETTLED = 1, 3 * HOPS, 5 * HOPS
HOUR = round(3600.0 / HOP_S)


def levels(loss: float, std: float, seed: int, hours: float, repaired: int | None = None) -> list[Level]:
    """Levels of a story that loses so much at hop `ONSET`; windows err by `std` each, and all by a third of it."""
    rng, hops = np.random.default_rng([seed, round(1e6 * loss), round(1e6 * std)]), round(hours * HOUR)
    white = np.cumsum(rng.standard_normal((hops + HOPS, 3)), axis=0)
    ddi = std * (white[HOPS:] - white[:-HOPS]) / np.sqrt(HOPS) + std / 3.0 * rng.standard_normal(3)
    ddi[:, STORY] += loss * (share_after(ONSET, hops) - (0.0 if repaired is None else share_after(repaired, hops)))
    own, common = std**2 * np.eye(3), (std / 3.0) ** 2 * np.eye(3)
    state, out = alarm.start(3, WINDOW_S), []
    for k, row in enumerate(ddi):
        reading = damage_reading(row, own + common, 1000.0, common_covariance=common)
        state, said = alarm.step(state, reading, round((WINDOW_S + k * HOP_S) * 1e9), AlarmSettings())
        out.append(said.active.get(STORY + 1, Level.NORMAL))
    return out


def share_after(hop: int, hops: int) -> Array:
    """Share of each window that lies after a hop."""
    return np.clip((np.arange(hops) - hop) / HOPS, 0.0, 1.0)


@pytest.mark.parametrize("loss", [0.095, 0.10, 0.105])
def test_a_loss_about_the_threshold_is_one_alarm(loss: float) -> None:
    """Six hours at each of two deviations; by a deadband of one standard deviation the level changed 6 to 10 times in them."""
    changes = []
    for std in (0.003, 0.006):
        settled = levels(loss, std, seed=7, hours=6.0)[SETTLED:]
        changes.append(sum(a is not b for a, b in pairwise(settled)))
        assert settled[-1].rank >= Level.WARNING.rank
    assert max(changes) <= 1, "it falls once it is surely less"


@pytest.mark.parametrize(("loss", "raised"), [(0.105, HOPS + 5), (0.2, HOPS + 2)])
def test_a_repair_ends_the_alarm_within_two_windows_and_nothing_is_raised_later(loss: float, raised: int) -> None:
    """It rises with the first reading that shares no data with the one that first showed it."""
    repaired = SETTLED + HOUR
    said = levels(loss, 0.003, seed=2, hours=3.0, repaired=repaired)
    assert said.index(Level.ALARM) - ONSET <= raised
    ended = max(k for k, level in enumerate(said) if level is Level.ALARM) + 1 - repaired
    assert HOPS <= ended <= 2 * HOPS
    assert said[-1] is Level.NORMAL
