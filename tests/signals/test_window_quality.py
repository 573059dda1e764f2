"""What keeps a channel or a window out: nothing moves, or nothing but noise."""

from __future__ import annotations

import numpy as np
import pytest

from monitor.core import Skipped
from monitor.model import Model
from monitor.signals import window_quality
from monitor.signals.window_quality import QualitySettings
from tests.support.simulated import PAPER_FRAME, ambient, whole_window


def check(samples: np.ndarray, settings: QualitySettings | None = None, lags: int = 20) -> Skipped | None:
    item = whole_window(samples, 100.0, 500, lags)
    return window_quality.check(item.sums, 100.0, 40.0, settings or QualitySettings())


def still(samples: np.ndarray) -> tuple[int, ...]:
    return window_quality.still_channels(whole_window(samples, 100.0, 500, 20).sums)


@pytest.fixture(scope="module")
def frame() -> np.ndarray:
    return ambient(Model(PAPER_FRAME), 20.0, 100.0, 1, noise=0.05)


@pytest.fixture(scope="module")
def noise() -> np.ndarray:
    return np.random.default_rng(2).normal(size=(2000, 3))


@pytest.mark.parametrize("lags", [20, 50])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e4])
def test_white_noise_alone_is_skipped_at_any_level(noise: np.ndarray, scale: float, lags: int) -> None:
    verdict = check(scale * noise, lags=lags)
    assert verdict is not None and "noise" in verdict.reason


def test_white_noise_is_skipped_though_one_channel_is_louder_or_leans(noise: np.ndarray) -> None:
    assert check(noise * [1.0, 1000.0, 0.01] + [0.0, 9.81, 0.0]) is not None


@pytest.mark.parametrize("lags", [20, 50])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e4])
def test_a_vibrating_frame_passes_at_any_level(frame: np.ndarray, scale: float, lags: int) -> None:
    assert check(scale * frame, lags=lags) is None


def test_a_frame_under_as_much_noise_as_motion_passes(frame: np.ndarray, noise: np.ndarray) -> None:
    assert check(frame + 0.5 * frame.std() * noise) is None


@pytest.mark.parametrize("value", [0.0, 9.81])
def test_a_dead_channel_is_found_alone(frame: np.ndarray, value: float) -> None:
    dead = frame.copy()
    dead[:, 1] = value
    assert still(dead) == (1,)
    assert still(frame) == ()


def test_in_silence_every_channel_is_still() -> None:
    assert still(np.zeros((2000, 3))) == (0, 1, 2)


def test_the_limit_is_the_settings(frame: np.ndarray, noise: np.ndarray) -> None:
    assert check(noise, QualitySettings(max_spectral_flatness=1.0)) is None
    assert check(frame, QualitySettings(max_spectral_flatness=0.01)) is not None
