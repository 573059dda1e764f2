"""Storms over an intact frame announce nothing after one calm hour, and hide no loss after two days."""

from __future__ import annotations

import numpy as np
import pytest

from tests.statistics.storm import SHAPES, trial_a, trial_b
from tests.support.campaign import each

SEEDS = (11, 12, 13, 14, 15)
pytestmark = [pytest.mark.slow, pytest.mark.parametrize("shape", SHAPES)]


def test_after_one_calm_hour_a_storm_announces_nothing(shape: str) -> None:
    for seed, trial in zip(SEEDS, each(trial_a, [(shape, seed) for seed in SEEDS], keep=True), strict=True):
        for name, told in trial.items():
            index = np.round(100 * told.ddi, 2)
            print(f"{shape}, seed {seed}, {name}: judged {100 * told.judged:.0f} %, index {index} %")
            assert told.announced == (), (seed, name)
            assert told.judged > 0.9, (seed, name)


def test_after_48_hours_at_many_levels_a_loss_in_a_storm_is_found_and_read_right(shape: str) -> None:
    for seed, trial in zip(SEEDS, each(trial_b, [(shape, seed) for seed in SEEDS], keep=True), strict=True):
        intact, lost = trial.values()
        print(f"{shape}, seed {seed}: {np.round(100 * intact.ddi, 2)} %, lost {np.round(100 * lost.ddi, 2)} %")
        assert intact.announced == (), seed
        assert lost.announced == (2,), seed
        assert min(intact.judged, lost.judged) >= 0.8, seed
        assert np.abs(lost.ddi - [0.0, 0.05, 0.0]).max() < 0.01, seed
