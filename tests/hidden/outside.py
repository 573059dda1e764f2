"""Trials of what is in no catalogue: sensors that stick, rattle or saturate, loggers that mix channels, laws of other forms.

In measured records a model lacks something, and spends its freedom on whatever candidate bends that way.  Here every cause that
is stated is false, but for the few that come close.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numba import njit
from scipy.signal import bilinear, butter, lfilter

from tests.hidden import world
from tests.hidden.frame import answer, drifts
from tests.hidden.judge import FAULT
from tests.hidden.plans import Outside, Plan, site_of
from tests.hidden.truth import CHANNELS, Hidden, Site, Truth, draw_truth
from tests.hidden.world import Act

_GAIN, _LATE = "sensor_gain", "time_offset"


def _of_channel(change: Callable[[Site, np.ndarray, float], np.ndarray], *near: str) -> Outside:
    """Let a fault change one channel's samples, which come at a rate in Hz; the effects `near` of that channel come close."""

    def drawn(s: Site) -> tuple[tuple[Hidden, ...], Act]:
        j, seed = int(s.rng.integers(3)), int(s.rng.integers(2**32))

        def fault(samples: np.ndarray, rate_hz: float) -> np.ndarray:
            samples[:, j] = change(replace(s, rng=np.random.default_rng(seed)), samples[:, j], rate_hz)
            return samples

        return tuple(Hidden(effect, f"channel {CHANNELS[j]}") for effect in (FAULT, *near)), replace(s.act, fault=fault)

    return drawn


def _sticks(s: Site, x: np.ndarray, rate_hz: float) -> np.ndarray:
    return _followed(x, s.between(0.1, 0.3) * float(x.std()))


@njit
def _followed(x: np.ndarray, play: float) -> np.ndarray:
    """A pointer that `x` drags along, with a play."""
    out, at = np.empty_like(x), 0.0
    for i in range(x.size):
        at = min(max(at, x[i] - play), x[i] + play)
        out[i] = at
    return out


def _on_a_spring(x: np.ndarray, rate_hz: float, hz: float, ratio: float) -> np.ndarray:
    omega = 2.0 * np.pi * hz
    return np.asarray(
        lfilter(*bilinear([2.0 * ratio * omega, omega**2], [1.0, 2.0 * ratio * omega, omega**2], rate_hz), x)
    )


def _rattles(s: Site, x: np.ndarray, rate_hz: float) -> np.ndarray:
    """Its mount gives where the motion is strong."""
    return np.where(
        np.abs(x) > s.between(0.8, 1.5) * x.std(), _on_a_spring(x, rate_hz, s.rng.uniform(25.0, 40.0), 0.05), x
    )


def _soft_mount(s: Site, x: np.ndarray, rate_hz: float) -> np.ndarray:
    return _on_a_spring(x, rate_hz, s.between(40.0, 60.0), 0.03)


def _saturates(s: Site, x: np.ndarray, rate_hz: float) -> np.ndarray:
    """Gently, unlike one that clips."""
    limit = s.between(1.2, 2.5) * float(x.std())
    return np.asarray(limit * np.tanh(x / limit))


def _slow(s: Site, x: np.ndarray, rate_hz: float) -> np.ndarray:
    return np.asarray(lfilter(*butter(1, s.between(30.0, 60.0), fs=rate_hz), x))


def _ramps(s: Site, x: np.ndarray, rate_hz: float) -> np.ndarray:
    return x * np.linspace(1.0, 1.0 + s.between(0.1, 0.4), x.size)


def _exchanged(s: Site, x: np.ndarray, rate_hz: float) -> np.ndarray:
    """The box is another one from somewhere in the record on: its gain and its delay."""
    t, at = np.arange(x.size), round(s.rng.uniform(0.3, 0.7) * x.size)
    other = np.interp(t, t + s.between(0.001, 0.005) * rate_hz, x) * (1.0 + s.sign() * 0.06)
    return np.where(t < at, x, other)


def crosstalk(s: Site) -> tuple[tuple[Hidden, ...], Act]:
    """A share of one channel gets into another."""
    (to, by), share = s.rng.permutation(3)[:2], s.between(0.03, 0.1)

    def fault(samples: np.ndarray, rate_hz: float) -> np.ndarray:
        samples[:, to] += share * samples[:, by]
        return samples

    return (Hidden(FAULT, f"channel {CHANNELS[to]}"),), replace(s.act, fault=fault)


def _stiffness_as(j: int, names: tuple[str, ...]) -> tuple[Hidden, ...]:
    base = (Hidden("base_flexibility", "base"),) if j == 2 and "stiffness_change" in names else ()
    return (*(Hidden(effect, f"story {j + 1}") for effect in names), *base)


def stiffness_by_level(s: Site) -> tuple[tuple[Hidden, ...], Act]:
    """A story that softens for minutes while the wind blows harder."""
    j, loss = int(s.rng.integers(3)), s.between(0.05, 0.2)
    level = world.wander(s.duration_s, s.rng)[: round(s.duration_s) + 1]
    d = drifts(3)[j]
    moving = float(s.truth.frame.stories[j]) * np.outer(d, d)
    return _stiffness_as(j, ("stiffness_change",)), replace(s.act, moving=moving, course=-loss * np.tanh(level))


def slip_of_many_sizes(s: Site) -> tuple[tuple[Hidden, ...], Act]:
    """Parallel elements that slip at drifts a factor of thirty apart (Iwan 1967): softening and loss follow the amplitude."""
    j, share = int(s.rng.integers(3)), s.between(0.02, 0.06)
    d, stiffness, laws = drifts(3)[j], s.act.stiffness.copy(), list(s.act.laws)
    for times in (0.1, 0.3, 1.0, 3.0):
        part, slip_m = share * float(s.truth.frame.stories[j]), times * float(s.motion.drift[j])
        stiffness -= part * np.outer(d, d)
        laws.append((world.SLIP, d, part * slip_m, slip_m))
    near = ("cubic_stiffness", "coulomb_friction", "story_damper", "stiffness_change")
    return _stiffness_as(j, near), replace(s.act, stiffness=stiffness, laws=tuple(laws))


def wandering_machine(s: Site) -> tuple[tuple[Hidden, ...], Act]:
    """Its speed changes by a few percent within the record."""
    floor, hz = int(s.rng.integers(3)), s.rng.uniform(6.0, 20.0)
    force = s.between(0.3, 0.8) * float(s.motion.channel[floor]) / answer(s.truth.frame, floor, hz)
    chirp = (floor, hz, hz * s.rng.uniform(1.02, 1.06), 1.4 * force)
    return (Hidden("harmonic_excitation", f"floor {floor + 1}"),), replace(s.act, chirp=chirp)


DRAWS: dict[str, Outside] = {
    "sticking_sensor": _of_channel(_sticks, _GAIN),
    "rattling_sensor": _of_channel(_rattles),
    "soft_mount": _of_channel(_soft_mount, _GAIN),
    "saturating_sensor": _of_channel(_saturates, _GAIN, "sensor_clipping"),
    "slow_sensor": _of_channel(_slow, _GAIN, _LATE),
    "ramping_gain": _of_channel(_ramps, _GAIN),
    "exchanged_box": _of_channel(_exchanged, _GAIN, _LATE),
    "crosstalk": crosstalk,
    "stiffness_by_level": stiffness_by_level,
    "slip_of_many_sizes": slip_of_many_sizes,
    "wandering_machine": wandering_machine,
}
NAMES = tuple(DRAWS)
"""One round of trials."""


def structure(seed: int, name: str) -> Truth:
    """The frame of a seed, alike for every name."""
    return draw_truth(seed)


def draw(truth: Truth, name: str, seed: int, size: float | None = None) -> Plan:
    """The trial `name`; place and size (its first one, unless it is given) from the seed."""
    site = site_of(truth, seed, size)
    close, act = DRAWS[name](site)
    return Plan("outside", close, lambda: world.blocks(world.record(act, site.duration_s, seed)))
