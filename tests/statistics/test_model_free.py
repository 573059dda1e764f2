"""Missed and false modes of the automatic choice without a model, and the coverage of its intervals, over many frames."""

from __future__ import annotations

import numpy as np
import pytest

from monitor.core import Skipped
from monitor.identification import fit_single_modes
from tests.identification.test_model_free import identified, response, shear_frame

pytestmark = pytest.mark.slow
DAMPING, FRAMES, NEAR = 0.01, 8, 0.02


@pytest.mark.parametrize("seconds", [120.0, 600.0, 3600.0])
def test_few_modes_are_missed_and_few_are_false(seconds: float, capsys: pytest.CaptureFixture[str]) -> None:
    total = missed = false = differing = 0
    scores: list[tuple[float, float]] = []
    second_scores: list[tuple[float, float]] = []
    for floors in range(3, 9):
        for seed in range(FRAMES):
            rng = np.random.default_rng([floors, seed])
            hz, shapes = shear_frame(floors, rng)
            window, modes = identified(response(hz, shapes, DAMPING, seconds, rng))
            total += floors
            if isinstance(modes, Skipped):
                missed += floors
                continue
            nearest = np.abs(modes.frequencies_hz[:, None] / hz - 1.0).argmin(axis=1)
            true = np.abs(modes.frequencies_hz / hz[nearest] - 1.0) < NEAR
            missed += floors - len(set(nearest[true].tolist()))
            false += len(nearest) - len(set(nearest[true].tolist()))
            z_f = (modes.frequencies_hz - hz[nearest]) / modes.frequencies_std_hz
            z_d = (modes.damping_ratio - DAMPING) / modes.damping_std
            scores += zip(z_f[true], z_d[true], strict=True)
            seconds_opinions = fit_single_modes(window.segments, window.segment_bin_hz, modes)
            for k, one in enumerate(seconds_opinions):
                if true[k] and not isinstance(one, Skipped):
                    f, d = one.frequency_hz - hz[nearest[k]], one.damping_ratio - DAMPING
                    second_scores.append((f / one.frequency_std_hz, d / one.damping_std))
                    apart = one.frequency_hz - modes.frequencies_hz[k]
                    differing += abs(apart) > 3.0 * np.hypot(one.frequency_std_hz, modes.frequencies_std_hz[k])
    within = (np.abs(scores) < 1.96).mean(axis=0)
    within_second = (np.abs(second_scores) < 1.96).mean(axis=0)
    with capsys.disabled():
        print(
            f"\n{seconds:g} s: {total} modes, {missed} missed, {false} false; in their 95 % interval: "
            f"frequency {100 * within[0]:.0f} %, damping {100 * within[1]:.0f} %; second opinion of {len(second_scores)}: "
            f"{100 * within_second[0]:.0f} and {100 * within_second[1]:.0f} %, {differing} differ by three standard deviations"
        )
    assert missed <= 0.02 * total
    assert false <= 0.02 * total
    assert (within > 0.8).all()
