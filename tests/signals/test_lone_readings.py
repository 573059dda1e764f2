"""A lone reading that no structure gives is a missing one; no sample of a quake, a hammer or coarse units is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from drivers.base import ACCELERATION
from drivers.mcap_file import read_recordings
from monitor.model import simulate
from monitor.signals import alignment
from tests.support.frames import settings_of
from tests.support.samples import Cut

CHANNELS = ("a1", "a2", "a3")
RECORDED = sorted(Path(__file__).parents[2].glob("recordings/*.mcap"))


def lost(cut: Cut, samples: np.ndarray, rate_hz: float, size: int = 100) -> np.ndarray:
    """Which samples the stream takes for missing."""
    state, out = alignment.start(), []
    for block in cut(samples, rate_hz, [size]):
        state, pieces = alignment.step(state, block, CHANNELS, keep_partial=True)
        out += [np.zeros(piece.values.shape, dtype=bool) if piece.lost is None else piece.lost for piece in pieces]
    return np.concatenate(out)


@pytest.fixture
def motion() -> np.ndarray:
    return 0.05 * np.random.default_rng(4).standard_normal((5000, 3))


@pytest.mark.parametrize("value", [1e4, -1e6, 1e8, 2e9])
def test_lone_readings_are_missing_wherever_blocks_are_cut(cut: Cut, motion: np.ndarray, value: float) -> None:
    places = [100, 255, 256, 1000, 4999]  # the second of two in a row is taken as it is
    motion[places[:2], 1] = value
    found = lost(cut, motion, 1000.0, 256)
    assert np.argwhere(found).tolist() == [[100, 1], [255, 1]]
    motion[places, 1] = value
    whole = lost(cut, motion, 1000.0, 5000)
    assert np.argwhere(whole).tolist() == [[100, 1], [255, 1]]
    for size in (1, 255, 256, 257):
        assert (lost(cut, motion, 1000.0, size) == whole).all()


def test_a_bit_that_falls_over_at_every_other_sample_delays_nothing(cut: Cut) -> None:
    """As many lone readings as a block may hold take as long as to read it, not the square of that."""
    motion = 0.05 * np.random.default_rng(4).standard_normal((200_000, 3))
    motion[1::2, 1] = 1e6
    found = lost(cut, motion, 1000.0, len(motion))
    assert found[1::2, 1].all() and found.sum() == len(motion) // 2


def test_what_all_channels_show_at_once_is_no_slip_of_one(cut: Cut, motion: np.ndarray) -> None:
    motion[700] = 1e5
    assert not lost(cut, motion, 1000.0).any()


def test_a_channel_in_other_units_is_taken_as_it_is(cut: Cut, motion: np.ndarray) -> None:
    """Counts of a converter in the place of m/s^2, and an offset of gravity at one sample a second."""
    assert not lost(cut, motion * [1.0, 1e7, 1.0], 1000.0).any()
    assert not lost(cut, motion + np.array([0.0, 9.81, 0.0]), 1.0).any()


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_no_sample_of_hammer_blows_is_missing(cut: Cut, frame_text: str, noise: float) -> None:
    """1 N s within one sample on a floor of 0.35 kg, each 10 s, from a frame at rest on."""
    model = settings_of(frame_text).model()
    blows = simulate(model, duration_s=40.0, rate_hz=1000.0, excitation="impulse", noise=noise, seed=3).floors
    quiet = 1e-4 * np.random.default_rng(0).standard_normal((2000, 3))
    assert not lost(cut, np.concatenate([quiet, blows]), 1000.0).any()


@pytest.mark.parametrize("path", RECORDED, ids=lambda path: path.stem)
def test_no_sample_of_a_recording_is_missing(path: Path) -> None:
    state = alignment.start()
    for block in read_recordings([path]):
        if block.topic == ACCELERATION:
            state, pieces = alignment.step(state, block, block.channels, keep_partial=True)
            assert all(piece.lost is None for piece in pieces)
