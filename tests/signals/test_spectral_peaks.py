"""Peaks of spectra: those of modes, and none of noise or of a slope."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from monitor.signals import find_peaks
from tests.support.simulated import segments_of

RATE_HZ, N = 100.0, 1000


def peaks_hz(samples: np.ndarray) -> list[float]:
    transforms, step_hz = segments_of(samples, RATE_HZ, N, N // 2 + 1)
    return [k * step_hz for k in find_peaks(transforms.astype(complex))]


def test_each_mode_is_one_peak_in_whichever_channel_it_shows() -> None:
    rng = np.random.default_rng(0)
    modes = [lfilter([1.0], [1.0, -2.0 * 0.995 * np.cos(2.0 * np.pi * hz / RATE_HZ), 0.995**2], rng.standard_normal(12_000))
             for hz in (5.0, 17.0)]  # fmt: skip
    samples = np.transpose(modes) + 0.1 * rng.standard_normal((12_000, 2))
    assert peaks_hz(samples) == pytest.approx([5.0, 17.0], abs=0.2)
    assert peaks_hz(samples.sum(axis=1, keepdims=True)) == pytest.approx([5.0, 17.0], abs=0.2)


@pytest.mark.parametrize("seconds", [35.0, 120.0, 1200.0])
def test_noise_has_no_peak(seconds: float) -> None:
    rng = np.random.default_rng(1)
    noise = rng.standard_normal((int(seconds * RATE_HZ), 3))
    assert peaks_hz(noise) == []
    assert peaks_hz(np.asarray(lfilter([1.0], [1.0, -0.9], noise, axis=0))) == []
