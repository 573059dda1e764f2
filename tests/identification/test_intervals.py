"""A mode without an interval is not stated."""

from __future__ import annotations

import numpy as np

from monitor.core import Skipped, Window
from monitor.identification import RefinementSettings, SelectionSettings, SsiSettings, identify, identify_modes
from monitor.model import simulate
from monitor.signals import WindowGrid, windows
from tests.support.turning_frame import TRUTH

RATE_HZ, SAMPLES = 100.0, 1000


def window(blocks: int) -> Window:
    """A window of 10 s, cut into blocks, too short to be refined."""
    x = simulate(TRUTH, duration_s=SAMPLES / RATE_HZ, rate_hz=RATE_HZ, noise=0.03, seed=1).floors
    grid = WindowGrid(RATE_HZ, SAMPLES, SAMPLES // blocks, 50, 10.0, 40.0)
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
