"""The automatic choice without a model: all modes of a simulated frame and no other, with intervals that hold the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from monitor.core import ModalEstimate, Skipped
from monitor.identification import fit_single_modes
from tests.support.shear_response import identified, response, shear_frame


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
    shifted = replace(modes, frequencies_hz=modes.frequencies_hz * 1.005, damping_ratio=modes.damping_ratio * 2.0)
    right = fit_single_modes(window.segments, window.segment_bin_hz, modes)
    wrong = fit_single_modes(window.segments, window.segment_bin_hz, shifted)
    for a, b in zip(right, wrong, strict=True):
        assert not isinstance(a, Skipped)
        assert not isinstance(b, Skipped)
        assert abs(a.frequency_hz - b.frequency_hz) < a.frequency_std_hz


def test_a_mode_beyond_the_band_has_no_second_opinion() -> None:
    """A refined mode of much damping may lie there: its band reaches far into the transforms, its peak does not."""
    rng = np.random.default_rng(0)
    hz, shapes = shear_frame(3, rng)
    window, modes = identified(response(hz, shapes, 0.01, 120.0, rng))
    assert isinstance(modes, ModalEstimate)
    beyond = replace(modes, frequencies_hz=modes.frequencies_hz + 60.0, damping_ratio=modes.damping_ratio + 0.05)
    second = fit_single_modes(window.segments, window.segment_bin_hz, beyond)
    assert all(isinstance(one, Skipped) and "edge of the band" in one.reason for one in second)
