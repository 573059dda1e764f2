"""The loss that an event's final line tells, by the motion just before and after it: errors and stated deviations.

``python -m tests.statistics.early_loss N`` shakes the frame of three floors N times for each of four losses in story 2, and N
times with a story 2 that gives way with the amplitude and comes back: its secant stiffness at 5 mm of drift is a fifth less.

``python -m tests.statistics.early_loss N amid`` has story 2 lose stiffness, or slip, amid the motion.  It loses a share at once,
4 s after the quake begins.  The slip is that of a spring with a third of the story's stiffness, in series with dry friction
of 1,500 N.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numba import njit

from tests.events.shaken import MASSES, RATE, STIFFNESS, Array, Shaken, kanai_tajimi
from tests.support.campaign import words
from tests.support.losing_quake import final, shaken

_SUB = 20
"""Steps of the integration in a sample."""
_SLIP_N = 1500.0
"""Force at which the part of story 2 that slips does so; ambient motion stays far below, the quakes above."""


@njit(cache=True)
def _march(
    ground: Array, forces: Array, stiffness: Array, softening: Array, lost: float, lost_at: int, slips: float
) -> Array:
    """Integrate the frame by semi-implicit Euler steps; return absolute accelerations and drifts, shape (n, 6).

    Story 2 loses a share of its stiffness at a sample, and another share of it slips at `_SLIP_N`.
    """
    masses, dampers, stiffness = MASSES, 0.04 * STIFFNESS / (2.0 * np.pi * 3.14), stiffness.copy()
    friction = 0.0
    u, v, out = np.zeros(3), np.zeros(3), np.zeros((ground.size, 6))
    h = 1.0 / (RATE * _SUB)
    for i in range(ground.size - 1):
        if i == lost_at:
            stiffness[1] *= 1.0 - lost
        for k in range(_SUB):
            at = ground[i] + (ground[i + 1] - ground[i]) * k / _SUB
            load = forces[i].copy()
            for j in range(3):
                drift = u[j] - (u[j + 1] if j < 2 else 0.0)
                rate = v[j] - (v[j + 1] if j < 2 else 0.0)
                secant = stiffness[j] * (1.0 - softening[j] * abs(drift) / (5e-3 + abs(drift)))
                force = secant * drift + dampers[j] * rate
                if j == 1 and slips > 0.0:
                    spring = slips * stiffness[1]
                    friction = min(max(friction + spring * rate * h, -_SLIP_N), _SLIP_N)
                    force += friction - spring * drift
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


def nonlinear(seed: int, *, softening: float = 0.0, lost: float = 0.0, slips: float = 0.0) -> Shaken:
    """Shake the frame whose story 2 softens with the amplitude, loses a share of its stiffness amid the motion, or slips."""
    rng = np.random.default_rng(seed)
    quiet = [np.zeros(round(s * RATE)) for s in (70, 75)]
    ground = np.concatenate([quiet[0], kanai_tajimi(20.0, 1.0, 2.5, rng), quiet[1]])
    forces = 6.0 * rng.standard_normal((ground.size, 3))
    out = _march(ground, forces, STIFFNESS, np.array([0.0, softening, 0.0]), lost, round(74.0 * RATE), slips)
    noisy = out[:, :3] + 2e-4 * rng.standard_normal((ground.size, 3))
    return Shaken(noisy, ground + 2e-4 * rng.standard_normal(ground.size), out[:, 3:])


def cases(n: int, when: str) -> Iterator[tuple[str, float, list[Shaken]]]:
    """Yield what happened, the loss in story 2, and the motions; the loss comes amid the quake, or when it has ended."""
    if when == "amid":
        for lost, slips in ((0.1, 0.0), (0.3, 0.0), (0.0, 1.0 / 3.0), (0.1, 1.0 / 3.0)):
            what = f"{100 * lost:.0f} % lost amid the motion" + (", and slip" if slips else "")
            yield what, lost, [nonlinear(2000 + seed, lost=lost, slips=slips) for seed in range(n)]
        return
    for lost in (0.0, 0.03, 0.1, 0.3):
        yield f"{100 * lost:.0f} % lost", lost, [shaken.__wrapped__(lost, 1000 + seed) for seed in range(n)]
    yield "softened", 0.0, [nonlinear(seed, softening=0.4) for seed in range(n)]


def main() -> None:
    """Print what was told, in percent, of each story."""
    n, when = words(int, "after")
    for what, lost, motions in cases(n, when):
        told = [final(motion)[0] for motion in motions]
        drifts = np.array([np.nanmax(np.abs(motion.drifts), axis=0) for motion in motions])
        drift_error = np.array([event.drift_m for event in told]) / drifts - 1.0
        error = np.array([event.loss for event in told]) - [0.0, lost, 0.0]
        std = np.array([event.loss_std for event in told])
        z = np.abs(error / std)
        rms, beyond = np.sqrt(np.nanmean(error**2, axis=0)), np.nanmean(z > 2.0, axis=0)
        exceeded = sum(bool(event.exceeded) for event in told)
        right = sum(
            int(np.nanargmax(event.loss / event.loss_std)) == 1 for event in told if np.isfinite(event.loss).any()
        )
        print(
            f"{what}: errors {np.round(100 * rms, 1)} %, stated {np.round(100 * np.nanmedian(std, axis=0), 1)} %, beyond two "
            f"deviations {np.round(100 * beyond)} %, null {int(np.isnan(error).sum())}, limit of 5 % exceeded {exceeded}, "
            f"story 2 the most significant {right}, of {n}; "
            f"peak drifts off by at most {np.round(100 * np.abs(drift_error).max(axis=0), 1)} %",
            flush=True,
        )


if __name__ == "__main__":
    main()
