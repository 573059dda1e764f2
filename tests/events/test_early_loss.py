"""The loss that the motion just before and just after an event tells: with its interval, or nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from monitor.events.limits import judge
from monitor.publish import event_text
from tests.events.shaken import Array
from tests.support.losing_quake import final, shaken


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
