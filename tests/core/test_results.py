"""Results: what is selected or placed keeps its values and its uncertainty."""

from __future__ import annotations

import numpy as np

from monitor.core import ModalEstimate, OtherMode


def test_modes_placed_among_all_channels_keep_each_channel_s_shape_and_uncertainty() -> None:
    rng, n_channels, channels = np.random.default_rng(0), 5, (1, 4)
    shapes = rng.standard_normal((2, 2)) + 1j * rng.standard_normal((2, 2))
    deviations, factor = rng.standard_normal((3, 2, 6)), rng.standard_normal((4, 2, 6))
    few = ModalEstimate(
        np.array([3.0, 7.0]), np.array([0.01, 0.02]), shapes, np.arange(2), deviations, 0, 6, np.zeros((0, 4)), factor,
        others=(OtherMode(9.0, 0.1, 0.01, shapes[0]),),
    )  # fmt: skip
    placed = few.at_channels(channels, n_channels)
    for place, channel in enumerate(channels):
        np.testing.assert_array_equal(placed.shapes[:, channel], shapes[:, place])
        assert placed.others[0].shape[channel] == shapes[0, place]
        for rows, before in ((placed.deviations, deviations), (placed.weight_factor, factor)):
            parts = [channel, n_channels + channel]  # of Re shape and Im shape
            np.testing.assert_array_equal(rows[:, :, 2:][:, :, parts], before[:, :, 2:][:, :, [place, 2 + place]])
    np.testing.assert_array_equal(placed.deviations[:, :, :2], deviations[:, :, :2])  # of ln f and damping ratio
    left_out = sorted(set(range(n_channels)) - set(channels))
    assert np.isnan(placed.shapes[:, left_out]).all() and np.isnan(placed.deviations[:, :, 2:][:, :, left_out]).all()
    np.testing.assert_array_equal(placed.frequencies_std_hz, few.frequencies_std_hz)
