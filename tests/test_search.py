"""What the ranking of causes promises."""

from __future__ import annotations

import numpy as np

from drivers.base import ACCELERATION
from monitor.effects import ChannelSwap, Context
from monitor.evidence import classify
from monitor.record import blocks_of
from monitor.reference import nominal
from monitor.search import best_of_each, prepare, rank, starts
from monitor.segments import gather
from monitor.simulate import simulate
from tests.test_polish import CONFIG, RATE


def test_a_swap_is_ranked_first_though_the_plain_model_was_dragged_far_to_excuse_it() -> None:
    context = Context(CONFIG.model().structure, CONFIG.channels, CONFIG.sensor_matrix(), RATE)
    motion = simulate(CONFIG.model(), duration_s=400.0, rate_hz=RATE, noise=0.05, seed=8, context=context)
    blocks = blocks_of(ACCELERATION, motion.floors[:, [0, 2, 1]], CONFIG.channels, RATE, 10**18, 128)
    known = nominal(CONFIG.model(), np.full(6, 0.002), 3)
    problem, null = prepare(classify(gather(blocks, CONFIG)), known, context)
    assert null.log_prior < -20.0
    (gain, first), (second, _) = best_of_each(rank(problem, null, starts(problem, null)))[:2]
    assert isinstance(first, ChannelSwap)
    assert first.location == "channel a2,a3"
    assert gain > 2.0 * second
