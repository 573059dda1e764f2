"""A structure in three dimensions: rigid floors that move in x and y and turn; and its exact linear motion.

Forces are drawn in time and brought into frequency; there every pair of poles answers exactly, up to half the sampling rate.
Nothing of the monitor's model is used.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq
from scipy.linalg import eigh
from scipy.optimize import linear_sum_assignment

from tests.hidden.frame import Frame, drifts, hung
from tests.hidden.sensors import Sensors, sensed
from tests.hidden.world import wander

X, Y, TURN = range(3)
"""Directions of a floor: degree of freedom 3 * floor + direction."""
_LEAD_S = 60.0
"""Of motion before a record, in which the end of the periodic motion dies away."""
_AT_ONCE = 1 << 14
"""Frequencies whose answer is held in memory together."""
_PLANAR = 0.8
"""Share of a mode's energy in one planar mode from which the planar model has that mode."""


@dataclass(frozen=True, eq=False)
class Building:
    """Rigid floors from the top down, each a rectangle, on lines of columns or walls along x and along y."""

    masses: np.ndarray
    plan: tuple[float, float]
    """Widths in x and y, m."""
    centre: np.ndarray
    """Mass centre of each floor from the plan's middle, shape (n, 2), m."""
    x_lines: np.ndarray
    """Stiffness of each story's two lines along x, at y = -reach and +reach, shape (n, 2), N/m."""
    y_lines: np.ndarray
    """The same along y, at x = -reach and +reach."""
    reach: tuple[float, float]
    """Of the lines along y in x, and of those along x in y, m."""
    heights: np.ndarray
    ratio: float
    """Of every mode; with `rayleigh` of the first two planar modes."""
    rayleigh: bool = False

    def planar(self) -> Frame:
        """The shear frame in x that a structure file can state."""
        return Frame(self.masses, self.x_lines.sum(axis=1), self.heights, self.ratio)

    def gyration(self) -> np.ndarray:
        """Square of each floor's radius of gyration about its mass centre, m^2."""
        return np.full(self.masses.size, (self.plan[0] ** 2 + self.plan[1] ** 2) / 12.0)

    def mass(self) -> np.ndarray:
        """About the plan's middle, shape (3 n, 3 n)."""
        n = self.masses.size
        out = np.zeros((3 * n, 3 * n))
        for j, (m, (ex, ey), r2) in enumerate(zip(self.masses, self.centre, self.gyration(), strict=True)):
            floor = np.array([[1.0, 0.0, -ey], [0.0, 1.0, ex], [-ey, ex, r2 + ex**2 + ey**2]])
            out[3 * j : 3 * j + 3, 3 * j : 3 * j + 3] = m * floor
        return out

    def stiffness(self) -> np.ndarray:
        """Shape (3 n, 3 n); a line moves with its floor's middle and with the floor's turn times its distance."""
        out = np.zeros((3 * self.masses.size,) * 2)
        for drift, along_x, along_y in zip(drifts(self.masses.size), self.x_lines, self.y_lines, strict=True):
            for side, kx, ky in zip((-1.0, 1.0), along_x, along_y, strict=True):
                for k, line in ((kx, [1.0, 0.0, -side * self.reach[1]]), (ky, [0.0, 1.0, side * self.reach[0]])):
                    bar = np.kron(drift, line)
                    out += k * np.outer(bar, bar)
        return out

    def modes(self) -> tuple[np.ndarray, np.ndarray]:
        """Frequencies in Hz, and shapes of unit modal mass as columns."""
        squared, shapes = eigh(self.stiffness(), self.mass())
        return np.sqrt(squared) / (2.0 * np.pi), shapes

    def damping(self) -> np.ndarray:
        """Shape (3 n, 3 n)."""
        if self.rayleigh:
            a, b = self.planar().rayleigh()
            return a * self.mass() + b * self.stiffness()
        hz, shapes = self.modes()
        momenta = self.mass() @ shapes
        return (momenta * 4.0 * np.pi * self.ratio * hz) @ momenta.T

    def beside_planar_hz(self) -> np.ndarray:
        """Frequencies of the modes that the planar model lacks: all but those which are a planar mode nearly alone."""
        hz, shapes = self.modes()
        planar = eigh(self.planar().stiffness(), np.diag(self.masses))[1]
        embedded = np.kron(planar, np.eye(3)[:, [X]])
        energy = (embedded.T @ self.mass() @ shapes) ** 2
        own, theirs = linear_sum_assignment(-energy)
        return np.delete(hz, theirs[energy[own, theirs] >= _PLANAR])


@dataclass(frozen=True)
class Band:
    """Where forces have their energy; the slopes fall off like a Butterworth filter's, or at once."""

    low_hz: float = 0.0
    high_hz: float = np.inf
    order: float = np.inf

    def gain(self, hz: np.ndarray) -> np.ndarray:
        """Of amplitudes."""
        with np.errstate(divide="ignore", over="ignore"):
            above = (hz / self.high_hz) ** (2.0 * self.order)
            below = (self.low_hz / hz) ** (2.0 * self.order) if self.low_hz > 0.0 else 0.0
        return np.asarray(1.0 / np.sqrt((1.0 + above) * (1.0 + below)))


@dataclass(frozen=True, eq=False)
class Act(Sensors):
    """What is at work in one recording."""

    mass: np.ndarray
    damping: np.ndarray
    stiffness: np.ndarray
    """Shape (N, N): the building's degrees of freedom, then what hangs on them."""
    strength: np.ndarray
    """RMS of the forces and moments, were they white up to half the rate, shape (3 n,)."""
    seen: np.ndarray
    """What each channel sees of the accelerations, shape (n_channels, 3 n)."""
    rate_hz: float
    band: Band = Band()
    line: tuple[int, float, float] | None = None
    """(degree of freedom, Hz, N)"""


def with_building(act: Act, building: Building) -> Act:
    """The same record of another building."""
    return replace(act, mass=building.mass(), damping=building.damping(), stiffness=building.stiffness())


def with_oscillator(act: Act, dof: int, mass: float, hz: float, ratio: float) -> Act:
    """A mass on a spring and a damper, hung on a degree of freedom; no force acts on it and no channel sees it."""
    w = 2.0 * np.pi * hz
    m, c, k = hung((act.mass, act.damping, act.stiffness), dof, mass, mass * w**2, 2.0 * ratio * w * mass)
    return replace(act, mass=m, damping=c, stiffness=k)


@dataclass(frozen=True, eq=False)
class _Poles:
    """Accelerations by forces as a sum over complex poles."""

    pole: np.ndarray
    seen: np.ndarray
    driven: np.ndarray
    direct: np.ndarray

    @classmethod
    def of(cls, act: Act) -> _Poles:
        n = act.mass.shape[0]
        minv = np.linalg.inv(act.mass)
        rows = np.hstack([-minv @ act.stiffness, -minv @ act.damping])
        pole, shape = np.linalg.eig(np.vstack([np.eye(2 * n)[n:], rows]))
        forced = act.strength.size
        driven = np.linalg.solve(shape, np.vstack([np.zeros_like(minv), minv]))[:, :forced]
        eyes = np.hstack([act.seen, np.zeros((len(act.seen), n - act.seen.shape[1]))])
        return cls(pole, eyes @ rows @ shape, driven, (eyes @ minv)[:, :forced])

    def answer(self, hz: np.ndarray, forces: np.ndarray) -> np.ndarray:
        """Spectra of the channels, shape (n_hz, n_channels), under spectra of forces, shape (n_hz, n_forces)."""
        modal = forces @ self.driven.T / (2j * np.pi * hz[:, None] - self.pole)
        return modal @ self.seen.T + forces @ self.direct.T


def forces(act: Act, count: int, level: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Forces in time, shape (count, n_forces)."""
    out = np.empty((count, act.strength.size))
    gain = act.band.gain(rfftfreq(count, 1.0 / act.rate_hz))
    for j, strength in enumerate(act.strength):
        white = strength * rng.standard_normal(count)
        out[:, j] = level * irfft(gain * rfft(white), count)
    return out


def motion(act: Act, drive: np.ndarray) -> np.ndarray:
    """True accelerations at the channels, shape (n, n_channels), under periodic forces, shape (n, n_forces)."""
    poles, count = _Poles.of(act), len(drive)
    hz, spectra = rfftfreq(count, 1.0 / act.rate_hz), rfft(drive, axis=0)
    parts = [slice(at, at + _AT_ONCE) for at in range(0, hz.size, _AT_ONCE)]
    return irfft(np.concatenate([poles.answer(hz[p], spectra[p]) for p in parts]), count, axis=0)


def _tone(act: Act, count: int, phase: float) -> np.ndarray:
    """The stationary answer to the line."""
    if act.line is None:
        return np.zeros((count, len(act.seen)))
    dof, hz, force = act.line
    answer = _Poles.of(act).answer(np.array([hz]), force * np.eye(act.strength.size)[[dof]])
    turns = 2.0 * np.pi * hz * np.arange(count)[:, None] / act.rate_hz + phase
    return np.imag(answer * np.exp(1j * turns))


def point_answer(act: Act, dof: int, hz: float) -> float:
    """Magnitude of a degree of freedom's own acceleration per force there."""
    w = 2.0 * np.pi * hz
    return float(abs(w**2 * np.linalg.inv(act.stiffness + 1j * w * act.damping - w**2 * act.mass)[dof, dof]))


def record(act: Act, duration_s: float, seed: int) -> np.ndarray:
    """Samples of the channels as recorded, shape (n_samples, n_channels), m/s^2."""
    force_rng, noise_rng, other_rng = (np.random.default_rng([seed, 200 + i]) for i in range(3))
    wanted = round(duration_s * act.rate_hz)
    count = next_fast_len(wanted + round(_LEAD_S * act.rate_hz), real=True)
    t = np.arange(count) / act.rate_hz
    course = wander(t[-1] + 1.0, other_rng)
    level = np.interp(t, np.arange(course.size), course)
    moved = motion(act, forces(act, count, level, force_rng))[-wanted:]
    return sensed(act, moved + _tone(act, wanted, other_rng.uniform(0.0, 2.0 * np.pi)), act.rate_hz, noise_rng)
