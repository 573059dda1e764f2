"""What a live source may claim: no faster than the clock for long, and nothing from the far future."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from drivers.base import ACCELERATION, TEMPERATURE, SampleBlock
from drivers.can_open import CanSettings
from drivers.live import LiveBounds, LiveSettings
from tests.support.samples import T0_NS

S = 10**9
RATE = 200.0


class Clock:
    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s

    def utc_ns(self) -> int:
        return T0_NS + round(self.now_s * S)


def bounds(clock: Clock, **settings: float) -> LiveBounds:
    return LiveBounds(LiveSettings(**settings), clock, clock.utc_ns)


def block(at_s: float, samples: int = 200, topic: str = ACCELERATION) -> SampleBlock:
    unit = "m/s^2" if topic == ACCELERATION else "degC"
    values = np.zeros((samples, 1), np.float32)
    return SampleBlock(topic, T0_NS + round(at_s * S), max(0, round(at_s * RATE)), RATE, ("a1",), unit, values)


@pytest.mark.parametrize(("samples", "every_s"), [(200, 1.0), (2, 0.05), (2, 500.0)])
def test_a_flood_is_held_to_the_pace_however_it_is_cut(samples: int, every_s: float) -> None:
    """Whole blocks, scraps with gaps between them, and jumps: a minute of flood brings ten minutes of data and two of pace."""
    clock = Clock()
    judge, at_s, reached_s = bounds(clock, max_pace=2.0), 0.0, 0.0
    for _ in range(6000):
        clock.now_s += 0.01
        if judge.refusal(block(at_s, samples)) is None:
            reached_s = at_s + samples / RATE
            at_s += every_s
    assert 100.0 < reached_s <= 600.0 + 120.0 + 1.0


def test_a_stream_at_the_pace_of_the_clock_passes_with_its_cache_and_after_a_pause() -> None:
    clock = Clock()
    judge = bounds(clock, max_pace=2.0)
    assert all(judge.refusal(block(k)) is None for k in range(64)), "the cache of a sensor"
    for k in range(64, 3000):
        clock.now_s = k - 63.0
        assert judge.refusal(block(k)) is None
        assert judge.refusal(block(k, topic=TEMPERATURE)) is None
    clock.now_s += 300.0
    assert all(judge.refusal(block(k)) is None for k in range(3000, 3300)), "what came late after a broken link"


def test_after_a_jump_of_the_clock_a_stream_is_accepted_again() -> None:
    clock = Clock()
    judge, refused = bounds(clock, max_pace=2.0), 0
    for k in range(2000):
        clock.now_s = float(k)
        refused += judge.refusal(block(k if k < 1000 else k + 86_400)) is not None
    assert refused <= 1, "the allowance is full after so long"


def test_the_far_future_is_refused_by_a_clock_that_was_set() -> None:
    clock = Clock()
    judge = bounds(clock, max_ahead_s=3600.0)
    assert judge.refusal(block(3599.0)) is None and judge.refusal(block(-1e8)) is None
    assert "max_ahead_s = 3600" in str(judge.refusal(block(3601.0)))
    unset = LiveBounds(LiveSettings(max_ahead_s=3600.0), clock, lambda: 86_400 * S)
    assert unset.refusal(block(0.0)) is None


def test_without_bounds_a_stream_runs_as_it_likes() -> None:
    judge = bounds(Clock())
    assert all(judge.refusal(block(at_s)) is None for at_s in (0.0, 1e6, 0.0, 2e9))


def test_a_log_has_no_pace() -> None:
    table = {"interface": "log", "channel": "a.blf", "dbc": "a.dbc", "sample_rate_hz": 100.0}
    CanSettings.model_validate(table)
    with pytest.raises(ValidationError, match="leave them out for a log"):
        CanSettings.model_validate({**table, "max_pace": 2.0})
