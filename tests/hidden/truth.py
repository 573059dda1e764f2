"""A structure as it stands, its drawing, and what the sizes of hidden effects refer to."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from drivers.base import SampleBlock
from tests.hidden import world
from tests.hidden.frame import Frame, Motion, motion
from tests.hidden.world import Act

CHANNELS = ("a1", "a2", "a3")
RECORD_S = 1200.0
NOISE = 0.05


@dataclass(frozen=True, eq=False)
class Truth:
    """A structure as it stands, and the drawing that is off by a few percent."""

    frame: Frame
    standing: str
    drawn_masses: np.ndarray
    drawn_stories: np.ndarray
    damping: str
    """What stays of Rayleigh's damping when an effect changes mass or stiffness: ``ratios``, ``factors`` or ``matrix``."""
    noise: str = "alike"
    """Of all channels ``alike``, or ``own``: a share of each channel's RMS in each recording."""
    wind: str = "alike"
    """Its level on all floors ``alike``, or ``apart`` on every floor."""

    def drawing(self) -> str:
        """The structure file."""
        return structure_file(self.drawn_masses, self.drawn_stories, self.frame.heights, (1, 2, 3))

    def healthy_recording(self, seed: int) -> list[SampleBlock]:
        """20 healthy minutes with a thermometer."""
        t = np.arange(RECORD_S)
        degc = 20.0 + 0.3 * np.sin(2.0 * np.pi * t / 700.0)
        return world.blocks(world.record(healthy(self, seed)[0], RECORD_S, seed), degc)

    def summary(self) -> str:
        """What is particular about it."""
        return f"{self.standing}, damping {self.damping}, noise {self.noise}, wind {self.wind}"


def structure_file(masses: np.ndarray, stories: np.ndarray, heights: np.ndarray, floors: Sequence[int]) -> str:
    """A shear frame as drawn, with channels a1, a2, .. on `floors`."""
    lists = {"masses_kg": masses, "stiffness_n_per_m": stories, "story_heights_m": heights}
    rows = "\n".join(f"{k} = [{', '.join(f'{x:.6g}' for x in v)}]" for k, v in lists.items())
    sensors = "\n".join(f'[[sensors]]\nchannel = "a{j + 1}"\nfloor = {floor}' for j, floor in enumerate(floors))
    return f'[structure]\nkind = "shear_frame"\ndamping_ratio = 0.01\n{rows}\n\n{sensors}\n'


_FRAME = Frame(
    np.array([0.3253, 0.3514, 0.3129]), np.array([2900.0, 1700.0, 1900.0]), np.array([0.093, 0.093, 0.1]), 0.01
)
PLAIN = Truth(_FRAME, "none", _FRAME.masses, _FRAME.stories, "ratios")
"""A frame as drawn."""


@dataclass(frozen=True)
class Hidden:
    """One effect: the sealed answer."""

    effect: str
    location: str
    parameters: dict[str, float] = field(default_factory=dict)


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """A number between two."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


@dataclass(frozen=True, eq=False)
class Site:
    """Everything a size may refer to: the truth and its healthy motion under this record's forces."""

    truth: Truth
    motion: Motion | None
    """None for a building, whose forces are not white."""
    act: Act
    rng: np.random.Generator
    duration_s: float
    sizes: Iterator[float] = field(default_factory=lambda: iter(()))
    """Sizes in place of the first ones to be drawn."""

    def matrices(self, frame: Frame) -> Act:
        """The record's act with another frame."""
        mass, damping, stiffness = frame.modal()
        if self.truth.damping == "factors":
            a, b = self.truth.frame.rayleigh()
            damping = a * mass + b * stiffness
        elif self.truth.damping == "matrix":
            damping = self.truth.frame.modal()[1]
        return replace(self.act, mass=mass, damping=damping, stiffness=stiffness)

    def sign(self) -> float:
        return float(self.rng.choice([-1.0, 1.0]))

    def pick(self, *values: float) -> float:
        drawn = float(self.rng.choice(values))
        return next(self.sizes, drawn)

    def within(self, low: float, high: float) -> float:
        """Uniform."""
        drawn = float(self.rng.uniform(low, high))
        return next(self.sizes, drawn)

    def between(self, low: float, high: float) -> float:
        """Log-uniform."""
        drawn = log_uniform(self.rng, low, high)
        return next(self.sizes, drawn)


@lru_cache(maxsize=1)
def draw_truth(seed: int) -> Truth:
    """A frame near the paper's; a quarter have flexible joints, a quarter a mass that the drawing misses.

    Half have noise that follows each channel's motion, a third wind that comes and goes floor by floor.
    """
    rng = np.random.default_rng([seed, 101])
    masses = np.array([0.3253, 0.3514, 0.3129]) * np.exp(0.05 * rng.standard_normal(3))
    stories = np.array([2900.0, 1700.0, 1900.0]) * np.exp(0.1 * rng.standard_normal(3))
    frame = Frame(masses, stories, np.array([0.093, 0.093, 0.1]), float(rng.uniform(0.007, 0.014)))
    drawn_masses = masses * np.exp(0.015 * rng.standard_normal(3))
    drawn_stories = stories * np.exp(0.04 * rng.standard_normal(3))
    standing = str(rng.choice(["none", "none", "joint", "mass"]))
    if standing == "joint":
        frame = replace(frame, joint=frame.girder(15.0))
    elif standing == "mass":
        drawn_masses[rng.integers(3)] *= 0.94
    damping = str(rng.choice(["ratios", "factors", "matrix"]))
    noise, wind = str(rng.choice(["alike", "own"])), str(rng.choice(["alike", "alike", "apart"]))
    return Truth(frame, standing, drawn_masses, drawn_stories, damping, noise, wind)


def healthy(truth: Truth, seed: int) -> tuple[Act, Motion]:
    """A record of the truth alone, with its own unequal forces; noise as of a sensor that stays the same."""
    strength = np.exp(np.random.default_rng([seed, 102]).uniform(-0.26, 0.26, 3))
    moving = motion(truth.frame, strength**2 / world.RATE_HZ, strength**2 * world.DIRECT)
    usual = motion(truth.frame, np.full(3, 1.0 / world.RATE_HZ), np.full(3, world.DIRECT))
    act = world.healthy(truth.frame, strength, NOISE * float(usual.channel.mean()))
    if truth.noise == "own":
        act = replace(act, noise=np.zeros(3), noise_share=NOISE)
    return replace(act, apart=truth.wind == "apart"), moving
