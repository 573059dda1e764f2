"""Moments of a recording: what spectra of one level do not tell, and what only looks like a law."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from monitor.diagnosis import diagnose
from monitor.inference.higher_moments import MeasuredMoments, Moments, drift_skewness, measure_moments, normal_moments
from monitor.inference.map_estimate import MapEstimate
from monitor.inference.observed_spectra import classify
from monitor.inference.posterior import Posterior
from monitor.inference.segments import Segments
from monitor.model import parse_effect
from tests.diagnosis.jointed_frame import CONFIG, CONTEXT, PLAIN, RATE, fitted, known, recorded

pytestmark = pytest.mark.engine


def posed(segments: Segments) -> tuple[Posterior, MapEstimate, MeasuredMoments]:
    problem, null = fitted(segments)
    return problem, null, measure_moments(problem.observed.segments.values, problem, null)


def test_a_normal_process_has_none() -> None:
    for seed in (1, 2, 3):
        _, _, found = posed(recorded(seed=seed, duration_s=1200.0))
        assert (np.abs(found.mean.kurtosis) < 3.5 * found.std.kurtosis).all()
        assert (np.abs(found.mean.skewness) < 3.5 * found.std.skewness).all()
        assert (found.std.kurtosis < 0.4).all()
        assert found.uneven < 0.05


def test_a_tone_lowers_the_kurtosis_of_its_mode_and_no_law_is_heard_in_it() -> None:
    machine = f"harmonic_excitation:floor 1:frequency_hz={CONFIG.model().modes().frequencies_hz[0]},force_n=20"
    problem, _, found = posed(recorded(machine, seed=4, duration_s=1200.0))
    assert found.mean.kurtosis[0] == pytest.approx(-1.5, abs=0.1)
    nothing, drag = normal_moments(problem), replace(normal_moments(problem), kurtosis=np.array([-0.3, 0.0, 0.0]))
    assert found.log_likelihood(drag, 1.0) - found.log_likelihood(nothing, 1.0) < 3.0  # 50 and more by the normal law


def test_gusts_are_told_from_heavy_tails() -> None:
    gusts = np.exp(0.25 * np.random.default_rng(5).standard_normal(601))  # of 2 s
    course = np.interp(np.arange(1200 * RATE) / RATE, 2.0 * np.arange(601), gusts)
    problem, _, found = posed(recorded(seed=5, reads=course[:, None], config=PLAIN, duration_s=1200.0))
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
    found = diagnose(classify(recorded(effect, seed=6, duration_s=600.0)), known(), CONTEXT, CONFIG.diagnosis)
    assert [(c.effect.name, c.effect.location) for c in found.causes] == [(truth.name, truth.location)], (
        found.alternatives
    )


def test_a_drift_that_no_sensor_moves_with_says_nothing_of_its_skewness() -> None:
    transforms = np.random.default_rng(1).normal(size=(20, 30, 2)) + 0j
    band = SimpleNamespace(hz=np.arange(1.0, 31.0), first=1, n_bins=30)
    structure = SimpleNamespace(drift_matrix=lambda: np.array([[1.0, 0.0], [0.0, 0.0]]))
    problem = SimpleNamespace(observed=SimpleNamespace(band=band), context=SimpleNamespace(structure=structure))
    mean, std = drift_skewness(transforms, cast(Posterior, problem))
    assert np.isfinite([mean[0], std[0]]).all() and (mean[1], std[1]) == (0.0, np.inf)
