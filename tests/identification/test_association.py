"""Modes are known by their likelihood: beside clutter, another mode is not taken for the one that is missing."""

from __future__ import annotations

import numpy as np
import pytest

from monitor.identification import KnownModes
from monitor.identification.association import associated
from monitor.model import Modes

HZ = np.array([2.0, 5.5, 9.0])
REACH, LEAST = float(np.log(1.5)), (0.01, 0.05, 0.5)


def known(clutter: float = 0.01, absent: float = 0.05, std: float = 0.005) -> KnownModes:
    shapes = np.eye(3)
    return KnownModes(
        Modes((2.0 * np.pi * HZ) ** 2, shapes), np.full(3, std), np.full(3, 0.01), np.full(3, absent), clutter, 0.05
    )


def match(
    seen_hz: list[float], learned: KnownModes, mac: np.ndarray | None = None, channels: int = 1
) -> dict[int, int]:
    distance = np.abs(np.log(HZ)[:, None] - np.log(seen_hz))
    return associated(distance, np.ones_like(distance) if mac is None else mac, learned, channels, REACH, LEAST)


def test_modes_at_their_places_are_known_and_one_that_moved_is_where_nothing_else_comes_and_goes() -> None:
    assert match([2.01, 5.49, 9.02], known()) == {0: 0, 1: 1, 2: 2}
    assert match([2.0, 5.5, 8.0], known()) == {0: 0, 1: 1, 2: 2}


def test_with_one_channel_another_mode_is_not_taken_for_one_that_is_often_missing() -> None:
    """By a factor of 1.5 alone, with all shapes alike, the mode at 7.3 Hz would be the third one, fallen by a fifth."""
    assert match([2.0, 5.5, 7.3], known(clutter=1.0, absent=0.3)) == {0: 0, 1: 1}
    assert match([2.0, 5.5, 8.95], known(clutter=1.0, absent=0.3)) == {0: 0, 1: 1, 2: 2}, "within the healthy scatter"


def test_a_mode_between_two_that_are_missing_is_neither() -> None:
    assert match([2.0, 7.0], known()) == {0: 0}


def test_records_that_scatter_widely_keep_their_modes() -> None:
    assert match([2.2, 4.9, 9.6], known(clutter=0.2, absent=0.1, std=0.08)) == {0: 0, 1: 1, 2: 2}


@pytest.mark.parametrize(("mac", "is_known"), [(0.99, True), (0.55, False)])
def test_with_several_channels_the_shape_decides_beside_clutter(mac: float, is_known: bool) -> None:
    likeness = np.full((3, 1), 0.0)
    likeness[2] = mac
    assert match([7.6], known(clutter=0.2, absent=0.1), likeness, channels=4) == ({2: 0} if is_known else {})
