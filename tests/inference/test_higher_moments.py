"""Moments of a recording: what spectra of one level do not tell, and what only looks like a law."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivers.base import ACCELERATION
from monitor.core import Array
from monitor.diagnosis import diagnose
from monitor.diagnosis.initial_fit import fit_linearized
from monitor.diagnosis.score_test import Candidate
from monitor.diagnosis.selection_round import _choose_orientation
from monitor.diagnosis.simulation_refit import RefittedCandidate
from monitor.inference.ambient_posterior import AmbientPosterior
from monitor.inference.higher_moments import MeasuredMoments, Moments, measure_moments, normal_moments
from monitor.inference.map_estimate import MapEstimate
from monitor.inference.observed_spectra import classify
from monitor.inference.posterior import Posterior
from monitor.inference.segments import Segments, gather
from monitor.model import Model, parse_effect, prior_from_drawing, simulate
from monitor.model.effects.gap_contact import GapContact
from monitor.runs import cut_into_blocks
from tests.support.jointed_frame import CONFIG, RATE

pytestmark = pytest.mark.engine

CONTEXT = CONFIG.instrumented().context(RATE)
KNOWN = prior_from_drawing(CONFIG.model(), np.full(6, 0.002), 3)


def recorded(
    seed: int, *effects: str, duration_s: float = 1200.0, gusts: Array | None = None, tone: float = 0.0
) -> Segments:
    """Under forces of one level, or with gusts: factors on the samples."""
    motion = simulate(
        Model(CONFIG.model().structure, tuple(map(parse_effect, effects))),
        duration_s=duration_s,
        rate_hz=RATE,
        noise=0.02,
        level_spread=0.0,
        seed=seed,
        context=CONTEXT,
    )
    floors = motion.floors
    if gusts is not None:
        floors = floors * np.interp(np.arange(len(floors)), np.linspace(0, len(floors), gusts.size), gusts)[:, None]
    first_hz = CONFIG.model().modes().frequencies_hz[0]
    floors = floors + tone * np.sin(2.0 * np.pi * first_hz * np.arange(len(floors)) / RATE)[:, None]
    return gather(cut_into_blocks(ACCELERATION, floors, CONFIG.channels, RATE, 10**18, 128), CONFIG.front_end())


def posed(segments: Segments) -> tuple[Posterior, MapEstimate, MeasuredMoments]:
    problem, null = fit_linearized(classify(segments), KNOWN, CONTEXT)
    return problem, null, measure_moments(problem.observed.segments.values, problem, null)


def test_a_normal_process_has_none() -> None:
    for seed in (1, 2, 3):
        _, _, found = posed(recorded(seed))
        assert (np.abs(found.mean.kurtosis) < 3.5 * found.std.kurtosis).all()
        assert (np.abs(found.mean.skewness) < 3.5 * found.std.skewness).all()
        assert (found.std.kurtosis < 0.4).all()
        assert found.uneven < 0.05


def test_a_tone_lowers_the_kurtosis_of_its_mode_and_no_law_is_heard_in_it() -> None:
    problem, _, found = posed(recorded(4, tone=100.0))
    assert found.mean.kurtosis[0] == pytest.approx(-1.5, abs=0.1)
    nothing, drag = normal_moments(problem), replace(normal_moments(problem), kurtosis=np.array([-0.3, 0.0, 0.0]))
    assert found.log_likelihood(drag, 1.0) - found.log_likelihood(nothing, 1.0) < 3.0  # 50 and more by the normal law


def test_gusts_are_told_from_heavy_tails() -> None:
    gusts = np.exp(0.25 * np.random.default_rng(5).standard_normal(600))  # of 2 s
    problem, _, found = posed(recorded(5, gusts=gusts))
    assert found.uneven > 0.1
    friction = replace(normal_moments(problem), kurtosis=np.array([0.3, 0.3, 0.3]))
    calm = replace(found, uneven=0.0)
    for_friction = [
        h.log_likelihood(friction, 1.0) - h.log_likelihood(normal_moments(problem), 1.0) for h in (found, calm)
    ]
    assert for_friction[0] < 2.0 < for_friction[1]


def test_what_is_turned_round_keeps_its_tails() -> None:
    before, made = Moments(np.array([0.1]), np.array([0.2])), Moments(np.array([0.4]), np.array([0.5]))
    turned = made.mirrored(before)
    assert turned.skewness == pytest.approx([-0.2])
    assert turned.kurtosis == pytest.approx([0.5])


@pytest.mark.parametrize(
    "effect",
    ["coulomb_friction:story 2:friction_force_n=0.2", "story_damper:story 2:damping_n_s_per_m=1.2"],
    ids=["friction", "damper"],
)
def test_friction_and_a_damper_are_told_apart_at_one_level(effect: str) -> None:
    truth = parse_effect(effect)
    found = diagnose(classify(recorded(6, effect)), KNOWN, CONTEXT, CONFIG.diagnosis)
    assert [(c.effect.name, c.effect.location) for c in found.causes] == [(truth.name, truth.location)], (
        found.alternatives
    )


def test_a_law_that_is_turned_round_lends_its_new_skewness_to_what_follows() -> None:
    stop = GapContact("story 1", 1e-3, 2e3)
    mirror = stop.mirrored()
    assert mirror is not None
    x, none_at_all = stop.coordinates, np.zeros(0)
    fitted = MapEstimate(
        x, (stop,), 0.0, 0.0, np.zeros((2, 2)), True, np.zeros((0, 2)), none_at_all, none_at_all, np.zeros((2, 2))
    )
    before, made = Moments(np.zeros(3), np.zeros(3)), Moments(np.array([0.3, 0.0, 0.0]), np.array([0.1, 0.0, 0.0]))
    std = Moments(np.full(3, 0.05), np.full(3, 0.05))
    polished = RefittedCandidate(Candidate(stop, fitted, 50.0, 50.0), AmbientPosterior.__new__(AmbientPosterior), made)
    as_it_is, _ = _choose_orientation(polished, before, MeasuredMoments(made, std, 0.0))
    assert as_it_is is polished
    measured = MeasuredMoments(made.mirrored(before), std, 0.0)
    turned, likelihood = _choose_orientation(polished, before, measured)
    assert turned.candidate.effect == mirror == turned.candidate.fit.effects[0]
    assert turned.moments.skewness == pytest.approx([-0.3, 0.0, 0.0])
    assert likelihood == pytest.approx(measured.log_likelihood(made, 1.0) + 0.5 * (0.6 / 0.05) ** 2)
