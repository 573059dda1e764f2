"""What coherence and phase tell: drifting clocks, delays and copies; and a missing lowpass."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.signal import cheby1, chirp, lfilter, sosfilt

from monitor.model import Model, ShearFrame, simulate
from monitor.signals import channel_relations
from tests.support.simulated import segments_of

RATE_HZ, SECONDS, N = 100.0, 1200.0, 2000


def motion(rng: np.random.Generator) -> np.ndarray:
    """Three channels of two modes, the second of opposite sign at the last channel, and noise."""
    poles = [(r * r, 2.0 * r * np.cos(2.0 * np.pi * hz / RATE_HZ)) for hz, r in ((4.0, 0.98), (11.0, 0.97))]
    modes = [lfilter([1.0], [1.0, -b, c], rng.standard_normal(int(SECONDS * RATE_HZ))) for c, b in poles]
    clean = np.transpose(modes) @ np.array([[1.0, 0.8, 0.5], [0.7, -0.4, -1.0]])
    return np.asarray(clean + 0.05 * rng.standard_normal(clean.shape))


def transforms(samples: np.ndarray) -> tuple[np.ndarray, float]:
    return segments_of(samples, RATE_HZ, N, N // 2 + 1)


def delays(samples: np.ndarray) -> tuple[channel_relations.Delay, ...]:
    n = len(samples) // 60 * 2
    found, step_hz = segments_of(samples, RATE_HZ, n, n // 2 + 1)
    return channel_relations.find_delays(found, step_hz, RATE_HZ, (np.arange(len(found)) + 1.0) * 0.5 / step_hz)


def shifted(samples: np.ndarray, late_s: np.ndarray | float) -> np.ndarray:
    t = np.arange(len(samples)) / RATE_HZ
    out = samples.copy()
    out[:, 1] = CubicSpline(t, samples[:, 1])(t - late_s)
    return out


def swept(seed: int, times: int) -> np.ndarray:
    """A frame of three stories that a shaker sweeps through, once or again and again, and noise."""
    rng = np.random.default_rng(seed)
    masses, stiffness = np.array([1.0, 1.1, 0.9]), 900.0 * rng.uniform(1.0, 3.0, 3)
    model = Model(ShearFrame(masses, stiffness, rng.choice([0.003, 0.01, 0.02])))
    motion = simulate(model, duration_s=300.0 / times, rate_hz=RATE_HZ, excitation="sweep", noise=0.01, seed=seed)
    return np.tile(motion.floors, (times, 1)) + 0.01 * motion.floors.std() * rng.standard_normal((30000, 3))


@pytest.mark.parametrize("seed", range(3))
def test_channels_on_one_clock_give_no_delay(seed: int) -> None:
    assert delays(motion(np.random.default_rng(seed))) == ()


@pytest.mark.parametrize(("first_hz", "last_hz"), [(1.0, 20.0), (15.0, 2.0)])
def test_a_shakers_sweep_gives_no_delay(first_hz: float, last_hz: float) -> None:
    """In each stretch of time it moves other frequencies, and what is left at the rest turns the phase as it likes."""
    t = np.arange(int(300.0 * RATE_HZ)) / RATE_HZ
    force = chirp(t, first_hz, t[-1], last_hz)
    poles = [(r * r, 2.0 * r * np.cos(2.0 * np.pi * hz / RATE_HZ)) for hz, r in ((4.0, 0.998), (11.0, 0.997))]
    modes = np.transpose([lfilter([1.0, -2.0, 1.0], [1.0, -b, c], force) for c, b in poles])
    clean = modes @ np.array([[1.0, 0.8, 0.5], [0.7, -0.4, -1.0]])
    samples = clean + 0.02 * clean.std() * np.random.default_rng(0).standard_normal(clean.shape)
    assert delays(samples) == ()


@pytest.mark.parametrize("times", [1, 4])
@pytest.mark.parametrize("seed", range(4))
def test_a_frame_under_sweeps_has_one_clock_whatever_its_shapes(seed: int, times: int) -> None:
    assert delays(swept(seed, times)) == ()
    assert delays(swept(seed, times) * [1.0, -1.0, 1.0]) == ()


def test_a_drifting_clock_is_told_of_sweeps_that_come_again_and_of_one_sweep_nothing_else() -> None:
    """What moves once in one range of frequencies only shows no change in time; a mean delay of a clock that drifts is none."""
    for seed in range(4):
        late_s = 100e-6 * np.arange(30000) / RATE_HZ
        found = delays(shifted(swept(seed, 4), late_s))
        assert found and all(1 in (one.channel, one.against) for one in found)
        assert [abs(one.drift) for one in found] == pytest.approx([100e-6] * len(found), rel=0.1)
        assert delays(shifted(swept(seed, 1), late_s)) == ()


def test_a_late_channel_is_told_under_a_sweep() -> None:
    found = [one for seed in range(4) for one in delays(shifted(swept(seed, 1), 0.004))]
    assert found
    for one in found:
        assert one.drift == 0.0
        assert (one.delay_s if one.channel == 1 else -one.delay_s) == pytest.approx(0.004, rel=0.5)


def test_a_drifting_clock_is_told_with_its_rate() -> None:
    samples = motion(np.random.default_rng(3))
    found = delays(shifted(samples, 30e-6 * np.arange(len(samples)) / RATE_HZ))
    assert found
    for one in found:
        assert 1 in (one.channel, one.against)
        assert abs(one.drift) == pytest.approx(30e-6, rel=0.2)


def test_a_late_channel_is_told_with_its_delay() -> None:
    found = delays(shifted(motion(np.random.default_rng(4)), 0.003))
    assert found
    for one in found:
        assert one.drift == 0.0
        assert (one.delay_s if one.channel == 1 else -one.delay_s) == pytest.approx(0.003, rel=0.5)


def test_a_copy_is_told_and_a_neighbour_is_not() -> None:
    samples = motion(np.random.default_rng(5))
    assert channel_relations.find_copies(transforms(samples)[0]) == ()
    samples[:, 2] = 2.0 * samples[:, 0]
    assert channel_relations.find_copies(transforms(samples)[0]) == ((0, 2),)


def test_a_lowpass_leaves_nothing_at_half_the_rate() -> None:
    samples = motion(np.random.default_rng(6))
    bare = channel_relations.folded_share((np.abs(transforms(samples)[0]) ** 2).mean(axis=0))
    filtered = sosfilt(cheby1(8, 0.05, 0.8, output="sos"), samples, axis=0)
    quiet = channel_relations.folded_share((np.abs(transforms(filtered)[0]) ** 2).mean(axis=0))
    assert (bare > 0.5).all()
    assert (quiet < 0.01).all()
