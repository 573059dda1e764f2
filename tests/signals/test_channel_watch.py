"""Which channels a window is judged with: faults are found, well channels stay in use, a loose cable is not told every window."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import cheby1, sosfilt

from monitor.model import Model, ShearFrame
from monitor.signals import channel_watch
from monitor.signals.channel_watch import WatchState
from monitor.signals.sensor_health import HealthSettings
from tests.support.simulated import PAPER_FRAME, ambient, whole_window

RATE, WINDOW_S, HOP_S = 100.0, 100.0, 10
NAMES = ("a1", "a2", "a3")


def motion(seed: int, loss: float = 0.0, noise: float = 0.1) -> np.ndarray:
    return ambient(Model(PAPER_FRAME), WINDOW_S, RATE, seed, loss=(0.0, loss, 0.0), noise=noise)


def faults(samples: np.ndarray, block_s: float = HOP_S) -> dict[int, str]:
    names = tuple(f"a{k + 1}" for k in range(samples.shape[1]))
    item = whole_window(samples, RATE, round(block_s * RATE), 50)
    return channel_watch.find_faults(item, {}, names, HealthSettings())


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("which", [0, 1, 2])
def test_a_channel_that_dies_drifts_or_gives_noise_is_found_alone(which: int, seed: int) -> None:
    rng, x = np.random.default_rng(seed), motion(seed)
    size = x[:, which].std()
    for bad in (
        np.zeros(len(x)),
        rng.normal(scale=0.3 * size, size=len(x)),
        rng.normal(scale=3.0 * size, size=len(x)),
        x[:, which] + np.cumsum(rng.normal(scale=size, size=len(x))),
        np.where(np.arange(len(x)) < 0.6 * len(x), x[:, which], x[round(0.6 * len(x)), which]),
    ):
        spoilt = x.copy()
        spoilt[:, which] = bad
        assert set(faults(spoilt)) == {which}


@pytest.mark.parametrize("seed", range(4))
def test_well_channels_stay_in_use_whatever_the_structure_does(seed: int) -> None:
    x, hurt = motion(seed), motion(seed + 100, loss=0.2)
    half = len(x) // 2
    level = np.repeat(np.array([1.0, 5.0, 0.2, 3.0, 1.0]), len(x) // 5)[:, None]
    gain, polarity = np.array([1.0, 0.7, 1.0]), np.array([1.0, 1.0, -1.0])
    for well in (
        x,
        np.concatenate([x[:half], hurt[half:]]),
        x * level,
        x * gain,
        x * polarity,
        motion(seed, noise=0.5),
    ):
        assert faults(well) == {}


def test_well_channels_of_a_slow_frame_stay_in_use_in_short_blocks() -> None:
    """A frame of 2.2 to 10 Hz without a sensor on one floor: what reaches over the ends of a block is no fault of a channel."""
    masses, stiffness = np.array([900.0, 1000.0, 1000.0, 1100.0]), np.array([1.2e6, 1.3e6, 1.5e6, 1.8e6])
    frame = Model(ShearFrame(masses, stiffness, 0.012))
    lowpass = cheby1(8, 0.05, 40.0, fs=RATE, output="sos")
    for seed in range(3):
        x = ambient(frame, 800.0, RATE, seed, noise=4e-3)[:, [0, 1, 3]]
        x = sosfilt(lowpass, x, axis=0)
        assert [faults(x[i : i + 20000], block_s=5.0) for i in range(0, 60000, 4000)] == [{}] * 15


def test_channels_without_a_common_motion_are_not_taken_for_faults() -> None:
    """Noise alone, or one floor moved by a machine: no channel confirms another, and the window's own check decides."""
    noise = np.random.default_rng(1).normal(size=(round(WINDOW_S * RATE), 3))
    assert faults(noise) == {}
    assert faults(noise[:, :1]) == {}


def follow(times: list[tuple[int, bool]], window_s: float = WINDOW_S) -> list[bool]:
    """Whether a2 is in use in each window, of its end in s and whether a2 is well in it."""
    state, used = WatchState(), []
    for t_s, is_well in times:
        found = {} if is_well else {1: "lost samples"}
        state, in_use, left_out = channel_watch.step(state, found, NAMES, t_s * 10**9, window_s)
        assert [gone.channel for gone in left_out] == ([] if 1 in in_use else ["a2"])
        used.append(1 in in_use)
    return used


def test_a_channel_comes_back_with_the_first_window_in_which_it_is_well() -> None:
    assert follow([(0, True), (10, False), (20, False), (30, True)]) == [True, False, False, True]


def test_a_loose_cable_is_told_a_few_times_a_day() -> None:
    """A channel that fails for a minute in each ten: without damping it would come and go 144 times a day."""
    times = [(t, t % 600 < 600 - 60 - WINDOW_S) for t in range(0, 86_400, HOP_S)]
    used = follow(times)
    assert 2 <= np.count_nonzero(np.diff(used)) <= 8
    assert not used[-1]


def test_after_a_quiet_day_a_relapse_counts_as_the_first() -> None:
    day = 86_400
    loose = [(t, t % 600 < 300) for t in range(0, 7200, HOP_S)]
    later = [(3 * day, True), (3 * day + 10, False), (3 * day + 20, True)]
    assert follow([*loose, *((t, True) for t in range(7200, 2 * day, 600)), *later])[-3:] == [True, False, True]


def test_the_reason_is_that_of_the_latest_window_and_the_time_that_of_the_first() -> None:
    state, _, _ = channel_watch.step(WatchState(), {0: "lost samples"}, NAMES, 100, WINDOW_S)
    _, in_use, (gone,) = channel_watch.step(state, {0: "does not move"}, NAMES, 200, WINDOW_S)
    assert in_use == (1, 2)
    assert (gone.channel, gone.reason, gone.since_ns) == ("a1", "does not move", 100)
