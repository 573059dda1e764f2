"""The true structure of a hidden-effect test: its matrices from the contract's text, its stationary motion by Lyapunov."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from scipy.linalg import eigh, solve_continuous_lyapunov

GRAVITY = 9.81


@dataclass(frozen=True, eq=False)
class Frame:
    """A one-bay frame, floors from the top down.  `joint` is its girders' stiffness E I_g / L_g (None: rigid)."""

    masses: np.ndarray
    stories: np.ndarray
    heights: np.ndarray
    ratio: float
    joint: float | None = None
    lean: float = 0.0
    """What gravity takes of every story: this times the weight above over the height."""

    def girder(self, to_column: float) -> float:
        """E I_g / L_g for a girder-to-column ratio."""
        return to_column * float((self.stories * self.heights**2 / 24.0).mean())

    def stiffness(self) -> np.ndarray:
        """Of the floors, N/m."""
        d = drifts(self.stories.size)
        lost = self.lean * GRAVITY * np.cumsum(self.masses) / self.heights
        if self.joint is None:
            return d.T @ ((self.stories - lost)[:, None] * d)
        return self._jointed() - d.T @ (lost[:, None] * d)

    def _jointed(self) -> np.ndarray:
        """The columns' and girders' beam elements assembled, the rotations condensed."""
        n = self.stories.size
        full = np.zeros((2 * n + 2, 2 * n + 2))  # translations then rotations, the clamped ground last of each
        for j, (k, h) in enumerate(zip(self.stories, self.heights, strict=True)):
            ei = k * h**3 / 12.0  # of the two columns together
            beam = ei * np.array(
                [
                    [12 / h**3, 6 / h**2, -12 / h**3, 6 / h**2],
                    [6 / h**2, 4 / h, -6 / h**2, 2 / h],
                    [-12 / h**3, -6 / h**2, 12 / h**3, -6 / h**2],
                    [6 / h**2, 2 / h, -6 / h**2, 4 / h],
                ]
            )
            at = np.array([j + 1, n + 1 + j + 1, j, n + 1 + j])  # lower end, then upper
            full[np.ix_(at, at)] += beam
            full[n + 1 + j, n + 1 + j] += 12.0 * self.joint  # 2 ends x (4 + 2) E I_g / L_g
        u, r = np.arange(n), n + 1 + np.arange(n)
        kut = full[np.ix_(u, r)]
        return full[np.ix_(u, u)] - kut @ np.linalg.solve(full[np.ix_(r, r)], kut.T)

    def rayleigh(self) -> tuple[float, float]:
        """Factors on M and K that give modes 1 and 2 the damping ratio."""
        w = np.sqrt(eigh(self.stiffness(), np.diag(self.masses), eigvals_only=True)[:2])
        return tuple(2.0 * self.ratio * np.array([w[0] * w[1], 1.0]) / w.sum())

    def hz(self) -> np.ndarray:
        """Natural frequencies."""
        return np.sqrt(eigh(self.stiffness(), np.diag(self.masses), eigvals_only=True)) / (2.0 * np.pi)

    def modal(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """M, C, K."""
        a, b = self.rayleigh()
        mass, stiffness = np.diag(self.masses), self.stiffness()
        return mass, a * mass + b * stiffness, stiffness


def drifts(n: int) -> np.ndarray:
    """Rows that pick the stories' drifts out of the floors' displacements."""
    return np.eye(n) - np.eye(n, k=1)


def hung(
    matrices: tuple[np.ndarray, np.ndarray, np.ndarray], dof: int, mass: float, stiffness: float, damping: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """M, C, K with a mass on a spring and a damper, hung on a degree of freedom."""
    m, c, k = (np.pad(a, (0, 1)) for a in matrices)
    link = np.zeros(len(m))
    link[dof], link[-1] = -1.0, 1.0
    m[-1, -1] = mass
    bar = np.outer(link, link)
    return m, c + damping * bar, k + stiffness * bar


@dataclass(frozen=True, eq=False)
class Motion:
    """RMS of a healthy frame's stationary response, level 1."""

    drift: np.ndarray
    drift_velocity: np.ndarray
    floor_velocity: np.ndarray
    story_force: np.ndarray
    channel: np.ndarray
    """Absolute acceleration as recorded."""
    ground_variance: np.ndarray
    """Of the channels, for a white ground acceleration of two-sided density 1 (m/s^2)^2/Hz."""

    def scaled(self, level: float) -> Motion:
        """The motion at another level."""
        return Motion(
            *(level * getattr(self, f.name) for f in fields(self) if f.name != "ground_variance"), self.ground_variance
        )


def motion(frame: Frame, force: np.ndarray, direct: np.ndarray) -> Motion:
    """Stationary response to white forces.

    Parameters
    ----------
    force : ndarray, shape (n,)
        Two-sided densities, N^2/Hz.
    direct : ndarray, shape (n,)
        Variance of each force within the recorded band, N^2: what a floor answers at once.
    """
    minv = np.linalg.inv(np.diag(frame.masses))
    shaken = _covariance(frame, -np.ones((frame.masses.size, 1)), np.ones(1))
    variance = np.diag(_acceleration(frame) @ shaken @ _acceleration(frame).T)
    return _rms(frame, _covariance(frame, minv, force), direct * np.diag(minv) ** 2, variance)


def shaken_motion(frame: Frame, density: float) -> Motion:
    """Stationary response to a white ground acceleration of this two-sided density, (m/s^2)^2/Hz."""
    shaken = _covariance(frame, -np.ones((frame.masses.size, 1)), np.array([density]))
    variance = np.diag(_acceleration(frame) @ shaken @ _acceleration(frame).T)
    return _rms(frame, shaken, np.zeros(frame.masses.size), variance / density)


def _acceleration(frame: Frame) -> np.ndarray:
    """Rows that give the floors' absolute accelerations of a state."""
    mass, damping, stiffness = frame.modal()
    minv = np.linalg.inv(mass)
    return np.hstack([-minv @ stiffness, -minv @ damping])


def _covariance(frame: Frame, entry: np.ndarray, density: np.ndarray) -> np.ndarray:
    """Of the state, under white inputs of these densities that accelerate the floors by `entry`."""
    n = frame.masses.size
    dynamics = np.vstack([np.eye(2 * n)[n:], _acceleration(frame)])
    b = np.vstack([np.zeros_like(entry), entry])
    return solve_continuous_lyapunov(dynamics, -(b * density) @ b.T)


def _rms(frame: Frame, state: np.ndarray, direct: np.ndarray, ground_variance: np.ndarray) -> Motion:
    n, rows, d = frame.masses.size, _acceleration(frame), drifts(frame.masses.size)
    drift = np.sqrt(np.diag(d @ state[:n, :n] @ d.T))
    return Motion(
        drift=drift,
        drift_velocity=np.sqrt(np.diag(d @ state[n:, n:] @ d.T)),
        floor_velocity=np.sqrt(np.diag(state[n:, n:])),
        story_force=frame.stories * drift,
        channel=np.sqrt(np.diag(rows @ state @ rows.T) + direct),
        ground_variance=ground_variance,
    )


def answer(frame: Frame, floor: int, hz: float) -> float:
    """Magnitude of a floor's own acceleration per force there."""
    mass, damping, stiffness = frame.modal()
    w = 2.0 * np.pi * hz
    return float(abs(w**2 * np.linalg.inv(stiffness + 1j * w * damping - w**2 * mass)[floor, floor]))
