"""Response of a shear frame and what is identified from it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.signal import lfilter

from monitor.core import ModalEstimate, Skipped, Window
from monitor.identification import RefinementSettings, SelectionSettings, SsiSettings, identify_modes
from monitor.signals import WindowGrid, windows

RATE_HZ = 100.0
Array = NDArray[np.float64]


def shear_frame(floors: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Frequencies and shapes of a frame whose masses and stiffnesses scatter; the lowest frequency is 2 Hz."""
    k, m = rng.uniform(0.7, 1.3, floors), rng.uniform(0.8, 1.2, floors)
    drifts = np.eye(floors) - np.eye(floors, k=1)
    squares, shapes = eigh(drifts.T @ np.diag(k) @ drifts, np.diag(m))
    return 2.0 * np.sqrt(squares / squares[0]), shapes


def response(
    hz: Array,
    shapes: Array,
    damping: float,
    seconds: float,
    rng: np.random.Generator,
    noise: float = 0.1,
    level: Array | float = 1.0,
) -> Array:
    """Acceleration by white forces on every floor, each mode an exactly sampled resonator of a discrete model, and noise.

    `level` is that of the forces at each sample.
    """
    n = round(seconds * RATE_HZ)
    poles = np.exp(2.0 * np.pi / RATE_HZ * hz * (-damping + 1j * np.sqrt(1.0 - damping**2)))
    forces = (np.ones(n) * level)[:, None] * rng.standard_normal((n, len(shapes))) @ shapes
    modal = [
        lfilter([1.0, -2.0, 1.0], [1.0, -2.0 * p.real, abs(p) ** 2], f) for p, f in zip(poles, forces.T, strict=True)
    ]
    clean = np.transpose(modal) @ shapes.T
    return np.asarray(clean + noise * clean.std(axis=0) * rng.standard_normal(clean.shape))


def window_of(samples: Array) -> Window:
    """One window of all samples, its segments up to half the rate."""
    grid = WindowGrid(RATE_HZ, len(samples), 1000, 2 * SsiSettings().block_rows, 20.0, 45.0)
    (window,) = windows.step(grid, windows.start(grid, samples.shape[1], index=0), samples, 0)[1]
    assert isinstance(window, Window)
    return window


def identified(samples: Array) -> tuple[Window, ModalEstimate | Skipped]:
    window = window_of(samples)
    return window, identify_modes(window, SsiSettings(), SelectionSettings(), RefinementSettings())
