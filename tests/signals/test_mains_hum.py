"""Hum of the mains is told from a machine that drives a floor at the same frequency."""

from __future__ import annotations

import numpy as np
import pytest

from monitor.model import EFFECTS, Model, ShearFrame, simulate
from monitor.signals.mains_hum import Hum, find_hum
from monitor.signals.welch import SegmentDesign, transform

RATE, N = 200.0, 4000
FRAME = ShearFrame(np.array([0.3253, 0.3514, 0.3129]), np.array([2909.4511, 1514.8507, 1897.6986]), 0.01)


def motion(*effects: object, seed: int = 1) -> np.ndarray:
    model = Model(FRAME, effects)  # type: ignore[arg-type]
    return np.asarray(simulate(model, duration_s=400.0, rate_hz=RATE, noise=0.05, level_spread=0.35, seed=seed).floors)


@pytest.fixture(scope="module")
def floors() -> np.ndarray:
    return motion()


def found(x: np.ndarray) -> tuple[Hum, ...]:
    design = SegmentDesign(RATE, N, 721)
    segments = np.stack([transform(design, x[a : a + N]) for a in range(0, len(x) - N + 1, N // 2)])
    return find_hum(segments, design.step_hz, RATE)


def tone(x: np.ndarray, hz: float, share: float) -> np.ndarray:
    return share * float(x.std()) * np.sin(2.0 * np.pi * hz * np.arange(len(x)) / RATE + 1.0)


@pytest.mark.parametrize("channel", [0, 1, 2])
@pytest.mark.parametrize("share", [0.1, 0.3])
def test_the_alias_of_a_harmonic_in_one_channel_is_hum(floors: np.ndarray, channel: int, share: float) -> None:
    x = floors.copy()
    x[:, channel] += tone(x, 3.0 * 60.03, share)
    (hum,) = found(x)
    assert (hum.channel, hum.mains_hz, hum.harmonic, hum.is_aliased) == (channel, 60.0, 3, True)
    assert hum.hz == pytest.approx(19.91, abs=0.03)
    assert hum.low_hz < 19.85 and hum.high_hz > 19.97


def test_hum_of_all_channels_alike_is_hum(floors: np.ndarray) -> None:
    (hum,) = found(floors + tone(floors, 180.1, 0.3)[:, None])
    assert hum.channel is None and hum.hz == pytest.approx(19.9, abs=0.03)


@pytest.mark.parametrize("floor", [1, 2, 3])
@pytest.mark.parametrize("force_n", [0.1, 1.0])
def test_a_machine_at_the_same_frequency_is_left_to_the_diagnosis(floor: int, force_n: float) -> None:
    machine = EFFECTS["harmonic_excitation"].create(f"floor {floor}", {"frequency_hz": 20.0, "force_n": force_n})
    assert found(motion(machine)) == ()


def test_a_tone_off_the_mains_is_left_to_the_diagnosis(floors: np.ndarray) -> None:
    x = floors.copy()
    x[:, 1] += tone(x, 21.3, 0.3)
    assert found(x) == ()


@pytest.mark.parametrize("seed", range(4))
def test_nothing_is_found_in_sound_records(seed: int) -> None:
    assert found(motion(seed=seed)) == ()


def test_a_mode_at_the_mains_alias_is_no_hum() -> None:
    """A lightly damped mode at 20 Hz: narrow, but its power is exponentially distributed."""
    light = ShearFrame(FRAME.masses_kg, FRAME.stiffness_n_per_m, 0.001)
    third = Model(light).modes().frequencies_hz[2]
    tuned = ShearFrame(FRAME.masses_kg, FRAME.stiffness_n_per_m * (20.0 / third) ** 2, 0.001)
    assert found(np.asarray(simulate(Model(tuned), duration_s=400.0, rate_hz=RATE, noise=0.05, seed=2).floors)) == ()


def test_a_single_channel_shows_no_proportions(floors: np.ndarray) -> None:
    assert found((floors[:, 1] + tone(floors, 180.0, 0.5))[:, None]) == ()
