"""Modes alone: an intact frame is left in peace for hours, and a loss of a story is announced."""

from __future__ import annotations

import pytest

from monitor.core import Level
from monitor.pipeline import Pipeline
from tests.statistics.modes_alone import SITE, calibrated, watch


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_an_intact_frame_is_not_announced_for_hours_and_a_loss_of_five_percent_is_within_one(seed: int) -> None:
    baseline = calibrated(2400.0, 40_000 + seed)
    healthy = watch(Pipeline(SITE, baseline), 4 * 3600.0, 50_000 + seed)
    assert healthy.announced() == 0
    assert all(w.skipped is None for w in healthy.windows)
    loss = tuple(0.05 if j == seed % 3 else 0.0 for j in range(3))
    damaged = watch(Pipeline(SITE, baseline), 3600.0, 60_000 + seed, loss)
    assert damaged.announced(Level.WARNING) > 0
    assert all(w.alarm.stories == () for w in damaged.windows)
