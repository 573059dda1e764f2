"""Maximize a log posterior near a point: Fisher scoring with Levenberg-Marquardt steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np

from monitor.core.results import Array

_FIRST_DAMPING = 1e-3
"""Damping of the first step, as a share of the normal matrix's diagonal. [ratio; Marquardt 1963 begins at 0.01]"""
_LEAST_RAISED_DAMPING = 1e-2
"""Least damping after a refused step. [ratio; judgement]"""
_DAMPING_FACTOR = 10.0
"""Factor by which damping rises after a refused step and falls after an accepted one. [ratio; Marquardt 1963]"""
_MAX_REFUSED = 6
"""Steps refused in a row after which the search ends. [count; damping has grown a millionfold]"""
_ROUNDING_NATS = 1e-9
"""Loss that counts as rounding. [nats; rounding]"""
_NO_INFORMATION = 1e-200
"""Information on a coordinate below which the coordinate stays where it is. [1; rounding: its square is next to no number]"""
_STALLED_FACTOR = 10.0
"""A search that no step improves has converged if the last step promised less than so many tolerances. [ratio; judgement]"""


class Point(Protocol):
    """A point that the search has evaluated."""

    @property
    def value(self) -> float:
        """The objective, nats."""


class Linearization(Protocol):
    """The objective near a point, to second order."""

    @property
    def normal(self) -> Array:
        """Negative of the expected second derivatives, positive definite."""

    @property
    def gradient(self) -> Array:
        """First derivatives."""


P = TypeVar("P", bound=Point)
L = TypeVar("L", bound=Linearization)


@dataclass(frozen=True, eq=False, slots=True)
class Maximum(Generic[P, L]):
    """Where a search ended."""

    point: P
    linearization: L | None
    """The one from which the last step was taken; None if there was no step to take."""
    converged: bool


def levenberg_marquardt(
    start: P,
    linearize: Callable[[P, L | None], L],
    move: Callable[[P, Array], P],
    *,
    iterations: int,
    tolerance: float,
    fixed_slopes_gain: float,
) -> Maximum[P, L]:
    """Maximize an objective by Levenberg-Marquardt steps; the search does not begin where the objective is not finite.

    `linearize` linearizes the objective at a point; its second argument is the linearization before, whose slopes may serve once
    more where a step gained up to `fixed_slopes_gain` (nats), or None.  `move` evaluates the point that lies a step away from
    another; it may shorten the step.  The search has converged where a step gains less than the tolerance, nats.

    References
    ----------
    D. W. Marquardt, J. SIAM 11 (1963) 431-441.

    Examples
    --------
    >>> from collections import namedtuple
    >>> Parabola, Slopes = namedtuple("Parabola", "x value"), namedtuple("Slopes", "normal gradient")
    >>> at = lambda x: Parabola(x, -0.5 * float((x - 3.0) ** 2))
    >>> found = levenberg_marquardt(
    ...     at(0.0), lambda p, last: Slopes(np.eye(1), np.array([3.0 - p.x])), lambda p, step: at(p.x + step[0]),
    ...     iterations=20, tolerance=1e-6, fixed_slopes_gain=0.0)
    >>> found.converged, round(float(found.point.x), 3)
    (True, 3.0)
    """
    point, damping, gain = start, _FIRST_DAMPING, np.inf
    linearization: L | None = None
    for _ in range(iterations if np.isfinite(start.value) else 0):
        linearization = linearize(point, None if gain > fixed_slopes_gain else linearization)
        normal, gradient = linearization.normal, linearization.gradient
        diagonal = np.diag(normal)
        known = diagonal > _NO_INFORMATION
        scale = np.where(known, 1.0 / np.sqrt(np.where(known, diagonal, 1.0)), 0.0)
        scaled, identity = normal * scale[:, None] * scale, np.eye(scale.size)
        for _ in range(_MAX_REFUSED):
            step = scale * np.linalg.solve(scaled + (damping + 1e-12) * identity, scale * gradient)
            if not np.isfinite(step).all():
                return Maximum(point, linearization, False)
            moved = move(point, step)
            if moved.value > point.value - _ROUNDING_NATS:
                break
            damping = max(_DAMPING_FACTOR * damping, _LEAST_RAISED_DAMPING)
        else:
            return Maximum(point, linearization, float(gradient @ step) < _STALLED_FACTOR * tolerance)
        gain, point = moved.value - point.value, moved
        damping /= _DAMPING_FACTOR
        if gain < tolerance:
            return Maximum(point, linearization, True)
    return Maximum(point, linearization, False)
