"""Drifts of stories without a sensor on every floor: by the model and the measured ground, as sure as the sensors show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivers.base import ACCELERATION, GROUND, SampleBlock
from monitor.config import Configuration
from monitor.events import Event, Site
from monitor.pipeline import Pipeline
from tests.events.shaken import blocks, configuration
from tests.support.quake import shaken, true_drifts


def told(config: Configuration, *, with_ground: bool = True) -> tuple[Event, Site]:
    pipeline, out, names = Pipeline(config), list[Event](), config.channels

    def seen(block: SampleBlock) -> SampleBlock:
        if block.topic != ACCELERATION:
            return block
        return replace(block, channels=names, samples=block.samples[:, [int(name[1]) - 1 for name in names]])

    for block in blocks(shaken(), n=1000):
        if with_ground or block.topic != GROUND:
            out += [r for r in pipeline.push(seen(block)) if isinstance(r, Event)]
    return out[-1], pipeline.site


@pytest.mark.parametrize("floors", [(1,), (1, 2), (1, 3), (2, 3)])
def test_with_the_right_model_the_drifts_are_those_of_the_simulation(floors: tuple[int, ...]) -> None:
    event, _ = told(configuration(floors))
    assert event.drift_m == pytest.approx(true_drifts(shaken(), event), rel=0.05)
    assert "the model and the ground tell those of" in event.note


@pytest.mark.parametrize("floors", [(1,), (1, 2), (1, 3), (2, 3)])
@pytest.mark.parametrize("scale", [(0.9, 0.9, 0.9), (0.8, 1.0, 1.2)])
def test_with_a_wrong_model_the_stated_deviation_says_so(floors: tuple[int, ...], scale: tuple[float, ...]) -> None:
    event, _ = told(configuration(floors, scale))
    error = np.abs(event.drift_m - true_drifts(shaken(), event))
    assert (error < 3.0 * event.drift_std_m).all() and (error > 0.03 * event.drift_m).sum() <= 3
    assert (event.drift_std_m / event.drift_m).max() > 0.05


def test_without_a_ground_they_are_null_and_it_is_said() -> None:
    event, _ = told(configuration((1, 3)), with_ground=False)
    assert np.isnan(event.drift_m).any() and "without a measured ground, some are not known" in event.note


def test_a_limit_within_a_drifts_interval_is_not_judged() -> None:
    unsure, wide = told(configuration((1,), (0.9, 0.9, 0.9)))
    limit = {"drift_ratio": 1.5 * float(unsure.drift_ratio.max()), "says": "go"}
    assert told(configuration((1,), (0.9, 0.9, 0.9), events={"limits": [limit]}))[0].verdict is None
    assert told(configuration((1,), (1.0, 1.0, 1.0), events={"limits": [limit]}))[0].verdict == "no limit exceeded"
    assert np.array_equal(Site.read(wide.content()).floor_shapes, wide.floor_shapes)
