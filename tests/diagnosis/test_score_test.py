"""What the ranking of causes promises."""

from __future__ import annotations

import logging
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from monitor.core import Array
from monitor.diagnosis import score_test, selection_round
from monitor.diagnosis.ambiguity import tied_candidates
from monitor.diagnosis.score_test import (
    Candidate,
    best_first,
    best_of_each,
    candidate_starts,
    expected_gains,
    far_from_prior,
    fit_candidate,
    rank_by_score,
)
from monitor.diagnosis.settings import DiagnosisSettings
from monitor.diagnosis.simulation_refit import RefittedCandidate, fit_initial_model
from monitor.inference import (
    MapEstimate,
    MeasuredMoments,
    Moments,
    Posterior,
    Prediction,
    classify,
    join_coordinates,
    maximize_posterior,
)
from monitor.model import Effect, parse_effect
from tests.diagnosis.jointed_frame import CONFIG, CONTEXT, TURNING, fitted, learned, recorded
from tests.support.turning_frame import TORSION

pytestmark = pytest.mark.engine


def test_a_swap_is_ranked_first_though_the_plain_model_was_dragged_far_to_excuse_it() -> None:
    problem, null = fitted(recorded(seed=8, reads=np.eye(3)[[0, 2, 1]], duration_s=200.0, noise=0.05))
    assert null.log_prior < -20.0
    (gain, first), (second, _) = best_of_each(rank_by_score(problem, null, (), 3))[:2]
    assert first.name == "channel_swap"
    assert first.location == "channel a2,a3"
    assert gain > 2.0 * second


def test_a_reversed_channel_is_ranked_first_beside_modes_that_are_forced_otherwise_than_at_calibration() -> None:
    learnt = learned(*TURNING)
    modes = map(parse_effect, TURNING)
    weak = tuple(e.at(np.r_[e.coordinates[:2], 0.3 * e.coordinates[2:5], e.coordinates[5:]]) for e in modes)
    segments = recorded(*weak, seed=7, reads=np.array([-1.0, 1.0, 1.0]))
    problem, null, _ = fit_initial_model(classify(segments), learnt, CONTEXT)
    assert learnt.n_persistent and learnt.log_density(null.x[: learnt.mean.size]) < -20.0
    shaped = [(e.name, e.location) for e in candidate_starts(problem, null) if e.nonlinear or e.is_narrow]
    (gain, first), (second, _) = best_of_each(rank_by_score(problem, null, shaped, 3))[:2]  # the others' fits take long
    assert (first.name, first.location) == ("sensor_polarity", "channel a1")
    assert gain > 2.0 * second


def test_beside_modes_that_were_added_no_fit_is_held_at_a_drawing_far_off() -> None:
    """Such fits took most of the time of an eight-floor building's calibration."""
    problem, null = fitted(
        recorded("stiffness_change:story 2:relative=-0.2", TORSION[0], seed=10, duration_s=200.0, noise=0.05)
    )
    start = join_coordinates(null.x, TORSION[:1])
    beside_mode = maximize_posterior(problem, start, TORSION[:1])
    assert max(null.log_prior, beside_mode.log_prior) < -20.0
    assert far_from_prior(problem, null) and not far_from_prior(problem, beside_mode)


@pytest.mark.parametrize("channel", [0, 1, 2])
def test_the_score_test_promises_what_a_gain_brings_where_noise_is_little(channel: int) -> None:
    """A hundred times less noise than motion: what 2 % makes of the spectra is no straight line."""
    reads = np.where(np.arange(3) == channel, 0.98, 1.0)
    problem, null = fitted(recorded(seed=9, reads=reads, duration_s=200.0, noise=0.01), std=0.01)
    (promise, effect), *_ = [
        item
        for item in best_of_each(rank_by_score(problem, null, (), 3))
        if item[1].location == f"channel {CONFIG.channels[channel]}" and item[1].name == "sensor_gain"
    ]
    found = fit_candidate(problem, null, effect)
    assert found.effect.values()["gain"] == pytest.approx(0.98, abs=0.002)
    assert 0.5 * found.delta_log_posterior < promise < 2.0 * found.delta_log_posterior


def candidate(evidence: float, location: str, nonlinear: bool = True) -> Candidate:
    size = "cubic_stiffness:{}:k3_n_per_m3=1e26" if nonlinear else "stiffness_change:{}:relative=-0.1"
    return Candidate(parse_effect(size.format(location)), cast(MapEstimate, SimpleNamespace()), 50.0, evidence)


def test_a_start_without_a_finite_gain_is_never_moved_to_the_size_it_predicts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside a structure held where it cannot explain a swapped channel it made a loss of no size, and the search failed."""
    problem, null = fitted(recorded(seed=9, duration_s=200.0, noise=0.05), std=0.01)
    whole = score_test.whitened_slope

    def broken(at: Posterior, fit: MapEstimate, prediction: Prediction, effect: Effect) -> Array:
        slope = whole(at, fit, prediction, effect)
        return np.full_like(slope, np.nan) if effect.location == "story 2" else slope

    monkeypatch.setattr(score_test, "whitened_slope", broken)
    starts: list[Effect] = [parse_effect(f"stiffness_change:story {j}:relative=-0.01") for j in (1, 2, 3)]
    found = expected_gains(problem, null, starts)
    assert {effect.location for _, effect in found} == {"story 1", "story 3"}
    assert all(np.isfinite([gain, *effect.coordinates]).all() for gain, effect in found)


def test_a_candidate_without_finite_evidence_is_never_ranked(caplog: pytest.LogCaptureFixture) -> None:
    some = [candidate(v, f"story {i}") for i, v in enumerate((np.nan, 3.0, -np.inf, np.nan, 7.0, np.inf), start=1)]
    for order in (some, some[::-1]):
        with caplog.at_level(logging.INFO):
            assert [c.effect.location for c in best_first(order)] == ["story 5", "story 2"]
    assert "cubic_stiffness at story 1 is left out: its evidence is nan" in caplog.text


def test_a_law_whose_simulation_diverges_is_no_candidate(monkeypatch: pytest.MonkeyPatch) -> None:
    """As happens where a drift law is given to a bending element: the others keep their ranks."""
    observed = SimpleNamespace(segments=SimpleNamespace(values=None))
    stub = SimpleNamespace(observed=observed, linearizes=lambda effects: any(e.nonlinear for e in effects))
    posterior, fit = cast(Posterior, stub), cast(MapEstimate, SimpleNamespace())
    moments = Moments(np.zeros(3), np.zeros(3))

    def diverges(p: Posterior, f: MapEstimate, c: Candidate, effort: str = "rough") -> RefittedCandidate:
        return RefittedCandidate(replace(c, log_evidence=np.nan), p, moments)

    monkeypatch.setattr(selection_round, "refit_by_simulation", diverges)
    monkeypatch.setattr(selection_round, "measure_moments", lambda *a: None)
    linear = [candidate(30.0, "story 2", nonlinear=False), candidate(29.0, "story 3", nonlinear=False)]
    found = selection_round.simulate_contenders(
        posterior, fit, [candidate(40.0, "story 1"), *linear], moments, DiagnosisSettings()
    )
    assert [p.candidate.key for p in found] == [c.key for c in linear]
    assert tied_candidates([], 3.0) == [], "none may be left"


def test_a_rough_fit_that_is_no_valid_cause_keeps_no_rival_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """As of 2 % lost in the lowest story and a soft base, which no data tell apart, beside a mode at the band's end."""
    posterior, fit = cast(Posterior, SimpleNamespace()), cast(MapEstimate, None)
    best, base, loss, weak = (
        replace(candidate(evidence, place, nonlinear=False), delta_log_posterior=5.0)
        for evidence, place in ((60.0, "story 4"), (20.0, "story 3"), (20.0, "story 2"), (-20.0, "story 1"))
    )
    rough = {c.key: c for c in (best, base, loss, weak)}
    monkeypatch.setattr(selection_round, "fit_roughly", lambda *a: list(rough.values()))
    monkeypatch.setattr(selection_round, "fit_fully", lambda p, f, chosen, *a: {key: rough[key] for key in chosen})
    ranked = [(40.0, best.effect), (21.0, base.effect), (20.0, loss.effect), (1.0, weak.effect)]
    settings = DiagnosisSettings(favourites=2)

    def found(invalid: Candidate | None) -> list[Candidate]:
        monkeypatch.setattr(selection_round, "is_valid_cause", lambda p, c: c is not invalid)
        return selection_round.fit_ambient(posterior, fit, ranked, settings)

    assert found(invalid=None) == [best, base], "a valid cause that explains far more keeps its rivals out"
    assert found(invalid=best) == [base, loss]


def test_a_law_that_is_turned_round_lends_its_new_skewness_to_what_follows() -> None:
    stop = parse_effect("gap_contact:story 1:gap_m=0.001,contact_stiffness_n_per_m=2000")
    mirror = stop.mirrored()
    assert mirror is not None
    x, none_at_all = stop.coordinates, np.zeros(0)
    estimate = MapEstimate(
        x, (stop,), 0.0, 0.0, np.zeros((2, 2)), True, np.zeros((0, 2)), none_at_all, none_at_all, np.zeros((2, 2))
    )
    before, made = Moments(np.zeros(3), np.zeros(3)), Moments(np.array([0.3, 0.0, 0.0]), np.array([0.1, 0.0, 0.0]))
    std = Moments(np.full(3, 0.05), np.full(3, 0.05))
    polished = RefittedCandidate(Candidate(stop, estimate, 50.0, 50.0), cast(Posterior, SimpleNamespace()), made)
    as_it_is, _ = selection_round.choose_orientation(polished, before, MeasuredMoments(made, std, 0.0))
    assert as_it_is is polished
    measured = MeasuredMoments(made.mirrored(before), std, 0.0)
    turned, likelihood = selection_round.choose_orientation(polished, before, measured)
    assert turned.candidate.effect == mirror == turned.candidate.fit.effects[0]
    assert turned.moments.skewness == pytest.approx([-0.3, 0.0, 0.0])
    assert likelihood == pytest.approx(measured.log_likelihood(made, 1.0) + 0.5 * (0.6 / 0.05) ** 2)
