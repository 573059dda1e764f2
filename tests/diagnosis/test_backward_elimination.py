"""What is seen again once more is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from monitor.diagnosis.backward_elimination import (
    eliminate_backward,
    find_better_null_fit,
    fit_subset,
    join_coordinates,
)
from monitor.diagnosis.parameter_uncertainty import coordinate_std, is_significant, summarize_fit
from monitor.diagnosis.score_test import fit_candidate
from monitor.diagnosis.simulation_refit import RefittedCandidate
from monitor.inference import MapEstimate, Posterior, maximize_posterior, normal_moments
from monitor.model import parse_effect
from tests.diagnosis.jointed_frame import fitted, recorded

pytestmark = pytest.mark.engine

MASS, OFFSET = "added_mass:floor 2:mass_kg=0.04", "time_offset:channel a3:seconds=0.0006"


def prepared(*effects: str) -> tuple[Posterior, MapEstimate]:
    return fitted(recorded(*effects, seed=8, duration_s=200.0, noise=0.05), std=0.01)


@pytest.fixture(scope="module")
def loaded() -> tuple[Posterior, MapEstimate]:
    return prepared(MASS, OFFSET)


def test_a_candidate_gets_no_credit_for_what_the_model_without_it_could_have_done() -> None:
    problem, null = prepared()
    x = null.x.copy()
    x[:3] += 0.05
    stuck = maximize_posterior(problem, x, iterations=1)
    tried = [
        RefittedCandidate(
            fit_candidate(problem, stuck, parse_effect("sensor_gain:channel a1:gain=1.001")),
            problem,
            normal_moments(problem),
        )
    ]
    assert tried[0].candidate.delta_log_posterior > 100.0
    better = find_better_null_fit(problem, stuck, tried)
    assert better[1].log_posterior == pytest.approx(null.log_posterior, abs=1.0)
    again = [
        RefittedCandidate(fit_candidate(problem, null, tried[0].candidate.effect), problem, normal_moments(problem))
    ]
    assert find_better_null_fit(problem, null, again) is None


def test_a_cause_that_was_only_a_guise_gives_way_once_the_others_are_known(
    loaded: tuple[Posterior, MapEstimate],
) -> None:
    problem, null = loaded
    guise = fit_candidate(problem, null, parse_effect("added_mass:floor 1:mass_kg=0.03"))
    true = fit_candidate(problem, null, parse_effect("added_mass:floor 2:mass_kg=0.03"))
    other = fit_candidate(problem, guise.fit, parse_effect(OFFSET))
    _, at, accepted = eliminate_backward(problem, other.fit, [guise, other], [(guise, true), (other,)], 7.0, 4.6)
    assert [c.key for c in accepted] == [("added_mass", "floor 2"), ("time_offset", "channel a3")]
    assert [(e.name, e.location) for e in at.effects] == [c.key for c in accepted]
    np.testing.assert_array_equal(at.x[problem.layout.effects], join_coordinates(np.zeros(0), at.effects))
    assert at.effects[0].values()["mass_kg"] == pytest.approx(0.04, rel=0.1)


def test_a_cause_that_later_ones_made_superfluous_is_dropped(loaded: tuple[Posterior, MapEstimate]) -> None:
    problem, null = loaded
    spurious = fit_candidate(problem, null, parse_effect("story_damper:story 3:damping_n_s_per_m=0.01"))
    mass = fit_candidate(problem, spurious.fit, parse_effect(MASS))
    other = fit_candidate(problem, mass.fit, parse_effect(OFFSET))
    _, at, accepted = eliminate_backward(
        problem, other.fit, [spurious, mass, other], [(spurious,), (mass,), (other,)], 7.0, 4.6
    )
    assert [c.key[0] for c in accepted] == [e.name for e in at.effects] == ["added_mass", "time_offset"]


def test_what_has_no_sure_size_is_no_cause(loaded: tuple[Posterior, MapEstimate]) -> None:
    problem, null = loaded
    effects = (parse_effect(MASS), parse_effect("sensor_gain:channel a1:gain=1.0001"), parse_effect(OFFSET))
    at = maximize_posterior(problem, null.x, effects)
    alone = np.sqrt(np.diag(at.covariance)[problem.layout.effects])
    own = coordinate_std(problem, at, alone, np.array([0.0, 0.1, 0.0]))
    kept = [is_significant(e, std) for e, std in zip(at.effects, own, strict=True)]
    assert kept == [True, False, True]
    crack = maximize_posterior(
        problem, null.x, (parse_effect("bilinear_stiffness:story 1:relative_drop=0.3"),), iterations=0
    )
    assert (
        crack.effects[0].form_std_in(summarize_fit(problem, crack))[0] >= 0.015 * 0.3
    )  # of its form, whatever the frame's
    alone, simulation_std = fit_subset(problem, at, np.array([1.0, 2.0, 3.0]), kept)
    assert [e.name for e in alone.effects] == ["added_mass", "time_offset"]
    assert simulation_std.tolist() == [1.0, 3.0]
    assert alone.log_posterior == pytest.approx(at.log_posterior, abs=5.0)


def test_what_dissipates_may_stay_where_a_structure_changed(loaded: tuple[Posterior, MapEstimate]) -> None:
    problem, null = loaded
    change = parse_effect("joint_flexibility:frame:girder_to_column_ratio=3")
    ratios, matrix = (replace(problem, damped_as_built=b).system(null.x, (change,)) for b in (False, True))
    built = problem.system(null.x, ())
    np.testing.assert_allclose(matrix.damping, built.damping, rtol=1e-12)
    np.testing.assert_array_equal(matrix.stiffness, ratios.stiffness)
    assert np.abs(ratios.damping - built.damping).max() > 0.05 * built.damping.max()


def test_a_fit_beside_a_rough_one_is_no_worse_from_a_bad_start() -> None:
    problem, null = prepared("coloured_excitation:frame:corner_hz=4.2")
    start = parse_effect("coloured_excitation:frame:corner_hz=3.0")
    rough = fit_candidate(problem, null, parse_effect("coloured_excitation:frame:corner_hz=16"), quick=True)
    found = fit_candidate(problem, null, start, rough=rough)
    assert found.log_evidence >= rough.log_evidence > 1000.0


def test_of_effects_without_a_size_some_may_stay(loaded: tuple[Posterior, MapEstimate]) -> None:
    problem, null = loaded
    effects = tuple(map(parse_effect, ("sensor_polarity:channel a1", "channel_swap:channel a2,a3")))
    fit = maximize_posterior(problem, null.x, effects, iterations=1)
    alone, simulation_std = fit_subset(problem, fit, np.zeros(0), (True, False))
    assert [e.name for e in alone.effects] == ["sensor_polarity"] and simulation_std.size == 0
