"""Candidates that data cannot tell apart, though one of them fits best."""

from __future__ import annotations

import numpy as np

from monitor.core import Array
from monitor.diagnosis.score_test import whitened_change
from monitor.diagnosis.simulation_refit import RefittedCandidate
from monitor.inference import MapEstimate, Posterior

_SAME_PREDICTION_NATS = 1.0
"""Difference of two predictions that count as the same. [nats; convention: a likelihood ratio of e]"""


def tied_candidates(candidates: list[RefittedCandidate], rival: float) -> list[RefittedCandidate]:
    """Those against which the log odds of the best are below `rival` nats, best first."""
    candidates = sorted(candidates, key=lambda p: -p.candidate.log_evidence)
    return [p for p, odds in zip(candidates, _log_odds(candidates), strict=True) if odds > -rival]


def probabilities(tied: list[RefittedCandidate]) -> Array:
    """Of candidates against each other, the first being the best, shape (n,)."""
    odds = np.exp(_log_odds(tied))
    return np.asarray(odds / odds.sum())


def _log_odds(ordered: list[RefittedCandidate]) -> Array:
    """Of candidates against the first, the best, shape (n,): the more chance there is in the evidence, the nearer to even
    (D. MacKay, Neural Computation 4 (1992) 720).
    """
    best = ordered[0]
    apart = np.array([p.candidate.log_evidence - best.candidate.log_evidence for p in ordered])
    chance = np.array([np.hypot(p.log_evidence_std, best.log_evidence_std) for p in ordered])
    return np.asarray(apart / np.sqrt(1.0 + np.pi / 8.0 * chance**2))


def predict_the_same(posterior: Posterior, one: MapEstimate, other: MapEstimate) -> bool:
    """Whether two fits predict spectra that these data cannot tell apart, whatever else is added."""
    apart = whitened_change(posterior, posterior.predict(one.x, one.effects), posterior.predict(other.x, other.effects))
    return bool(0.5 * float(apart @ apart) < _SAME_PREDICTION_NATS)
