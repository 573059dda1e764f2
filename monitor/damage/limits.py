"""Limit of the alarm's statistic, from the false announcements that are allowed in a year.

A score whose standard deviation was estimated has the tail of Student's t.  It is turned into the standard normal score that is
exceeded as rarely, so that one limit holds however much was learned.

The score of a mean over s readings that share no data, looked at each step of d readings' lengths, is a Gaussian process whose
correlation falls as 1 - d/s.  It rises above u in clumps, each one announcement, whose number in the length of a reading is
u phi(u) nu(u sqrt(2 d / s)) / s: without overlap the tail probability of a reading, with much of it some ten times that.  The
numbers of all parts, sides and stretches are added, as if none shared an excursion with another.

A part that is compared with the mean of k others is announced where its score differs from theirs as well, by up to `credit`
less: their mean, of standard deviation 1/sqrt(k), is at most a = u - (u - credit) sqrt(1 + 1/k), or the part's own score lies
above u by what it is more.  Since scores above u fall off as exp(-u x), that leaves a share of the clumps in closed form.

References
----------
D. Siegmund, Sequential analysis (1985), sections 8.5 (nu) and 10.2; D. Siegmund, B. Yakir, The statistics of gene mapping (2007),
section 5.3 (clumps of a process with such a correlation, and nu in closed form); J. Pickands, Trans. Am. Math. Soc. 145 (1969)
51-73; D. L. Wallace, Bounds on normal approximations to Student's and the chi-square distributions, Ann. Math. Statist. 30 (1959)
1121-1130; F. E. Satterthwaite, An approximate distribution of estimates of variance components, Biometrics Bull. 2 (1946)
110-114.
"""

from __future__ import annotations

from functools import lru_cache
from math import erf, erfc, exp, pi, sqrt
from typing import NamedTuple

import numpy as np

from monitor.core import Array

_YEAR_S = 365.25 * 86400.0
"""A year. [s; definition]"""
_HIGHEST = 30.0
"""Limit above which none is looked for. [standard deviations; rounding: chance exceeds it in no year]"""
_MOST_FREEDOM = 1e9
"""Degrees of freedom beyond which a variance counts as known. [count; rounding]"""


def as_normal(t: Array | float, freedom: Array | float) -> Array:
    """Turn scores of Student's t into the standard normal scores that are exceeded as rarely, or a little more rarely.

    Examples
    --------
    >>> as_normal(np.array([6.7, 6.7, -6.7]), np.array([np.inf, 30.0, 30.0])).round(1)
    array([ 6.7,  5.2, -5.2])
    """
    f = np.minimum(freedom, _MOST_FREEDOM)
    return np.asarray(np.sign(t) * (8.0 * f + 1.0) / (8.0 * f + 3.0) * np.sqrt(f * np.log1p(t * t / f)))


def as_student(z: Array | float, freedom: Array | float) -> Array:
    """Turn standard normal scores, not negative, into the scores of Student's t that are exceeded as rarely.

    Examples
    --------
    >>> float(as_normal(as_student(5.2, 30.0), 30.0).round(6))
    5.2
    """
    f = np.minimum(freedom, _MOST_FREEDOM)
    return np.asarray(np.sqrt(f * np.expm1((z * (8.0 * f + 3.0) / (8.0 * f + 1.0)) ** 2 / f)))


def freedom_of_sum(variances: tuple[Array, ...], freedoms: tuple[Array | float, ...]) -> Array:
    """Compute the effective degrees of freedom of a sum of estimated variances (Satterthwaite).

    Examples
    --------
    >>> freedom_of_sum((np.array([1.0]), np.array([1.0])), (10.0, np.inf))
    array([40.])
    """
    total, uncertain = sum(variances), sum(v * v / f for v, f in zip(variances, freedoms, strict=True))
    most = np.full(np.shape(total), _MOST_FREEDOM)
    return np.asarray(np.divide(total * total, uncertain, out=most, where=uncertain > 0.0))


class Scores(NamedTuple):
    """What is tested at each look."""

    compared: int
    """Parts that are compared with each other."""
    alone: int
    """Parts, or components, that are tested by themselves."""
    sides: int = 1

    def at(self, limit: float, credit: float) -> float:
        """Return the number of tests by themselves that would be announced from `limit` on as often."""
        return self.sides * (self.compared * _left_by_others(limit, self.compared - 1, credit) + self.alone)


def _left_by_others(limit: float, others: int, credit: float) -> float:
    """Compute the share of a part's clumps above `limit` that its comparison with others leaves."""
    if others < 1:
        return 1.0
    std = 1.0 / sqrt(others)
    least = limit - (limit - credit) * sqrt(1.0 + std * std)
    beyond = 0.5 * erfc((least / std + limit * std) / sqrt(2.0))
    return 0.5 * erfc(-least / std / sqrt(2.0)) + exp(limit * least + 0.5 * (limit * std) ** 2) * beyond


def _density(x: float) -> float:
    return exp(-0.5 * x * x) / sqrt(2.0 * pi)


def _between_looks(x: float) -> float:
    """Compute nu: the share of the clumps that is seen by looks between which the process moves by x standard deviations."""
    half, below = 0.5 * x, 0.5 * erf(0.5 * x / sqrt(2.0))
    return below / half / (half * (0.5 + below) + _density(half))


def announcements(limit: float, tests: float, stretches: tuple[int, ...], apart_s: float, step: float) -> float:
    """Compute the false announcements in a year where scores are announced from `limit` on, in standard deviations, at least 1.

    `tests` is the number of parts and sides that are tested by themselves, `stretches` are the numbers of readings over which
    means are taken, `apart_s` is the time between two readings that share no data, and `step` that between two looks over it: 1
    where readings do not overlap.

    Examples
    --------
    >>> round(announcements(4.0, 1, (1,), 3600.0, 1.0), 2), round(announcements(4.0, 1, (1,), 3600.0, 0.025), 2)
    (0.29, 2.74)
    """
    density = limit * _density(limit)
    clumps = sum(density * _between_looks(limit * sqrt(2.0 * step / s)) / s for s in stretches)
    return tests * _YEAR_S / apart_s * clumps


@lru_cache(maxsize=1024)
def limit(
    per_year: float, tests: Scores, credit: float, stretches: tuple[int, ...], apart_s: float, step: float
) -> float:
    """Compute the limit that chance exceeds in `per_year` announcements a year; at least 1.  For the rest see `announcements`.

    `credit` is how much less, in standard deviations, a part must differ from others than from nothing.

    Examples
    --------
    >>> [round(limit(0.1, Scores(3, 0), 1.0, (1, 2, 4, 8), s, step), 2) for s, step in ((400.0, 0.025), (86400.0, 1.0))]
    [5.47, 3.99]
    """
    low, high = 1.0, _HIGHEST
    while high - low > 1e-9:
        middle = 0.5 * (low + high)
        found = announcements(middle, tests.at(middle, credit), stretches, apart_s, step)
        low, high = (middle, high) if found > per_year else (low, middle)
    return high
