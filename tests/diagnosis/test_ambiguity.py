"""Which candidates stand beside the best one."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np

from monitor.diagnosis.ambiguity import probabilities, tied_candidates
from monitor.diagnosis.score_test import Candidate
from monitor.diagnosis.simulation_refit import RefittedCandidate
from monitor.inference import MapEstimate, Moments, Posterior
from monitor.model import parse_effect

RIVAL = 4.6


LOSS, CRACK = "stiffness_change:story 1:relative=-0.02", "bilinear_stiffness:story 1:relative_drop=0.04"
CLOCK = "clock_rate:frame:relative=0.01"


def judged(evidence: float, chance: float = 0.0, *, says: str = LOSS, gain: float | None = None) -> RefittedCandidate:
    none, one = np.zeros(0), 1e-10 * np.eye(1)
    fit = MapEstimate(none, (), 0.0, 0.0, one, True, np.zeros((0, 0)), none, none, np.zeros((0, 0)))
    return RefittedCandidate(
        Candidate(parse_effect(CRACK if chance else says), fit, evidence if gain is None else gain, evidence),
        cast(Posterior, SimpleNamespace()),
        Moments(none, none),
        log_evidence_std=chance,
    )


def test_a_linear_cause_is_beaten_by_odds_alone() -> None:
    best, near, far = judged(100.0), judged(96.0), judged(94.0)
    assert tied_candidates([far, near, best], RIVAL) == [best, near]
    assert np.allclose(probabilities([best, near]), np.array([1.0, np.exp(-4.0)]) / (1.0 + np.exp(-4.0)))


def test_the_chance_of_a_simulation_evens_the_odds() -> None:
    best, law, far = judged(100.0), judged(93.0, chance=2.0), judged(90.0, chance=2.0)
    assert tied_candidates([far, law, best], RIVAL) == [best, law]
    assert np.exp(-RIVAL) < probabilities([best, law])[1] < 2.0 * np.exp(-RIVAL)
    assert probabilities([best, far])[1] > 10.0 * np.exp(-10.0)


def test_a_clock_that_the_data_do_not_tell_apart_stays_though_its_prior_speaks_against_it() -> None:
    best, same = judged(100.0, gain=106.0), judged(92.0, says=CLOCK, gain=105.8)
    worse, other = judged(92.0, says=CLOCK, gain=103.0), judged(92.0, gain=105.8)
    assert tied_candidates([same, worse, other, best], RIVAL) == [best, same]
