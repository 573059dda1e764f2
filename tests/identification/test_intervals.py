"""A mode without an interval is not stated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from monitor.core import ModalEstimate, Skipped, Window
from monitor.identification import RefinementSettings, SelectionSettings, SsiSettings, identify, identify_modes
from monitor.identification.short_records import stated_refined
from monitor.model import simulate
from monitor.signals import WindowGrid, windows
from tests.support.turning_frame import TRUTH

RATE_HZ, SAMPLES = 100.0, 1000


def window(blocks: int) -> Window:
    """A window of 10 s, cut into blocks, too short to be refined; only lags longer than half of it leave one block."""
    x = simulate(TRUTH, duration_s=SAMPLES / RATE_HZ, rate_hz=RATE_HZ, noise=0.03, seed=1).floors
    grid = WindowGrid(RATE_HZ, SAMPLES, SAMPLES // blocks, 50 if blocks > 1 else 501, 10.0, 40.0)
    _, made = windows.step(grid, windows.start(grid, 3, index=0), x, 0)
    return next(one for one in made if isinstance(one, Window))


def test_a_single_block_shows_no_scatter_so_that_no_mode_is_stated() -> None:
    model = TRUTH
    for blocks, states in ((1, False), (10, True)):
        free = identify_modes(window(blocks), SsiSettings(), SelectionSettings(), RefinementSettings())
        by_model = identify(window(blocks), (0, 1, 2), model.modes(), np.eye(3), SsiSettings(), SelectionSettings())
        for found in (free, by_model):
            assert isinstance(found, Skipped) is not states
            if isinstance(found, Skipped):
                assert "no interval" in found.reason
            else:
                assert (found.frequencies_std_hz > 0.0).all()


def test_a_scatter_that_is_hardly_known_widens_an_interval_no_more_than_one_degree_of_freedom() -> None:
    """Of a twentieth of one Student's 95 % interval is beyond all numbers."""
    modes = identify_modes(window(10), SsiSettings(), SelectionSettings(), RefinementSettings())
    assert isinstance(modes, ModalEstimate)
    unknown = replace(modes, deviations=modes.deviations * (10.0 * modes.damping_ratio / modes.damping_std).max())
    stds = stated_refined(unknown).frequencies_std_hz / unknown.frequencies_std_hz
    assert (stds < 12.71 / 1.96 * 1.5).all()
