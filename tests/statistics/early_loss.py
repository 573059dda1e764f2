"""The loss that an event's final line tells, by the motion just before and after it: errors and stated deviations.

``python -m tests.statistics.early_loss N`` shakes the frame of three floors N times for each of four losses in story 2, and N
times with a story 2 that gives way with the amplitude and comes back: its secant stiffness at 5 mm of drift is a fifth less.
"""

from __future__ import annotations

import sys

import numpy as np
from numba import njit

from tests.events.shaken import MASSES, RATE, STIFFNESS, Array, Shaken, kanai_tajimi
from tests.events.test_early_loss import final, shaken

_SUB = 20
"""Steps of the integration in a sample."""


@njit(cache=True)
def _march(ground: Array, forces: Array, masses: Array, stiffness: Array, dampers: Array, softening: Array) -> Array:
    """Integrate the frame by semi-implicit Euler steps; return absolute accelerations and drifts, shape (n, 6)."""
    u, v, out = np.zeros(3), np.zeros(3), np.zeros((ground.size, 6))
    h = 1.0 / (RATE * _SUB)
    for i in range(ground.size - 1):
        for k in range(_SUB):
            at = ground[i] + (ground[i + 1] - ground[i]) * k / _SUB
            load = forces[i].copy()
            for j in range(3):
                drift = u[j] - (u[j + 1] if j < 2 else 0.0)
                rate = v[j] - (v[j + 1] if j < 2 else 0.0)
                secant = stiffness[j] * (1.0 - softening[j] * abs(drift) / (5e-3 + abs(drift)))
                force = secant * drift + dampers[j] * rate
                load[j] -= force
                if j < 2:
                    load[j + 1] += force
                if k == 0:
                    out[i, 3 + j] = drift
            acceleration = load / masses - at
            if k == 0:
                out[i, :3] = acceleration + at
            v += h * acceleration
            u += h * v
    return out


def softened(seed: int) -> Shaken:
    """Shake the frame whose story 2 softens with the amplitude and loses nothing for good."""
    rng = np.random.default_rng(seed)
    quiet = [np.zeros(round(s * RATE)) for s in (70, 75)]
    ground = np.concatenate([quiet[0], kanai_tajimi(20.0, 1.0, 2.5, rng), quiet[1]])
    forces = 6.0 * rng.standard_normal((ground.size, 3))
    dampers = 0.04 * STIFFNESS / (2.0 * np.pi * 3.14)
    out = _march(ground, forces, MASSES, STIFFNESS, dampers, np.array([0.0, 0.4, 0.0]))
    noisy = out[:, :3] + 2e-4 * rng.standard_normal((ground.size, 3))
    return Shaken(noisy, ground + 2e-4 * rng.standard_normal(ground.size), out[:, 3:])


def main(n: int) -> None:
    """Print what was told, in percent, of each story."""
    for lost in (0.0, 0.03, 0.1, 0.3, None):
        motions = (softened(seed) if lost is None else shaken.__wrapped__(lost, 1000 + seed) for seed in range(n))
        told = [final(motion)[0] for motion in motions]
        what, lost = ("softened", 0.0) if lost is None else (f"{100 * lost:.0f} % lost", lost)
        error = np.array([event.loss for event in told]) - [0.0, lost, 0.0]
        std = np.array([event.loss_std for event in told])
        z = np.abs(error / std)
        rms, stated, beyond = (
            np.sqrt(np.nanmean(error**2, axis=0)),
            np.nanmedian(std, axis=0),
            np.nanmean(z > 2.0, axis=0),
        )
        exceeded = sum(bool(event.exceeded) for event in told)
        right = sum(
            int(np.nanargmax(event.loss / event.loss_std)) == 1 for event in told if np.isfinite(event.loss).any()
        )
        print(
            f"{what}: errors {np.round(100 * rms, 1)} %, stated {np.round(100 * stated, 1)} %, beyond two "
            f"deviations {np.round(100 * beyond)} %, null {int(np.isnan(error).sum())}, limit of 5 % exceeded {exceeded}, "
            f"story 2 the most significant {right}, of {n}",
            flush=True,
        )


if __name__ == "__main__":
    main(int(sys.argv[1]))
