"""Tails of the alarm's statistic.

A score whose standard deviation was estimated has the tail of Student's t.  It is turned into the standard normal score that is
exceeded as rarely, so that one limit holds however much was learned.

References
----------
D. L. Wallace, Bounds on normal approximations to Student's and the chi-square distributions, Ann. Math. Statist. 30 (1959)
1121-1130; F. E. Satterthwaite, An approximate distribution of estimates of variance components, Biometrics Bull. 2 (1946)
110-114.
"""

from __future__ import annotations

import numpy as np

from monitor.core import Array

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
