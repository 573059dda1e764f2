"""Storms over an intact frame announce nothing after one calm hour, and hide no loss after two days."""

from __future__ import annotations

import numpy as np
import pytest

from tests.statistics.storm import SHAPES, trial_a, trial_b

SEEDS = (11, 12, 13, 14, 15)


@pytest.mark.slow
@pytest.mark.parametrize("shape", SHAPES)
def test_after_one_calm_hour_a_storm_announces_nothing(shape: str) -> None:
    for seed in SEEDS:
        for name, told in trial_a(shape, seed).items():
            print(
                f"{shape}, seed {seed}, {name}: judged {100 * told.judged:.0f} %, index {np.round(100 * told.ddi, 2)} %"
            )
            assert told.announced == (), (seed, name)
            assert told.judged > 0.9, (seed, name)


@pytest.mark.slow
@pytest.mark.parametrize("shape", SHAPES)
def test_after_48_hours_at_many_levels_a_loss_in_a_storm_is_found_and_read_right(shape: str) -> None:
    for seed in SEEDS:
        intact, lost = trial_b(shape, seed).values()
        print(f"{shape}, seed {seed}: {np.round(100 * intact.ddi, 2)} %, lost {np.round(100 * lost.ddi, 2)} %")
        assert intact.announced == (), seed
        assert lost.announced == (2,), seed
        assert min(intact.judged, lost.judged) >= 0.8, seed
        assert np.abs(lost.ddi - [0.0, 0.05, 0.0]).max() < 0.01, seed
