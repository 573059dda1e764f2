"""What coherence and phase tell: drifting clocks, delays and copies; and a missing lowpass."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import cheby1, chirp, lfilter, sosfilt

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
    return channel_relations.find_delays(*transforms(samples), RATE_HZ, SECONDS)


def shifted(samples: np.ndarray, late_s: np.ndarray | float) -> np.ndarray:
    t = np.arange(len(samples)) / RATE_HZ
    out = samples.copy()
    out[:, 1] = np.interp(t - late_s, t, samples[:, 1])
    return out


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
    n = len(t) // 30
    found, step_hz = segments_of(samples, RATE_HZ, n, n // 2 + 1)
    assert channel_relations.find_delays(found, step_hz, RATE_HZ, 300.0) == ()


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
