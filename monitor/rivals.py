"""Candidates that data cannot tell apart, though one of them fits best."""

from __future__ import annotations

import numpy as np

from monitor.fitting import Fit
from monitor.likelihood import Problem
from monitor.polish import Polished
from monitor.results import Array
from monitor.search import change

SURE = 3.0
"""Standard deviations of a simulation's chance that a further cause, or one instead of another, must beat."""
_TIED = 1.0
"""Nats between two predictions that are one and the same."""


def together(tried: list[Polished], rival: float) -> list[Polished]:
    """Those that the best of them does not beat by `rival` nats and the chance in their simulations, best first."""
    tried = sorted(tried, key=lambda p: -p.candidate.evidence)
    best = tried[0]

    def reach(p: Polished) -> float:
        return p.candidate.evidence + SURE * float(np.hypot(p.chance, best.chance))

    return [p for p in tried if p is best or reach(p) > best.candidate.evidence - rival]


def probabilities(close: list[Polished]) -> Array:
    """Of candidates against each other, the first being the best, shape (n,): the more chance there is in the evidence, the
    nearer to even (D. MacKay, Neural Computation 4 (1992) 720).
    """
    best = close[0]
    apart = np.array([p.candidate.evidence - best.candidate.evidence for p in close])
    chance = np.array([np.hypot(p.chance, best.chance) for p in close])
    odds = np.exp(apart / np.sqrt(1.0 + np.pi / 8.0 * chance**2))
    return np.asarray(odds / odds.sum())


def same(problem: Problem, one: Fit, other: Fit) -> bool:
    """Whether two fits predict spectra that these data cannot tell apart, whatever else is added."""
    apart = change(problem, problem.predict(one.x, one.effects), problem.predict(other.x, other.effects))
    return bool(0.5 * float(apart @ apart) < _TIED)
