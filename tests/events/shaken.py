"""Frames shaken by ground motions, with their true drifts; simulated apart from the product, by exact discretization."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.linalg import eigh, expm

from drivers.base import ACCELERATION, GROUND, SampleBlock
from monitor.config import Configuration
from tests.support.frames import shear_frame, shear_frame_text

Array = NDArray[np.float64]
T0_NS = 1_767_225_600_000_000_000
MASSES = np.array([1000.0, 1200.0, 1200.0])
STIFFNESS = np.array([1.6e6, 2.0e6, 2.4e6])
HEIGHTS = np.array([3.0, 3.0, 3.5])
RATE = 200.0


def structure_text(stiffness: Array = STIFFNESS) -> str:
    """The frame's structure and sensors as tables of a site file."""
    return shear_frame_text(MASSES.tolist(), stiffness.tolist(), damping_ratio=0.02, story_heights_m=HEIGHTS.tolist())


def configuration(
    floors: tuple[int, ...] = (1, 2, 3), scale: tuple[float, ...] = (1.0, 1.0, 1.0), **tables: object
) -> Configuration:
    """The site of the frames with sensors on some floors, its stiffnesses in the file wrong by a factor each."""
    more = {"damping_ratio": 0.02, "story_heights_m": HEIGHTS.tolist()}
    return shear_frame(MASSES, STIFFNESS * scale, floors, structure=more, **tables)


@dataclass(frozen=True)
class Shaken:
    """Motion of a frame, floor 1 is the top."""

    floors: Array
    """Absolute accelerations with noise, shape (n, 3), m/s^2."""
    ground: Array
    """Shape (n,), m/s^2, with noise."""
    drifts: Array
    """True drifts, shape (n, 3), m."""


def kanai_tajimi(duration_s: float, peak_m_s2: float, ground_hz: float, rng: np.random.Generator) -> Array:
    """A stochastic ground motion of Kanai and Tajimi with Clough's and Penzien's high-pass, rising for 2 s and decaying."""
    n, dt = round(duration_s * RATE), 1.0 / RATE
    w, z, low = 2.0 * np.pi * ground_hz, 0.6, 2.0 * np.pi * 0.2
    hz = np.fft.rfftfreq(n, dt)
    s = 2j * np.pi * hz
    soil = (w * w + 2.0 * z * w * s) / (w * w + 2.0 * z * w * s + s * s)
    passed = s * s / (low * low + 2.0 * 0.6 * low * s + s * s)
    wave = np.fft.irfft(np.fft.rfft(rng.standard_normal(n)) * soil * passed, n)
    t = np.arange(n) * dt
    strong_s = 0.4 * duration_s
    envelope = np.minimum(t / 2.0, 1.0) ** 2 * np.exp(-np.maximum(t - strong_s, 0.0) / (0.1 * duration_s))
    wave *= envelope
    return np.asarray(peak_m_s2 * wave / np.abs(wave).max())


def shake(
    ground: Array,
    rng: np.random.Generator,
    *,
    level: Array | float = 1.0,
    stiffness: Array = STIFFNESS,
    start: Array | None = None,
    force_n: float = 6.0,
    noise_m_s2: float = 2e-4,
) -> tuple[Shaken, Array]:
    """Shake a frame by its ground and by white forces on its floors; return its motion and its last state.

    Parameters
    ----------
    level : ndarray or float
        Factor on the forces over time.
    start : ndarray, shape (6,), optional
        Displacements and velocities at the beginning.
    """
    n = ground.size
    drift = np.eye(3) - np.eye(3, k=1)
    k = drift.T @ np.diag(stiffness) @ drift
    w2, shapes = eigh(k, np.diag(MASSES))
    forces = force_n * np.sqrt(RATE / 200.0) * rng.standard_normal((n, 3)) * np.reshape(level, (-1, 1))
    load = (forces - ground[:, None] * MASSES) @ shapes
    first = np.zeros(6) if start is None else start
    q0, v0 = shapes.T @ np.diag(MASSES) @ first[:3], shapes.T @ np.diag(MASSES) @ first[3:]
    u, v, a = (np.zeros((n, 3)) for _ in range(3))
    for j, w in enumerate(np.sqrt(w2)):
        own = np.array([[0.0, 1.0], [-w * w, -0.04 * w]])
        # Exact for a load that is linear between samples (first-order hold).
        big = np.zeros((4, 4))
        big[:2, :2], big[1, 2], big[2, 3] = own, 1.0, RATE
        step = expm(big / RATE)
        transition, by_now, by_next = step[:2, :2], step[:2, 2] - step[:2, 3], step[:2, 3]
        drive = load[:-1, j, None] * by_now + load[1:, j, None] * by_next
        x = _march(transition, drive, np.array([q0[j], v0[j]]))
        u += x[:, :1] * shapes[:, j]
        v += x[:, 1:] * shapes[:, j]
        a += (load[:, j] - 0.04 * w * x[:, 1] - w * w * x[:, 0])[:, None] * shapes[:, j]
    absolute = a + ground[:, None] + noise_m_s2 * rng.standard_normal((n, 3))
    measured = ground + noise_m_s2 * rng.standard_normal(n)
    return Shaken(absolute, measured, u @ drift.T), np.concatenate([u[-1], v[-1]])


@njit(cache=True)
def _march(transition: Array, drive: Array, first: Array) -> Array:
    """March two states through their drive, shape (n - 1, 2)."""
    x = np.empty((drive.shape[0] + 1, 2))
    x[0] = first
    for i in range(drive.shape[0]):
        for j in range(2):
            x[i + 1, j] = transition[j, 0] * x[i, 0] + transition[j, 1] * x[i, 1] + drive[i, j]
    return x


def blocks(motion: Shaken, *, with_ground: bool = True, n: int = 50, first: int = 0) -> list[SampleBlock]:
    """The motion as blocks of `n` samples; ground before floors."""
    out = []
    for i in range(0, len(motion.floors), n):
        t_ns = T0_NS + round((first + i) / RATE * 1e9)
        floors = motion.floors[i : i + n].astype(np.float32)
        if with_ground:
            ground = motion.ground[i : i + n, None].astype(np.float32)
            out.append(SampleBlock(GROUND, t_ns, first + i, RATE, ("g",), "m/s^2", ground))
        out.append(SampleBlock(ACCELERATION, t_ns, first + i, RATE, ("a1", "a2", "a3"), "m/s^2", floors))
    return out
