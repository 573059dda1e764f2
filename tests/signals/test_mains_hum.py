"""Hum of the mains is told from a machine that drives a floor at the same frequency."""

from __future__ import annotations

import numpy as np
import pytest

from monitor.model import EFFECTS, Model, ShearFrame
from monitor.signals.mains_hum import Hum, find_hum
from tests.support.simulated import PAPER_FRAME, ambient, segments_of

RATE, N = 200.0, 4000


def motion(*effects: object, seed: int = 1) -> np.ndarray:
    model = Model(PAPER_FRAME, effects)  # type: ignore[arg-type]
    return ambient(model, 400.0, RATE, seed, noise=0.05, level_spread=0.35)


@pytest.fixture(scope="module")
def floors() -> np.ndarray:
    return motion()


def found(x: np.ndarray) -> tuple[Hum, ...]:
    return find_hum(*segments_of(x, RATE, N, 721), RATE)


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
    light = ShearFrame(PAPER_FRAME.masses_kg, PAPER_FRAME.stiffness_n_per_m, 0.001)
    third = Model(light).modes().frequencies_hz[2]
    tuned = ShearFrame(PAPER_FRAME.masses_kg, PAPER_FRAME.stiffness_n_per_m * (20.0 / third) ** 2, 0.001)
    assert found(ambient(Model(tuned), 400.0, RATE, 2, noise=0.05)) == ()


def test_a_single_channel_shows_no_proportions(floors: np.ndarray) -> None:
    assert found((floors[:, 1] + tone(floors, 180.0, 0.5))[:, None]) == ()
