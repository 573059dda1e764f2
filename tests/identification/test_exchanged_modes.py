"""Modes that lie at one another's places, as where two sensors are left that see both modes alike, are never exchanged."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from scipy.signal import lfilter

from monitor.core import Array, ModalEstimate
from monitor.identification import SelectionSettings, SsiSettings, identify
from monitor.model import Modes
from tests.support.simulated import whole_window

RATE = 100.0


def motion(places_hz: list[float], shapes: Array, seconds: float = 300.0) -> Array:
    """Accelerations of modes under white noise, shape (n, c); `shapes` has a row for each mode."""
    draw, out = np.random.default_rng(3), 0.0
    for f, shape in zip(places_hz, shapes, strict=True):
        pole = np.exp((-0.01 + 1j * np.sqrt(1.0 - 0.01**2)) * 2.0 * np.pi * f / RATE)
        q = lfilter([1.0, -1.0], [1.0, -2.0 * pole.real, abs(pole) ** 2], draw.normal(size=round(seconds * RATE)))
        out = out + np.outer(q / q.std(), shape)
    return np.asarray(out)


def found(samples: Array, reference_hz: list[float], shapes: Array, *, measured: bool) -> ModalEstimate:
    reference = Modes((2.0 * np.pi * np.array(reference_hz)) ** 2, shapes.T)
    window = whole_window(samples, RATE, 1000, 40)
    past, ssi, select = tuple(range(samples.shape[1])), SsiSettings(block_rows=20), SelectionSettings()
    wanted = tuple(range(len(reference_hz)))
    modes = identify(window, past, reference, np.eye(len(past)), ssi, select, wanted, 40.0, measured=measured)
    assert isinstance(modes, ModalEstimate)
    return modes


@pytest.mark.parametrize(
    ("healthy_hz", "healthy"),
    [
        ([2.3, 8.99, 12.47], [[1.0, 1.0], [1.0, 0.5], [0.5, 1.0]]),
        ([8.0, 9.5, 11.3], [[1.0, 0.5, 0.2], [0.2, 1.0, 0.5], [0.5, 0.2, 1.0]]),
    ],
    ids=["a pair", "a ring of three"],
)
def test_modes_whose_shapes_look_like_one_anothers_stay_at_their_places(
    healthy_hz: list[float], healthy: list[list[float]]
) -> None:
    shapes = np.array(healthy)
    moved = np.array([shapes[0], shapes[2], shapes[1]]) if len(healthy[0]) == 2 else np.roll(shapes, -1, axis=0)
    samples = motion(healthy_hz, moved)
    exchanged = found(samples, healthy_hz, shapes, measured=False)
    order = np.argsort(exchanged.model_mode)
    assert (np.diff(exchanged.frequencies_hz[order]) < 0.0).any(), (
        "by their shapes alone they are taken for one another"
    )
    kept = found(samples, healthy_hz, shapes, measured=True)
    for k, frequency_hz in zip(kept.model_mode, kept.frequencies_hz, strict=True):
        assert frequency_hz == pytest.approx(healthy_hz[k], rel=0.02)
    told = {k for k, _ in kept.missing}
    assert told | set(kept.model_mode.tolist()) == {0, 1, 2}


def test_modes_that_changed_their_order_are_found_by_their_shapes() -> None:
    """Of two directions the stiffer one lost so much that its mode lies below the other's: no exchange of places."""
    shapes = np.eye(2)
    for places in permutations([5.0, 4.7]):
        modes = found(motion(list(places), shapes), [5.0, 5.2], shapes, measured=True)
        by_mode = dict(zip(modes.model_mode.tolist(), modes.frequencies_hz.tolist(), strict=True))
        assert by_mode == pytest.approx(dict(enumerate(places)), rel=0.01)


def test_a_mode_that_is_not_excited_leaves_no_place_for_another() -> None:
    shapes = np.array([[1.0, 1.0], [1.0, 0.5], [0.5, 1.0]])
    samples = motion([2.3, 12.47], shapes[[0, 1]])  # the third mode, of a shape like the second's
    taken = found(samples, [2.3, 8.99, 12.47], shapes, measured=False)
    assert taken.model_mode.tolist() == [0, 1], "by its shape it is taken for the second"
    kept = found(samples, [2.3, 8.99, 12.47], shapes, measured=True)
    assert kept.model_mode.tolist() == [0, 2]


def test_a_close_pair_is_told_apart_by_shape_alone() -> None:
    shapes = np.eye(2)
    modes = found(motion([5.05, 5.0], shapes), [5.0, 5.05], shapes, measured=True)
    assert sorted(modes.model_mode.tolist()) == [0, 1]
