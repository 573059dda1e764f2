"""Trials with buildings in three dimensions, of which the structure file knows the sway in x alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from drivers.base import SampleBlock
from tests.hidden import catalogue, world
from tests.hidden.artefacts import ARTEFACTS
from tests.hidden.building import (
    TURN,
    Act,
    Band,
    Building,
    X,
    forces,
    motion,
    point_answer,
    record,
    with_building,
    with_oscillator,
)  # fmt: skip
from tests.hidden.plans import Plan
from tests.hidden.sensors import ideal
from tests.hidden.truth import RECORD_S, Hidden, Site, log_uniform, structure_file

_USUAL_S = 300.0
"""Of the motion that tells the channels' usual RMS."""
_HIGHEST = (30.0, 0.3)
"""Of the frequencies of tones and oscillators: Hz, and of the sampling rate."""


@dataclass(frozen=True, eq=False)
class Tower:
    """A building as it stands, its sensors, the forces of its site, and its drawing."""

    building: Building
    kind: str
    """A frame of a ``laboratory`` or a ``building``; ``far`` where the drawing is far off."""
    drawn_masses: np.ndarray
    drawn_stories: np.ndarray
    floors: tuple[int, ...]
    """With a sensor, from 1."""
    levers: np.ndarray
    """The sensors' places in y from the plan's middle, m."""
    rate_hz: float
    strength: np.ndarray
    """RMS of the usual force in x, in y and moment on each floor, were they white up to half the rate, shape (n, 3)."""
    band: Band
    noise: float
    """Of a channel's RMS."""
    own_noise: bool
    """Whether the noise is that share of each channel in each record, or stays that of the usual motion."""
    band_set: bool
    """Whether the structure file has the band that suits the structure: not where forces are to end within it."""

    def drawing(self) -> str:
        """The structure file: a planar shear frame, and the band that docs/choosing.md advises for a low first mode."""
        b = self.building
        text = structure_file(self.drawn_masses, self.drawn_stories, b.heights, self.floors)
        hz = replace(b.planar(), masses=self.drawn_masses, stories=self.drawn_stories).hz()
        if hz[0] >= 2.0 or not self.band_set:
            return text
        rate, cutoff = min(100, round(3.5 * hz[-1])), min(40.0, 1.4 * hz[-1])
        return f"{text}\n[processing]\nrate_hz = {rate}\ncutoff_hz = {cutoff:.3g}\n"

    def summary(self) -> str:
        """What is particular about it."""
        b = self.building
        off = np.hypot(*(b.centre / b.plan).T).mean()
        return (
            f"{self.kind}, {b.masses.size} floors, {len(self.floors)} sensors, {self.rate_hz:g} Hz,"
            f" planar {', '.join(f'{f:.2f}' for f in b.planar().hz())} Hz, eccentric {off:.0%},"
            f" y/x {b.y_lines.sum() / b.x_lines.sum():.2f}, damping {b.ratio:.1%}{' Rayleigh' if b.rayleigh else ''},"
            f" forces {self.band.low_hz:.1f} to {self.band.high_hz:.1f} Hz"
        )

    def act(self, level: np.ndarray) -> Act:
        """A record without noise; `level` is of the directions, shape (3,), or of every force, shape (n, 3)."""
        b = self.building
        seen = np.zeros((len(self.floors), b.masses.size, 3))
        at = np.arange(len(self.floors)), np.array(self.floors) - 1
        seen[*at, X], seen[*at, TURN] = 1.0, -self.levers
        return Act(
            b.mass(), b.damping(), b.stiffness(), (self.strength * level).ravel(), seen.reshape(len(seen), -1),
            self.rate_hz, self.band, **vars(ideal(len(self.floors))),
        )  # fmt: skip

    def healthy(self, seed: int, *, every: bool = False) -> tuple[Act, str]:
        """A record of the building alone, with its noise, and the directions that its forces have."""
        rng = np.random.default_rng([seed, 202])
        level, directions = _level(rng, eccentric=bool(self.building.centre.any()), every=every)
        act = self.act(level * np.exp(rng.uniform(-0.26, 0.26, self.strength.shape)))
        if self.own_noise:
            return replace(act, noise_share=self.noise), directions
        return replace(act, noise=np.full(len(self.floors), self.noise * usual_rms(self).mean())), directions

    def healthy_recording(self, seed: int) -> list[SampleBlock]:
        """20 healthy minutes, forced in every direction."""
        return _blocks(self, record(self.healthy(seed, every=True)[0], RECORD_S, seed))


def _level(rng: np.random.Generator, *, eccentric: bool, every: bool) -> tuple[np.ndarray, str]:
    """Relative forces in x, y and about the vertical; one record in four has one direction alone."""
    alone = str(rng.choice(["x", "x", "y"] if eccentric else ["x"]))
    level = np.exp(rng.uniform(np.log(0.3), np.log(3.0), 3))
    level[X] = 1.0
    if every or rng.random() < 0.75:
        return level, f"forces x 1, y {level[1]:.2f}, turn {level[2]:.2f}"
    return np.eye(3)["xy".index(alone)], f"forces in {alone} alone"


@lru_cache(maxsize=4)
def usual_rms(tower: Tower) -> np.ndarray:
    """Of the channels under the usual forces of steady level, m/s^2."""
    act, count = tower.act(np.ones(3)), round(_USUAL_S * tower.rate_hz)
    return motion(act, forces(act, count, np.ones(count), np.random.default_rng(203))).std(axis=0)


def _blocks(tower: Tower, samples: np.ndarray) -> list[SampleBlock]:
    return world.blocks(samples.astype(np.float32), rate_hz=tower.rate_hz)


def draw_building(rng: np.random.Generator, *, laboratory: bool) -> Building:
    """A building of 3 to 8 floors, a quarter symmetrical, half with one mass centre for all floors."""
    n = int(rng.integers(3, 9))
    first_hz = log_uniform(rng, 1.0, 5.0) if laboratory else log_uniform(rng, 0.8, 4.0)
    masses = (5.0 if laboratory else 1e5) * np.exp(0.15 * rng.standard_normal(n))
    width = np.array([0.4, 0.3] if laboratory else [20.0, 15.0]) * np.exp(rng.uniform(-0.3, 0.3, 2))
    chain = masses.mean() * (np.pi * first_hz / np.sin(np.pi / (4 * n + 2))) ** 2
    along_x = chain * np.exp(0.1 * rng.standard_normal(n))
    braced = log_uniform(rng, 1.2, 4.0) ** (1.0 if rng.random() < 0.6 else -1.0)
    along_y = braced * along_x * np.exp(0.1 * rng.standard_normal(n))
    angle, off = rng.uniform(0.0, 2.0 * np.pi, n), rng.uniform(0.0, 0.15, n)
    if rng.random() < 0.5:
        angle, off = np.full(n, angle[0]), np.full(n, off[0])
    if rng.random() < 0.25:
        off = np.zeros(n)
    reach = 0.5 * width * (1.0 if rng.random() < 0.5 else rng.uniform(0.5, 1.0, 2))
    building = Building(
        masses, tuple(width), off[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1) * width,
        np.stack([along_x, along_x], axis=1) / 2.0, np.stack([along_y, along_y], axis=1) / 2.0, tuple(reach),
        np.full(n, 0.2 if laboratory else 3.3), log_uniform(rng, 0.005, 0.02), bool(rng.random() < 0.5),
    )  # fmt: skip
    scale = (first_hz / building.planar().hz()[0]) ** 2
    return replace(building, x_lines=scale * building.x_lines, y_lines=scale * building.y_lines)


def draw_band(rng: np.random.Generator, forces: str, planar_hz: np.ndarray) -> Band:
    """White forces, or some that end within the band, or one and a half to three octaves about the first modes."""
    if forces == "ends":
        return Band(0.0, rng.uniform(12.0, 25.0), float(rng.choice([8.0, 16.0, np.inf])))
    if forces == "narrow":
        low = planar_hz[0] / 2.0 ** rng.uniform(0.2, 0.7)
        return Band(low, low * 2.0 ** rng.uniform(1.5, 3.0), float(rng.choice([4.0, 8.0])))
    return Band()


@lru_cache(maxsize=4)
def draw_tower(seed: int, forces: str) -> Tower:
    """The building of a seed under forces that are ``white``, ``ends`` or ``narrow``."""
    rng = np.random.default_rng([seed, 201])
    laboratory = bool(rng.random() < 0.5)
    b = draw_building(rng, laboratory=laboratory)
    n = b.masses.size
    far = bool(rng.random() < 0.25)
    off = rng.uniform(-0.3, 0.3, n) if far else 0.04 * rng.standard_normal(n)
    drawn_stories = b.planar().stories * (1.0 + off)
    drawn_masses = b.masses * np.exp(0.015 * rng.standard_normal(n))
    floors = tuple(range(1, n + 1)) if rng.random() < 0.5 else tuple(sorted({1, 1 + n // 3, 1 + (2 * n) // 3}))
    places = rng.uniform(-0.4, 0.4, n) if rng.random() < 0.5 else np.full(n, rng.uniform(-0.4, 0.4))
    levers = b.centre[:, 1] + places * 0.5 * b.plan[1]
    accelerated = (0.3 if laboratory else 0.01) * log_uniform(rng, 0.5, 2.0)
    strength = accelerated * b.masses[:, None] * np.stack([np.ones(n), np.ones(n), np.sqrt(b.gyration())], axis=1)
    return Tower(
        b, ("laboratory" if laboratory else "building") + (", far" if far else ""), drawn_masses, drawn_stories,
        floors, levers[np.array(floors) - 1], float(rng.choice([100.0, 128.0, 200.0, 256.0, 512.0])), strength,
        draw_band(np.random.default_rng([seed, 204]), forces, b.planar().hz()), rng.uniform(0.02, 0.05),
        bool(rng.random() < 0.5), forces != "ends",
    )  # fmt: skip


Effect = Callable[[Site], tuple[Hidden, Act]]


def _place(s: Site) -> int:
    return int(s.rng.integers(s.truth.building.masses.size))


def _lost(s: Site, relative: float, sides: np.ndarray) -> tuple[Hidden, Act]:
    """A relative change of the x stiffness of one story, taken from its two lines in these parts."""
    j, b = _place(s), s.truth.building
    lines = b.x_lines.copy()
    lines[j] += relative * lines[j].sum() * sides
    hidden = Hidden("stiffness_change", f"story {j + 1}", {"relative": relative})
    return hidden, with_building(s.act, replace(b, x_lines=lines))


def stiffness_change3d(s: Site) -> tuple[Hidden, Act]:
    """In both lines alike."""
    return _lost(s, -s.pick(0.02, 0.04, 0.08, 0.15), np.full(2, 0.5))


def one_side3d(s: Site) -> tuple[Hidden, Act]:
    """In one of the two lines."""
    return _lost(s, -s.pick(0.02, 0.04, 0.08, 0.15), np.eye(2)[int(s.rng.integers(2))])


def added_mass3d(s: Site) -> tuple[Hidden, Act]:
    """Spread over a floor as its own mass is, so with its rotary inertia."""
    j, b = _place(s), s.truth.building
    mass = s.pick(0.03, 0.06, 0.12) * float(b.masses[j])
    masses = b.masses + mass * np.eye(b.masses.size)[j]
    return Hidden("added_mass", f"floor {j + 1}", {"mass_kg": mass}), with_building(s.act, replace(b, masses=masses))


def sensor_gain3d(s: Site) -> tuple[Hidden, Act]:
    return catalogue.sensor_gain(s)


def sensor_polarity3d(s: Site) -> tuple[Hidden, Act]:
    return catalogue.sensor_polarity(s)


def channel_swap3d(s: Site) -> tuple[Hidden, Act]:
    return catalogue.channel_swap(s)


def time_offset3d(s: Site) -> tuple[Hidden, Act]:
    """Slower structures than the planar simulator's, so larger offsets."""
    return catalogue.time_offset(replace(s, sizes=iter((s.between(2e-3, 12e-3),))))


def _hz(s: Site, low: float) -> float:
    """Between `low` times the first planar frequency and the highest, within the band."""
    planar = s.truth.building.planar().hz()
    return s.between(low * planar[0], min(_HIGHEST[0], _HIGHEST[1] * s.act.rate_hz, 1.2 * planar[-1]))


def harmonic_excitation3d(s: Site) -> tuple[Hidden, Act]:
    """In x at a floor's middle; its size is the line's over the usual RMS, as in the planar simulator."""
    j = _place(s)
    hz, rms = _hz(s, 1.2), s.between(0.1, 1.0) * float(usual_rms(s.truth).mean())
    force = float(np.sqrt(2.0)) * rms / point_answer(s.act, 3 * j + X, hz)
    hidden = Hidden("harmonic_excitation", f"floor {j + 1}", {"frequency_hz": hz, "force_n": force})
    return hidden, replace(s.act, line=(3 * j + X, hz, force))


def attached_oscillator3d(s: Site) -> tuple[Hidden, Act]:
    """In x at a floor's middle."""
    j = _place(s)
    mass = s.between(0.03, 0.1) * float(s.truth.building.masses[j])
    hz, ratio = _hz(s, 0.8), s.between(0.01, 0.05)
    hidden = Hidden(
        "attached_oscillator", f"floor {j + 1}", {"mass_kg": mass, "frequency_hz": hz, "damping_ratio": ratio}
    )
    return hidden, with_oscillator(s.act, 3 * j + X, mass, hz, ratio)


def _clear_loss(s: Site) -> tuple[Hidden, Act]:
    return _lost(s, -0.08, np.full(2, 0.5))


CATALOGUE: dict[str, Effect] = {
    d.__name__: d
    for d in (
        stiffness_change3d, one_side3d, added_mass3d, sensor_gain3d, time_offset3d, sensor_polarity3d, channel_swap3d,
        harmonic_excitation3d, attached_oscillator3d,
    )
}  # fmt: skip
FORCES = {"ends3d": "ends", "ends_loss3d": "ends", "narrow3d": "narrow", "narrow_loss3d": "narrow"}
"""Trials in which baseline and record have forces that are not white."""
FAULTY = {f"{name}{loss}3d": name for name in ARTEFACTS for loss in ("", "_loss")}
"""Trials of which the record, not the baseline, has an artefact."""
NAMES = ("clean3d", "clean3d", "uncalibrated3d", "uncalibrated3d", *CATALOGUE, *FORCES, *FAULTY)
"""One round of trials."""


def structure(seed: int, name: str) -> Tower:
    """The building of a seed, with the forces that a trial wants."""
    return draw_tower(seed, FORCES.get(name, "white"))


def draw(tower: Tower, name: str, seed: int, size: float | None = None) -> Plan:
    """The trial `name`; place, sign and size (its first one, unless it is given) from the seed."""
    act, note = tower.healthy(seed)
    rng = np.random.default_rng([seed, 205])
    site = Site(tower, None, act, rng, RECORD_S, iter(() if size is None else (size,)))
    hidden: tuple[Hidden, ...] = ()
    effect = _clear_loss if "_loss" in name else CATALOGUE.get(name)
    if effect is not None:
        one, act = effect(site)
        hidden = (one,)
    samples = record(act, RECORD_S, seed)
    if name in FAULTY:
        samples, size_text = ARTEFACTS[FAULTY[name]](samples, tower.rate_hz, rng)
        note += f"; {FAULTY[name]}: {size_text}"
    kind = (
        "uncalibrated"
        if name == "uncalibrated3d"
        else "artefact"
        if name in FAULTY
        else "single"
        if hidden
        else "clean"
    )
    known: dict[str, Any] = {
        "lowest": f"story {tower.building.masses.size}",
        "modes_hz": tower.building.beside_planar_hz().tolist(),
        "stories": (tower.building.planar().stories / tower.drawn_stories).tolist(),
    }
    return Plan(kind, hidden, lambda: _blocks(tower, samples), known, note)
