"""A second simulator, made from the contract's text alone: what it and the engine agree on is not a shared mistake.

Runge-Kutta at 4096 Hz with every law exact, forces white there and straight between their samples, a sharp FIR before
1024 Hz.  Whatever acts is plain numbers in an `Act`; nothing of the monitor's model or effects is used.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from scipy.ndimage import gaussian_filter1d
from scipy.signal import firwin, lfilter, upfirdn

from drivers.base import ACCELERATION, GROUND, TEMPERATURE, SampleBlock
from tests.hidden.frame import Frame, hung
from tests.hidden.sensors import Sensors, sensed

RATE_HZ = 1024.0
KNOT_HZ = 4096.0
_TAPS = firwin(161, 470.0, fs=KNOT_HZ)
_DOWN = round(KNOT_HZ / RATE_HZ)
FORCE_VARIANCE = KNOT_HZ / RATE_HZ
"""Of a force at 4096 Hz whose density is that of 1 N at 1024 Hz."""
DIRECT = FORCE_VARIANCE * float((_TAPS**2).sum())
"""Variance of such a force as recorded, N^2."""
_CHUNK_S = 50.0
T0_NS = 1_700_000_000_000_000_000
CUBIC, CONTACT, FRICTION, DRAG, SLIP = range(5)


@dataclass(frozen=True, eq=False)
class Act(Sensors):
    """What is at work in one recording beside the frame: matrices, laws, forces, sensors."""

    mass: np.ndarray
    damping: np.ndarray
    stiffness: np.ndarray
    """Shape (N, N): floors, then what hangs on them."""
    strength: np.ndarray
    """RMS of the floors' forces, as of 1 N at 1024 Hz, shape (n,)."""
    laws: tuple[tuple[int, np.ndarray, float, float], ...] = ()
    """(kind, direction (N,), two parameters)"""
    moving: np.ndarray | None = None
    """Stiffness (N, N) that is added times `course`."""
    course: np.ndarray | None = None
    """One value a second, the record's end included."""
    ground: float = 0.0
    """Density of a ground acceleration, (m/s^2)^2/Hz."""
    ground_level: np.ndarray | None = None
    """Level of that acceleration once a second, in place of one that wanders."""
    heard: bool = False
    """Whether the ground is recorded, as the last channel."""
    corner_hz: float | None = None
    line: tuple[int, float, float] | None = None
    """(floor, Hz, N)"""
    chirp: tuple[int, float, float, float] | None = None
    """(floor, first Hz, last Hz, N)"""
    impacts: tuple[int, float, float] | None = None
    """(floor, N s, mean s between them)"""
    clock: float = 0.0
    apart: bool = False
    """Whether every force, and the ground, has a level that wanders by itself."""
    degc: np.ndarray | None = None
    """Measured temperature, one value a second."""


def healthy(frame: Frame, strength: np.ndarray, noise: float) -> Act:
    """The frame alone."""
    return Act(*frame.modal(), strength=strength, noise=np.full(3, noise))


def record(act: Act, duration_s: float, seed: int) -> np.ndarray:
    """Samples of the channels at 1024 Hz, shape (n_samples, 3), m/s^2, or (n_samples, 4) with the ground."""
    force_rng, noise_rng, other_rng = (np.random.default_rng([seed, i]) for i in range(3))
    clean = np.concatenate(list(_floors(act, duration_s, force_rng, other_rng)))
    n = act.strength.size
    floors = sensed(act, clean[:, :n], RATE_HZ, noise_rng)
    return np.hstack([floors, clean[:, n:]]).astype(np.float32)


def blocks(samples: np.ndarray, degc: np.ndarray | None = None, rate_hz: float = RATE_HZ) -> list[SampleBlock]:
    """A recording of channels a1, a2, .. as a driver hands it over, 8 s a block."""
    size, channels, out = 8 * round(rate_hz), tuple(f"a{j + 1}" for j in range(samples.shape[1])), []
    for at in range(0, len(samples), size):
        t_ns, part = T0_NS + round(at / rate_hz * 1e9), samples[at : at + size]
        out.append(SampleBlock(ACCELERATION, t_ns, at, rate_hz, channels, "m/s^2", part))
    if degc is not None:
        out.append(SampleBlock(TEMPERATURE, T0_NS, 0, 1.0, ("t1",), "degC", degc[:, None].astype(np.float32)))
    return out


def shaken_blocks(samples: np.ndarray) -> list[SampleBlock]:
    """A recording whose last channel is the ground."""
    above = blocks(samples[:, :-1])
    ground = np.split(samples[:, -1:], np.cumsum([len(b.samples) for b in above])[:-1])
    below = (
        SampleBlock(GROUND, b.t_ns, b.sequence, RATE_HZ, ("ground",), "m/s^2", part)
        for b, part in zip(above, ground, strict=True)
    )
    return [block for pair in zip(below, above, strict=True) for block in pair]


def wander(duration_s: float, rng: np.random.Generator, spread: float = 0.35) -> np.ndarray:
    """Level of the excitation once a second, log-normal, smooth over 60 s, mean square 1."""
    smooth = gaussian_filter1d(rng.standard_normal(round(duration_s) + 602), 30.0)[300:-300]
    sigma = np.sqrt(np.log1p(spread**2))
    g = smooth * np.sqrt(2.0 * np.sqrt(np.pi) * 30.0)  # white noise under a Gaussian of 30 s
    return np.exp(sigma * g - sigma**2)


def _floors(act: Act, duration_s: float, rng: np.random.Generator, other: np.random.Generator) -> Iterator[np.ndarray]:
    """Absolute accelerations of the floors, chunk by chunk, filtered and thinned to 1024 Hz."""
    n, size = act.strength.size, act.mass.shape[0]
    level = np.stack([wander(duration_s, other)] * (n + 1), axis=1)
    blows = _blows(act, duration_s, other)
    if act.apart:
        level[:, 1:] = np.stack([wander(duration_s, other) for _ in range(n)], axis=1)
    dt = 1.0 / (KNOT_HZ * (1.0 + act.clock))
    kinds = np.array([law[0] for law in act.laws], dtype=np.int64)
    directions = np.array([law[1] for law in act.laws]).reshape(-1, size)
    parameters = np.array([law[2:] for law in act.laws], dtype=float).reshape(-1, 2)
    minv = np.linalg.inv(act.mass)
    moving = np.zeros((size, size)) if act.moving is None else act.moving
    state = np.zeros(2 * size + kinds.size)
    tail = np.zeros((_TAPS.size - 1, n + act.heard))
    last = np.zeros((1, size + 2))  # forces, ground acceleration, course
    memory = np.zeros((1, n))
    for start in range(0, round(duration_s * KNOT_HZ), round(_CHUNK_S * KNOT_HZ)):
        k = np.arange(start, min(start + round(_CHUNK_S * KNOT_HZ), round(duration_s * KNOT_HZ)))
        t = k / KNOT_HZ
        lev = np.stack([np.interp(t, np.arange(len(level)), one) for one in level.T], axis=1)
        if act.ground_level is not None:
            lev[:, n] = np.interp(t, np.arange(act.ground_level.size), act.ground_level)
        drive = np.zeros((k.size, size + 2))
        force = lev[:, :n] * act.strength * np.sqrt(FORCE_VARIANCE) * rng.standard_normal((k.size, n))
        if act.corner_hz is not None:
            decay = np.exp(-2.0 * np.pi * act.corner_hz * dt)
            force, memory = lfilter([1.0 - decay], [1.0, -decay], force, axis=0, zi=memory)
        drive[:, :n] = force
        for floor, phase, amplitude in _tones(act, t, duration_s):
            drive[:, floor] += amplitude * np.sin(phase)
        drive[:, :n] += blows[k] if blows is not None else 0.0
        drive[:, size] = (
            lev[:, n] * np.sqrt(act.ground * KNOT_HZ) * other.standard_normal(k.size) if act.ground else 0.0
        )
        if act.course is not None:
            drive[:, size + 1] = np.interp(t, np.arange(act.course.size), act.course)
        if start == 0:
            last = drive[:1]
        raw, state = march(
            minv, act.damping, act.stiffness, moving, kinds, directions, parameters,
            np.concatenate([last, drive]), state, dt, n,
        )  # fmt: skip
        last = drive[-1:]
        padded = np.concatenate([tail, np.hstack([raw, drive[:, [size]]]) if act.heard else raw])
        tail = padded[1 - _TAPS.size :]
        yield np.stack([_thin(column) for column in padded.T], axis=1)


def _thin(padded: np.ndarray) -> np.ndarray:
    """Every fourth value of the filtered signal; the first `_TAPS.size - 1` values are what went before."""
    before = _TAPS.size - 1
    return upfirdn(_TAPS, padded, up=1, down=_DOWN)[before // _DOWN :][: (padded.size - before) // _DOWN]


def _tones(act: Act, t: np.ndarray, duration_s: float) -> Iterator[tuple[int, np.ndarray, float]]:
    true_t = t / (1.0 + act.clock)
    if act.line is not None:
        yield act.line[0], 2.0 * np.pi * act.line[1] * true_t, act.line[2]
    if act.chirp is not None:
        floor, low, high, amplitude = act.chirp
        yield floor, 2.0 * np.pi * (low * true_t + 0.5 * (high - low) * true_t**2 / duration_s), amplitude


def _blows(act: Act, duration_s: float, rng: np.random.Generator) -> np.ndarray | None:
    if act.impacts is None:
        return None
    floor, impulse, mean_s = act.impacts
    out = np.zeros((round(duration_s * KNOT_HZ), act.strength.size))
    at = np.cumsum(mean_s * rng.uniform(0.6, 1.4, round(2.0 * duration_s / mean_s)))
    hit = (at[at < duration_s] * KNOT_HZ).astype(int)
    out[hit, floor] = impulse * KNOT_HZ * rng.uniform(0.5, 1.5, hit.size)
    return out


def with_dof(act: Act, floor: int, mass: float, stiffness: float, damping: float) -> Act:
    """A mass on a spring and a damper, hung on a floor."""
    m, c, k = hung((act.mass, act.damping, act.stiffness), floor, mass, stiffness, damping)
    laws = tuple((kind, np.pad(direction, (0, 1)), a, b) for kind, direction, a, b in act.laws)
    moving = None if act.moving is None else np.pad(act.moving, (0, 1))
    return replace(act, mass=m, damping=c, stiffness=k, laws=laws, moving=moving)


@njit(cache=True)
def _law(kind: int, p: float, q: float, d: float, v: float, z: float) -> float:
    if kind == 0:  # cubic: p = k3; softening fades where it would let the story run away, from the seventh order on
        if p >= 0.0:
            return p * d**3
        return p * d**3 / (1.0 + (d / q) ** 4)
    if kind == 1:  # contact beyond the gap p, of the sign of p; stiffness q
        if p < 0.0:
            return q * min(d - p, 0.0)
        return q * max(d - p, 0.0)
    if kind == 2:  # friction p; q the velocity within which it sticks
        return p * np.tanh(v / q)
    if kind == 3:
        return p * v * abs(v)
    return p * z  # slip at force p; q the drift at which it would slip without rounding


@njit(cache=True)
def _slope(minv, damping, stiffness, moving, kinds, directions, parameters, u, z, net, floors, out):
    """Rate of the state under `u`: forces, ground acceleration, course; `floors` becomes every dof's acceleration."""
    size = minv.shape[0]
    for i in range(size):
        total = u[i]
        for j in range(size):
            total -= (stiffness[i, j] + u[size + 1] * moving[i, j]) * z[j] + damping[i, j] * z[size + j]
        net[i] = total
    for q in range(kinds.size):
        d, v = 0.0, 0.0
        for j in range(size):
            d += directions[q, j] * z[j]
            v += directions[q, j] * z[size + j]
        memory = z[2 * size + q]
        out[2 * size + q] = 0.0
        if kinds[q] == 4:
            out[2 * size + q] = v / parameters[q, 1] * (1.0 - memory**2 if memory * v > 0.0 else 1.0)
        f = _law(kinds[q], parameters[q, 0], parameters[q, 1], d, v, memory)
        for j in range(size):
            net[j] -= directions[q, j] * f
    for i in range(size):
        total = 0.0
        for j in range(size):
            total += minv[i, j] * net[j]
        floors[i] = total
        out[i] = z[size + i]
        out[size + i] = total - u[size]


@njit(cache=True)
def march(minv, damping, stiffness, moving, kinds, directions, parameters, drive, state, dt, n):
    """Classical Runge-Kutta from knot to knot, what drives running straight between them."""
    size, width = minv.shape[0], drive.shape[1]
    seen = np.empty((drive.shape[0] - 1, n))
    z = state.copy()
    reach = np.array([0.0, 0.5, 0.5, 1.0])
    weight = np.array([1.0, 2.0, 2.0, 1.0]) * dt / 6.0
    whole = state.size
    rate, trial, total = np.zeros(whole), np.empty(whole), np.empty(whole)
    net, floors, u = np.empty(size), np.empty(size), np.empty(width)
    for k in range(1, drive.shape[0]):
        total[:] = z
        for r in range(4):
            part = reach[r]
            for i in range(width):
                u[i] = drive[k - 1, i] + part * (drive[k, i] - drive[k - 1, i])
            for i in range(whole):
                trial[i] = z[i] + reach[r] * dt * rate[i]
            _slope(minv, damping, stiffness, moving, kinds, directions, parameters, u, trial, net, floors, rate)
            for i in range(whole):
                total[i] += weight[r] * rate[i]
        z[:] = total
        _slope(minv, damping, stiffness, moving, kinds, directions, parameters, drive[k], z, net, floors, rate)
        for i in range(n):
            seen[k - 1, i] = floors[i]
    return seen, z
