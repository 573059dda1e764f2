"""Simulated corrections of linearized laws: nothing where nothing bends, the truth where something does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivers.base import ACCELERATION
from monitor.diagnosis.initial_fit import fit_linearized
from monitor.diagnosis.simulation_refit import refine_fit
from monitor.inference import (
    MapEstimate,
    Posterior,
    classify,
    correct_posterior,
    draw_forces,
    gather,
    linearize,
    maximize_posterior,
    simulate_spectra,
)
from monitor.model import Effect, parse_effect, prior_from_drawing, simulate
from monitor.runs import cut_into_blocks
from tests.diagnosis.jointed_frame import CONFIG, RATE, posed
from tests.support.frames import configured

pytestmark = pytest.mark.engine

CUBIC = "cubic_stiffness:story 2:k3_n_per_m3={:g}"
STRONG = 1e8


@pytest.fixture(scope="module")
def nonlinear() -> tuple[Posterior, MapEstimate]:
    return posed(parse_effect(CUBIC.format(STRONG)))


def whitened_rms(problem: Posterior, at: MapEstimate, change: np.ndarray) -> float:
    rows, _ = problem.whitened(problem.scatter(at.x, at.effects), change[None])
    return float(np.sqrt((rows**2).mean()))


def test_a_law_that_hardly_bends_has_no_offset(nonlinear: tuple[Posterior, MapEstimate]) -> None:
    problem, null = nonlinear
    sizes = []
    for size in (1e3, STRONG):
        at = replace(null, effects=(parse_effect(CUBIC.format(size)),))
        acting = draw_forces(problem, at.x, at.effects, 3)
        made = simulate_spectra(problem, at.x, at.effects, acting)
        sizes.append(whitened_rms(problem, at, made.controlled))
    assert sizes[0] < 1e-3 < 0.1 < sizes[1]


def test_classes_that_swing_more_than_the_model_says_are_measured(nonlinear: tuple[Posterior, MapEstimate]) -> None:
    problem, null = nonlinear
    predicted = problem.scatter(null.x, ())
    plain = linearize(problem, null.x, (), predicted)
    factors = np.ones((problem.n_classes, 1, 1, 1))
    factors[-1] = 4.0
    louder = linearize(problem, null.x, (), predicted * factors)
    assert louder[0].drift_m == pytest.approx(plain[0].drift_m)
    assert louder[-1].drift_m == pytest.approx(2.0 * plain[-1].drift_m, rel=0.1)
    assert louder[-1].floor_velocity_m_s == pytest.approx(2.0 * plain[-1].floor_velocity_m_s, rel=0.1)


def test_a_correction_follows_its_slopes_and_leaves_other_effects_alone(
    nonlinear: tuple[Posterior, MapEstimate],
) -> None:
    problem, null = nonlinear
    law = parse_effect(CUBIC.format(STRONG))
    plain = problem.scatter(null.x, (law,))
    more = parse_effect(CUBIC.format(1.01 * STRONG))
    other = problem.scatter(null.x, (more,))
    slope = 0.2 / STRONG * plain + 0.1 * (other - plain) / (0.01 * STRONG)
    made = correct_posterior(problem, null.x, (law,), 0.1 * plain, slope[None])
    assert made.scatter(null.x, (law,)) == pytest.approx(1.1 * plain)
    assert whitened_rms(problem, null, made.scatter(null.x, (more,)) - 1.102 * other) < 0.002
    assert made.scatter(null.x, ()) == pytest.approx(problem.scatter(null.x, ()))
    other_way = np.arange(problem.n_classes)[::-1]
    x = null.x.copy()
    levels = problem.layout.levels
    x[levels] = x[levels][::-1]
    assert made.part(problem.observed, other_way).scatter(x, (law,))[::-1] == pytest.approx(1.1 * plain)


def test_the_scale_of_masses_and_stiffness_that_nothing_shows_stays_unseen(
    nonlinear: tuple[Posterior, MapEstimate],
) -> None:
    problem, null = nonlinear
    law, rng = parse_effect(CUBIC.format(STRONG)), np.random.default_rng(0)
    plain = problem.scatter(null.x, (law,))
    made = correct_posterior(problem, null.x, (law,), 0.1 * plain, rng.uniform(0.1, 0.3) / STRONG * plain[None])
    x, layout = null.x.copy(), problem.layout
    x[layout.stiffness] += 0.2
    x[layout.masses] += 0.2
    x[layout.forces] += 0.4  # of the forces' densities
    heavier = made.scatter(x, (parse_effect(CUBIC.format(STRONG * np.exp(0.2))),))
    assert heavier == pytest.approx(made.scatter(null.x, (law,)), rel=1e-3)
    assert whitened_rms(problem, null, made.scatter(x, (law,)) - heavier) > 0.01


def test_simulation_mends_what_linearization_misses(nonlinear: tuple[Posterior, MapEstimate]) -> None:
    problem, null = nonlinear
    at = maximize_posterior(problem, null.x, (parse_effect(CUBIC.format(0.3 * STRONG)),))
    made, best = refine_fit(problem, at)
    n = problem.layout.n_nuisance
    std = float(np.hypot(np.sqrt(best.covariance[n, n]), made.simulation_std[0]))
    assert abs(best.x[n] - STRONG) < 3.0 * std
    assert std < 0.15 * STRONG


def test_a_correction_grows_with_the_motion(nonlinear: tuple[Posterior, MapEstimate]) -> None:
    """As a new simulation at another level says; a fit that takes it for constant is led away from the truth."""
    problem, null = nonlinear
    law, levels = parse_effect(CUBIC.format(0.3 * STRONG)), problem.layout.levels
    x = np.append(null.x, law.coordinates)
    problem = replace(problem, conditions=linearize(problem, x, (law,)))

    def simulated(x: np.ndarray, law: Effect = law) -> np.ndarray:
        made = [draw_forces(problem, x, (law,), seed) for seed in range(2)]
        both = [simulate_spectra(problem, x, (law,), f).controlled for f in made]
        return np.asarray(np.mean(both, axis=0))

    here = simulated(x)
    slope = (simulated(x, law.at(1.1 * law.coordinates)) - here) / (0.1 * law.coordinates[0])
    made = correct_posterior(problem, x, (law,), here, slope[None])
    louder = x.copy()
    louder[levels][-1] += 0.1
    plain, at = problem.scatter(louder, (law,)), replace(null, x=x, effects=(law,))
    anew = correct_posterior(problem, louder, (law,), simulated(louder), np.zeros((0, *here.shape))).scatter(
        louder, (law,)
    )
    constant = plain + made.scatter(x, (law,)) - problem.scatter(x, (law,))
    assert whitened_rms(problem, at, made.scatter(louder, (law,)) - anew) < 0.3 * whitened_rms(
        problem, at, constant - anew
    )


def test_a_law_on_a_floor_grows_with_the_motion_of_that_floor_where_stories_are_fewer() -> None:
    frame = CONFIG.model().structure
    watched = np.outer(frame.drift_matrix()[0], frame.drift_matrix()[0])
    matrices = {
        "kind": "matrices",
        "mass_matrix": frame.mass_matrix().tolist(),
        "stiffness_matrix": frame.stiffness_matrix().tolist(),
        "stiffness_n_per_m": [2900.0],
        "stiffness_derivatives": [watched.tolist()],
    }
    config = configured(matrices, (1, 2, 3))
    context = config.instrumented().context(RATE)
    motion = simulate(config.model(), duration_s=200.0, rate_hz=RATE, noise=0.05, seed=5, context=context)
    blocks = cut_into_blocks(ACCELERATION, motion.floors, config.channels, RATE, 10**18, 128)
    known = prior_from_drawing(config.model(), np.full(4, 0.002), 3)
    problem, null = fit_linearized(classify(gather(blocks, config.front_end())), known, context)
    law = parse_effect("quadratic_damping:floor 3:coefficient_n_s2_per_m2=5")
    x, plain = np.append(null.x, law.coordinates), problem.scatter(null.x, ())
    made = correct_posterior(problem, x, (law,), 0.1 * plain, 0.02 * plain[None])
    louder = x.copy()
    louder[problem.layout.levels] += 0.1
    here, there = made.beyond(x, (law,)), made.beyond(louder, (law,))
    assert here is not None
    assert there is not None
    np.testing.assert_allclose(there - here, 5.0 * np.expm1(0.05) * made.by_motion[0], rtol=1e-3, atol=1e-9)
