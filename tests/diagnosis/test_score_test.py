"""What the ranking of causes promises."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.base import ACCELERATION
from monitor.diagnosis.initial_fit import fit_linearized
from monitor.diagnosis.score_test import best_of_each, candidate_starts, fit_candidate, rank_by_score
from monitor.inference.cross_spectra import accelerance
from monitor.inference.observed_spectra import classify
from monitor.inference.segments import gather
from monitor.model.effects import ChannelSwap, SensorGain
from monitor.model.prior import prior_from_drawing
from monitor.model.simulation import simulate
from monitor.runs.synthetic_recording import cut_into_blocks
from tests.diagnosis.test_simulation_refit import CONFIG, RATE

pytestmark = pytest.mark.engine


def test_a_swap_is_ranked_first_though_the_plain_model_was_dragged_far_to_excuse_it() -> None:
    context = CONFIG.instrumented().context(RATE)
    motion = simulate(CONFIG.model(), duration_s=400.0, rate_hz=RATE, noise=0.05, seed=8, context=context)
    blocks = cut_into_blocks(ACCELERATION, motion.floors[:, [0, 2, 1]], CONFIG.channels, RATE, 10**18, 128)
    known = prior_from_drawing(CONFIG.model(), np.full(6, 0.002), 3)
    problem, null = fit_linearized(classify(gather(blocks, CONFIG.front_end())), known, context)
    assert null.log_prior < -20.0
    (gain, first), (second, _) = best_of_each(rank_by_score(problem, null, candidate_starts(problem, null)))[:2]
    assert isinstance(first, ChannelSwap)
    assert first.location == "channel a2,a3"
    assert gain > 2.0 * second


@pytest.mark.parametrize("channel", [0, 1, 2])
def test_the_score_test_promises_what_a_gain_brings_where_noise_is_little(channel: int) -> None:
    """A hundred times less noise than motion: what 2 % makes of the spectra is no straight line."""
    context = CONFIG.instrumented().context(RATE)
    motion = simulate(CONFIG.model(), duration_s=400.0, rate_hz=RATE, noise=0.01, seed=9, context=context)
    blocks = cut_into_blocks(
        ACCELERATION, motion.floors * np.where(np.arange(3) == channel, 0.98, 1.0), CONFIG.channels, RATE, 10**18, 128
    )
    problem, null = fit_linearized(
        classify(gather(blocks, CONFIG.front_end())), prior_from_drawing(CONFIG.model(), np.full(6, 0.01), 3), context
    )
    ranked = best_of_each(rank_by_score(problem, null, candidate_starts(problem, null)))
    (promise, effect), *_ = [
        item
        for item in ranked
        if item[1].location == f"channel {CONFIG.channels[channel]}" and isinstance(item[1], SensorGain)
    ]
    found = fit_candidate(problem, null, effect)
    assert found.effect.values()["gain"] == pytest.approx(0.98, abs=0.002)
    assert 0.5 * found.delta_log_posterior < promise < 2.0 * found.delta_log_posterior


def test_an_attached_mass_that_a_fit_lets_go_to_nothing_changes_no_response() -> None:
    mass, stiffness = (
        np.diag([2.0, 1.0, 1e-300]),
        np.array([[300.0, -100.0, 0.0], [-100.0, 100.0, 0.0], [0.0, 0.0, 9e-297]]),
    )
    damping, omega = 0.01 * stiffness, np.linspace(1.0, 60.0, 50)
    whole = accelerance(mass, damping, stiffness, omega, np.eye(3)[:, :2])
    alone = accelerance(mass[:2, :2].copy(), damping[:2, :2].copy(), stiffness[:2, :2].copy(), omega, np.eye(2))
    np.testing.assert_allclose(whole[:, :2], alone, rtol=1e-12)
