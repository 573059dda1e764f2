"""The loss that the motion just before and just after an event tells: with its interval, or nothing."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from monitor.events import Event
from monitor.events.limits import judge
from monitor.pipeline import Pipeline
from monitor.publish import event_text
from tests.events.shaken import RATE, STIFFNESS, Array, Shaken, blocks, configuration, kanai_tajimi, shake

LIMIT = {"residual_loss": 0.05, "says": "send the engineer"}


@cache
def shaken(lost: float, seed: int, after_s: float = 75.0) -> Shaken:
    """70 s of ambient motion, a quake of 20 s after which story 2 has lost a share of its stiffness, and ambient motion."""
    rng = np.random.default_rng(seed)
    wave = np.concatenate([np.zeros(round(70 * RATE)), kanai_tajimi(20.0, 1.0, 2.5, rng)])
    first, state = shake(wave, rng)
    stiffness = STIFFNESS * np.array([1.0, 1.0 - lost, 1.0])
    second, _ = shake(np.zeros(round(after_s * RATE)), rng, stiffness=stiffness, start=state)
    return Shaken(*(np.concatenate([getattr(first, n), getattr(second, n)]) for n in ("floors", "ground", "drifts")))


def final(motion: Shaken, **events: object) -> tuple[Event, Pipeline]:
    pipeline = Pipeline(configuration(events={"limits": [LIMIT], **events}))
    told = [r for b in blocks(motion, n=1000) for r in pipeline.push(b) if isinstance(r, Event)]
    (event,) = (e for e in told if e.revision == 0)
    return event, pipeline


@pytest.mark.parametrize(("lost", "verdict"), [(0.0, None), (0.3, "send the engineer")])
def test_the_interval_holds_the_truth_and_a_great_loss_is_told_within_a_minute(
    lost: float, verdict: str | None
) -> None:
    errors: list[Array] = []
    for seed in range(4):
        event, _ = final(shaken(lost, seed))
        assert (event.loss_std < 0.15).all() and event.verdict == verdict
        errors.append((event.loss - [0.0, lost, 0.0]) / event.loss_std)
    assert np.abs(errors).max() < 3.0 and np.sqrt(np.mean(np.square(errors))) < 1.5
    assert not lost or "% of stiffness in story 2" in event_text(event)


def test_what_cannot_be_told_is_null_and_says_why() -> None:
    dead = shaken(0.0, 0).floors.copy()
    dead[:, 1] = 0.0
    event, _ = final(replace(shaken(0.0, 0), floors=dead))
    assert np.isnan(event.loss).all() and "without every sensor no loss is told yet" in event.note
    short, _ = final(shaken(0.0, 0), post_s=2.0, merge_s=2.0)
    assert np.isnan(short.loss).all() and "too few to tell a loss of 3 stories yet" in short.note


def test_a_loss_counts_against_its_limit_with_its_whole_interval() -> None:
    event, pipeline = final(shaken(0.0, 0))

    def verdict(loss: float, std: float, revision: int) -> str | None:
        known = replace(event, loss=np.array([0.0, loss, 0.0]), loss_std=np.full(3, std), revision=revision)
        return judge(known, pipeline.site).verdict

    assert [verdict(0.1, std, 0) for std in (0.02, 0.03)] == ["send the engineer", None]
    assert [verdict(0.01, std, 1) for std in (0.01, 0.03)] == ["no limit exceeded", None]
