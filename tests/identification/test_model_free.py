"""The automatic choice without a model: all modes of a simulated frame and no other, with intervals that hold the truth."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.signal import lfilter

from monitor.core import ModalEstimate, Skipped, Window
from monitor.identification import (
    RefinementSettings,
    SelectionSettings,
    SsiSettings,
    fit_single_modes,
    identify_modes,
)
from monitor.signals import WindowGrid, windows

RATE_HZ = 100.0
Array = NDArray[np.float64]


def shear_frame(floors: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Frequencies and shapes of a frame whose masses and stiffnesses scatter; the lowest frequency is 2 Hz."""
    k, m = rng.uniform(0.7, 1.3, floors), rng.uniform(0.8, 1.2, floors)
    drifts = np.eye(floors) - np.eye(floors, k=1)
    squares, shapes = eigh(drifts.T @ np.diag(k) @ drifts, np.diag(m))
    return 2.0 * np.sqrt(squares / squares[0]), shapes


def response(
    hz: Array, shapes: Array, damping: float, seconds: float, rng: np.random.Generator, noise: float = 0.1
) -> Array:
    """Acceleration by white forces on every floor, each mode an exactly sampled resonator of a discrete model, and noise."""
    n = int(seconds * RATE_HZ)
    poles = np.exp(2.0 * np.pi / RATE_HZ * hz * (-damping + 1j * np.sqrt(1.0 - damping**2)))
    forces = rng.standard_normal((n, len(shapes))) @ shapes
    modal = [
        lfilter([1.0, -2.0, 1.0], [1.0, -2.0 * p.real, abs(p) ** 2], f) for p, f in zip(poles, forces.T, strict=True)
    ]
    clean = np.transpose(modal) @ shapes.T
    return np.asarray(clean + noise * clean.std(axis=0) * rng.standard_normal(clean.shape))


def window_of(samples: Array) -> Window:
    """One window of all samples, its segments up to half the rate."""
    grid = WindowGrid(RATE_HZ, len(samples), 1000, 2 * SsiSettings().block_rows, 20.0, 45.0)
    (window,) = windows.step(grid, windows.start(grid, samples.shape[1], index=0), samples, 0)[1]
    assert isinstance(window, Window)
    return window


def identified(samples: Array) -> tuple[Window, ModalEstimate | Skipped]:
    window = window_of(samples)
    return window, identify_modes(window, SsiSettings(), SelectionSettings(), RefinementSettings())


@pytest.mark.parametrize("floors", [3, 5, 8])
def test_all_modes_and_no_other_are_found_within_their_intervals(floors: int) -> None:
    rng = np.random.default_rng(floors)
    hz, shapes = shear_frame(floors, rng)
    window, modes = identified(response(hz, shapes, 0.01, 600.0, rng))
    assert isinstance(modes, ModalEstimate)
    assert len(modes.frequencies_hz) == floors
    assert (np.abs(modes.frequencies_hz - hz) < 4.0 * modes.frequencies_std_hz).all()
    assert (np.abs(modes.damping_ratio - 0.01) < 4.0 * modes.damping_std).all()
    assert (modes.frequencies_std_hz < 0.01 * hz).all()
    for found, true in zip(modes.shapes, shapes.T, strict=True):
        assert abs(np.vdot(found, true)) ** 2 / (np.vdot(found, found).real * (true @ true)) > 0.99
    for own, second in zip(
        modes.frequencies_hz, fit_single_modes(window.segments, window.segment_bin_hz, modes), strict=True
    ):
        assert isinstance(second, Skipped) or abs(second.frequency_hz - own) < 4.0 * second.frequency_std_hz


@pytest.mark.parametrize("channels", [1, 3])
def test_noise_has_no_modes(channels: int) -> None:
    rng = np.random.default_rng(channels)
    coloured = lfilter([1.0], [1.0, -0.9], rng.standard_normal((60_000, channels)), axis=0)
    assert isinstance(identified(np.asarray(coloured))[1], Skipped)


def test_the_second_opinion_does_not_rest_on_the_first() -> None:
    rng = np.random.default_rng(0)
    hz, shapes = shear_frame(3, rng)
    window, modes = identified(response(hz, shapes, 0.01, 600.0, rng))
    assert isinstance(modes, ModalEstimate)
    shifted = ModalEstimate(
        modes.frequencies_hz * 1.005,
        modes.damping_ratio * 2.0,
        modes.shapes,
        modes.model_mode,
        modes.deviations,
        modes.first,
        modes.order,
        modes.poles,
    )
    right = fit_single_modes(window.segments, window.segment_bin_hz, modes)
    wrong = fit_single_modes(window.segments, window.segment_bin_hz, shifted)
    for a, b in zip(right, wrong, strict=True):
        assert not isinstance(a, Skipped)
        assert not isinstance(b, Skipped)
        assert abs(a.frequency_hz - b.frequency_hz) < a.frequency_std_hz
