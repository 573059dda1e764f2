"""Which readings the means over several windows hold."""

from __future__ import annotations

import numpy as np
import pytest

from monitor.damage.sequential_test import average, begin

WINDOW_S = 100.0


@pytest.mark.parametrize(
    ("before", "common_before", "mean"),
    [
        ((), 0.09, 0.02),  # as where the weather was another
        ((0, 1), 0.01, 0.02),
        ((0, 1), 0.09, 0.03),
    ],
    ids=["the same channels, however sure", "other channels, as sure", "other channels that saw far less"],
)
def test_readings_of_channels_that_saw_far_less_are_left_out_of_the_means_and_no_others(
    before: tuple[int, ...], common_before: float, mean: float
) -> None:
    history, variance = begin(1, WINDOW_S), np.array([1e-3])
    for ddi, common, channels, end_s in ((0.01, common_before, before, 100), (0.03, 0.01, (), 200)):
        history, over = average(history, np.array([ddi]), variance, np.array([[common]]), channels, end_s * 10**9)
    assert over.means[:, 0] == pytest.approx([0.03, mean, mean, mean])
