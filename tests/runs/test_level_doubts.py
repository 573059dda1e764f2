"""A change that is seen at a level which calibration never saw is doubted."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from monitor.model import parse_effect
from monitor.runs.diagnose import level_doubts

LOSS, GAIN = "stiffness_change:story 2:relative=-0.05", "sensor_gain:channel a1:gain=1.1"


def doubts(level_m_s2: float, *said: str, tied: bool = False) -> list[str]:
    """What is doubted of these causes (or alternatives) at a level in the band, with a calibration at 0.1 to 0.4 m/s^2."""
    segments: Any = SimpleNamespace(
        whole=SimpleNamespace(bin_hz=0.5), power=np.full((50, 2), level_m_s2**2 / 50.0), rms=np.full(4, level_m_s2)
    )
    baseline: Any = SimpleNamespace(level_range_m_s2=(0.1, 0.4))
    effects = [SimpleNamespace(effect=parse_effect(text)) for text in said]
    found: Any = SimpleNamespace(
        causes=[] if tied else effects, alternatives=[(effect, 0.5) for effect in effects] if tied else []
    )
    return level_doubts(segments, baseline, found)


@pytest.mark.parametrize("tied", [False, True])
def test_a_change_of_the_structure_at_a_higher_level_is_doubted(tied: bool) -> None:
    (doubt,) = doubts(1.0, LOSS, GAIN, tied=tied)
    assert doubt.startswith("the motion is 2.5 times as strong as the strongest at calibration: a stiffness")


def test_what_does_not_depend_on_the_level_is_not_doubted() -> None:
    assert doubts(0.3, LOSS) == doubts(1.0, GAIN) == doubts(1.0) == []


def test_a_level_that_only_another_unit_explains_is_asked_about_instead() -> None:
    (question,) = doubts(4.0, LOSS)
    assert "is the unit right" in question
