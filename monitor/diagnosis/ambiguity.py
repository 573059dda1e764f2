"""Ambiguity of a diagnosis: candidates that the data cannot tell apart, though one of them fits best."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from monitor.core import Array
from monitor.diagnosis.score_test import Candidate
from monitor.diagnosis.simulation_refit import RefittedCandidate
from monitor.inference import MapEstimate, Posterior

_SAME_PREDICTION_NATS = 1.0
"""Difference of two predictions that count as the same. [nats; convention: a likelihood ratio of e]"""


def tied_candidates(candidates: list[RefittedCandidate], rival: float) -> list[RefittedCandidate]:
    """Select the candidates whose log odds against the best one exceed ``-rival``, nats, best first.

    A clock that explains a recording as well stays, though clocks are seldom so wrong: the data do not tell it apart.
    """
    candidates = sorted(candidates, key=lambda p: -p.candidate.log_evidence)
    if not candidates:
        return []
    best = candidates[0].candidate
    return [
        p
        for p, odds in zip(candidates, _log_odds(candidates), strict=True)
        if odds > -rival or _only_prior_differs(best, p.candidate)
    ]


def _only_prior_differs(best: Candidate, other: Candidate) -> bool:
    """Decide if a cause whose size has a prior gains as much as the best, so that the prior alone makes it less probable."""
    n = len(other.effect.parameters)
    has_prior = other.effect.size_cost(other.fit.covariance[-n:, -n:]) is not None
    return has_prior and other.delta_log_posterior > best.delta_log_posterior - _SAME_PREDICTION_NATS


def probabilities(tied: list[RefittedCandidate]) -> Annotated[Array, "n"]:
    """Compute the probability of each tied candidate, best first, as if they were the only possible causes."""
    odds = np.exp(_log_odds(tied))
    return np.asarray(odds / odds.sum())


def _log_odds(ordered: list[RefittedCandidate]) -> Annotated[Array, "n"]:
    """Compute the log odds of candidates against the first one, which is the best, nats.

    Random error of the evidence moderates the odds towards even (D. MacKay, Neural Computation 4 (1992) 720).
    """
    best = ordered[0]
    difference = np.array([p.candidate.log_evidence - best.candidate.log_evidence for p in ordered])
    std = np.array([np.hypot(p.log_evidence_std, best.log_evidence_std) for p in ordered])
    return np.asarray(difference / np.sqrt(1.0 + np.pi / 8.0 * std**2))


def predict_the_same(posterior: Posterior, one: MapEstimate, other: MapEstimate) -> bool:
    """Decide if the data cannot tell the spectra that two fits predict apart, so that no further effect can either."""
    change = posterior.whitened_change(posterior.predict(one.x, one.effects), posterior.predict(other.x, other.effects))
    return bool(0.5 * float(change @ change) < _SAME_PREDICTION_NATS)
