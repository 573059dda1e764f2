"""Hysteretic slip: a joint that slips, so that its story is softer and dissipates more the more it moves."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from math import inf
from typing import Annotated, Self

import numpy as np
from typing_extensions import override

from monitor.core import Array
from monitor.model.effects.base import (
    Condition,
    Context,
    Effect,
    FittedSizes,
    Law,
    LawKind,
    Parameter,
    System,
    place_index,
)
from monitor.model.structures import Structure

_LOG10_DRIFTS = np.linspace(-3.0, 3.0, 121)
"""Decades of the RMS drift over the drift at which the element slips, of the table of the linearized element. [1; accuracy
of the interpolation: 1e-3]"""
_CYCLE_STEPS = 400
"""Steps of half a cycle. [count; accuracy of the integral]"""
_AMPLITUDES = 64
"""Amplitudes over which the mean is taken. [count; accuracy of the integral]"""


@dataclass(frozen=True, eq=False, slots=True)
class Element:
    """Element of a story that slips."""

    story: int
    """Index of the story, from 0."""
    direction: Annotated[Array, "n"]
    """Row that picks the story's drift out of the floors' motion."""
    force_n: float
    """Force at which the element slips, N."""
    slip_m: float
    """Drift at which it would slip without rounding, m."""


@dataclass(frozen=True)
class HystereticSlip(Effect):
    """Hysteretic slip: story force (1 - r) k d + F z, with a share r of the story's stiffness k that slips at a force F.

    On the frame every story slips at the same drift, as where all joints are of one make; F is then the mean over stories.

    The element is that of Bouc and Wen with a sharpness of 2: ``dz = dd / dy (1 - z^2)`` where it is loaded, and
    ``dz = dd / dy`` where it is unloaded, with dy = F / (r k).  So the story has the stiffness k at small drift.  The element is
    linearized as the mean over the amplitudes of a narrow-band drift (Rayleigh's distribution, weighted by the squared
    amplitude) of the secant stiffness of its steady cycles and of the energy that they dissipate.

    References
    ----------
    Y. Wen, Method for random vibration of hysteretic systems, Journal of the Engineering Mechanics Division 102 (1976) 249.
    """

    name = "hysteretic_slip"
    family = "structure"
    places = ("story", "frame")
    parameters = (
        Parameter("force_n", 0.0, inf, absent=0.0),
        Parameter("relative", 0.0, 1.0, absent=0.0),
    )
    signature = "frequencies fall and damping rises with the level, the drift is not skewed"
    noun = "a joint that slips"
    separating_measurement = (
        "record at vibration levels a factor of three apart, with a measured force or ground motion"
    )
    families = ("softening", "dissipating")
    conditional = True
    nonlinear = True
    # Far sizes of the law, which a search by simulation tries, need steps finer than that simulation has.
    driven_only = True
    amplitude_powers = (-1.0, 0.0)

    force_n: float
    """Force of the element at which it slips."""
    relative: float
    """Share of the story's stiffness at small drift that slips away."""

    @property
    @override
    def is_softening(self) -> bool:
        return True

    @override
    def extend(self, system: System, context: Context, condition: Condition) -> System:
        for e in self.elements(context.structure):
            drift = float(condition.drift_m[e.story])
            secant, loss = linearized_element(drift / e.slip_m)
            stiffness, pattern = e.force_n / e.slip_m, np.outer(e.direction, e.direction)
            damping = stiffness * loss * drift / float(condition.drift_velocity_m_s[e.story])
            system = system.plus(stiffness=stiffness * (secant - 1.0) * pattern, damping=damping * pattern)
        return system

    @override
    def laws(self, structure: Structure) -> tuple[Law, ...]:
        return tuple(Law(LawKind.SLIP, e.direction, (e.force_n, e.slip_m)) for e in self.elements(structure))

    def elements(self, structure: Structure) -> tuple[Element, ...]:
        """Return the elements that slip: that of the story, or one in each story of the frame; none without a size."""
        if self.force_n == 0.0 or self.relative == 0.0:
            return ()
        k, rows = structure.stiffness_n_per_m, structure.drift_matrix()
        stories = range(structure.n_stories) if self.location == "frame" else (self.index(structure),)
        slip_m = self.force_n / (self.relative * float(k[list(stories)].mean()))
        return tuple(Element(j, rows[j], self.relative * float(k[j]) * slip_m, slip_m) for j in stories)

    @classmethod
    @override
    def starts(cls, location: str, context: Context, condition: Condition) -> tuple[Self, ...]:
        j = (
            0 if location == "frame" else place_index(location, context.structure)
        )  # the stories of a frame are of one order
        k, s = float(context.structure.stiffness_n_per_m[j]), float(condition.drift_m[j])
        return tuple(cls(location, 0.1 * k * s * slip, 0.1) for slip in (0.5, 2.0))

    @classmethod
    @override
    def sentence(cls, fitted: FittedSizes) -> str:
        share = fitted.sized("relative", f"{fitted.percent('relative')} of the stiffness", "a part of the stiffness")
        force = fitted.sized("force_n", f" at a force of {fitted.interval('force_n')}", "")
        subject = (
            "the joints of all stories slip" if fitted.location == "frame" else f"a joint of {fitted.location} slips"
        )
        return f"{subject}: {share} gives way{force}"


def linearized_element(drift: float) -> tuple[float, float]:
    """Compute the mean secant stiffness and the mean loss of an element of unit stiffness that slips at unit drift.

    The secant stiffness is over that at small drift; the loss is the energy dissipated in a cycle, over pi times the squared
    amplitude and the stiffness at small drift.  The RMS drift is over that at which the element slips.

    Examples
    --------
    >>> [round(x, 3) for x in linearized_element(0.001)]
    [1.0, 0.0]
    """
    log10, (secant, loss) = float(np.log10(max(drift, 1e-300))), _table()
    return float(np.interp(log10, _LOG10_DRIFTS, secant)), float(np.interp(log10, _LOG10_DRIFTS, loss))


@cache
def _table() -> tuple[Array, Array]:
    """Compute `linearized_element` at the drifts of `_LOG10_DRIFTS`."""
    nodes, weights = np.polynomial.laguerre.laggauss(_AMPLITUDES)
    # The nodes are the squared amplitudes over twice the variance; every amplitude counts by its square.
    weights = weights * nodes
    amplitudes = np.sqrt(2.0 * nodes) * 10.0 ** _LOG10_DRIFTS[:, None]
    secant, loss = steady_cycle(amplitudes)
    return secant @ weights / weights.sum(), loss @ weights / weights.sum()


def steady_cycle(amplitude: Array) -> tuple[Array, Array]:
    """Compute secant stiffness and loss of steady cycles of amplitudes over the drift at slip."""
    low, high = np.zeros(amplitude.shape), np.ones(amplitude.shape)
    for _ in range(60):  # bisection of the force at the turning points
        middle = 0.5 * (low + high)
        beyond = middle > np.tanh(np.maximum(2.0 * amplitude - middle, 0.0))
        low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
    turn = 0.5 * (low + high)
    angle = (np.arange(_CYCLE_STEPS) + 0.5) * np.pi / _CYCLE_STEPS
    secant, loss = np.zeros((2, *amplitude.shape))
    for phase in angle:
        path = amplitude * (1.0 - np.cos(phase)) - turn
        z = np.where(path < 0.0, path, np.tanh(np.maximum(path, 0.0)))
        secant -= 2.0 / _CYCLE_STEPS * z * np.cos(phase) / amplitude
        loss += 2.0 / _CYCLE_STEPS * z * np.sin(phase) / amplitude
    return secant, loss
