"""The exact laws' forces, compiled: what `monitor.simulate` evaluates at every step."""

from __future__ import annotations

from math import tanh

from numba import njit

from monitor.effects.base import LawKind

_CUBIC, _CONTACT, _FRICTION = int(LawKind.CUBIC), int(LawKind.CONTACT), int(LawKind.FRICTION)


@njit(cache=True)
def phi(kind: int, p0: float, p1: float, d: float, v: float) -> float:
    """Force at displacement d and velocity v; `LawKind` says what the parameters are, each effect why."""
    if kind == _CUBIC:
        a = min(abs(d), p1)
        force = p0 * a * (a * a + 3.0 * a * (abs(d) - a))  # the second term is the tangent beyond p1
        return force if d >= 0.0 else -force
    if kind == _CONTACT:
        closed = d > p0 if p0 >= 0.0 else d < p0
        return p1 * (d - p0) if closed else 0.0
    if kind == _FRICTION:
        return p0 * tanh(v / p1)
    return p0 * v * abs(v)
