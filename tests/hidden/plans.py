"""Trials: one effect, two at once, none, or something that is in no catalogue."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from drivers.base import SampleBlock
from tests.hidden import world
from tests.hidden.catalogue import CATALOGUE, stiffness_change
from tests.hidden.frame import drifts
from tests.hidden.judge import FAULT
from tests.hidden.truth import CHANNELS, RECORD_S, Hidden, Site, Truth, draw_truth, healthy
from tests.hidden.world import Act

TEMPERATURE_S = 7200.0
FIRST = ("stiffness_change", "added_mass", "story_damper", "cubic_stiffness", "coulomb_friction")
SECOND = (
    "sensor_gain", "time_offset", "sensor_noise", "harmonic_excitation", "base_excitation", "attached_oscillator",
)  # fmt: skip
"""Pairs take one of each."""


@dataclass(frozen=True, eq=False)
class Plan:
    """One trial: what is hidden and how the recording is made."""

    kind: str
    """``single``, ``pair``, ``clean``, ``outside``, ``uncalibrated`` or ``artefact``."""
    hidden: tuple[Hidden, ...]
    recording: Callable[[], list[SampleBlock]]
    known: dict[str, Any] = field(default_factory=dict)
    """What the judge knows besides: ``lowest``, the lowest story; ``modes_hz``, true modes that the structure file lacks."""
    note: str = ""
    """What else is particular about this recording."""


Outside = Callable[[Site], tuple[tuple[Hidden, ...], Act]]
"""The first are answers of the catalogue that come close and are not held wrong."""


def _loss(s: Site, course: np.ndarray) -> tuple[tuple[Hidden, ...], Act]:
    j = int(s.rng.integers(3))
    d = drifts(3)[j]
    close = (Hidden("stiffness_change", f"story {j + 1}"), *((Hidden("base_flexibility", "base"),) if j == 2 else ()))
    return close, replace(s.act, moving=float(s.truth.frame.stories[j]) * np.outer(d, d), course=course)


def drifting_stiffness(s: Site) -> tuple[tuple[Hidden, ...], Act]:
    return _loss(s, -s.between(0.05, 0.2) * np.linspace(0.0, 1.0, round(s.duration_s) + 1))


def sudden_loss(s: Site) -> tuple[tuple[Hidden, ...], Act]:
    t = np.linspace(0.0, 1.0, round(s.duration_s) + 1)
    return _loss(s, -s.between(0.05, 0.2) * (t > s.rng.uniform(0.3, 0.7)))


def impacts(s: Site) -> tuple[tuple[Hidden, ...], Act]:
    return (), replace(s.act, impacts=(int(s.rng.integers(3)), s.between(0.05, 0.2), s.rng.uniform(3.0, 6.0)))


def run_up(s: Site) -> tuple[tuple[Hidden, ...], Act]:
    return (), replace(s.act, chirp=(int(s.rng.integers(3)), 3.0, 32.0, s.between(0.1, 0.5)))


def swinging_gain(s: Site) -> tuple[tuple[Hidden, ...], Act]:
    j = int(s.rng.integers(3))
    close = tuple(Hidden(effect, f"channel {CHANNELS[j]}") for effect in (FAULT, "sensor_gain"))
    return close, replace(s.act, gain_swing=s.between(0.1, 0.4) * np.eye(3)[j])


def rattle(s: Site) -> tuple[tuple[Hidden, ...], Act]:
    """A loose part between two stops on a floor."""
    j = int(s.rng.integers(3))
    mass = s.between(0.05, 0.15) * float(s.truth.frame.masses[j])
    act = world.with_dof(s.act, j, mass, mass * (2.0 * np.pi) ** 2, 0.02 * mass * 2.0 * np.pi)
    link = np.zeros(act.mass.shape[0])
    link[j], link[-1] = -1.0, 1.0
    play, stop = s.rng.uniform(0.3, 1.0) * float(s.motion.drift.mean()), mass * (2.0 * np.pi * 60.0) ** 2
    laws = tuple((world.CONTACT, link, sign * play, stop) for sign in (1.0, -1.0))
    return (), replace(act, laws=(*act.laws, *laws))


def dropouts(s: Site) -> tuple[tuple[Hidden, ...], Act]:
    j = int(s.rng.integers(3))
    close = tuple(Hidden(effect, f"channel {CHANNELS[j]}") for effect in (FAULT, "sensor_gain"))
    return close, replace(s.act, dropouts=s.between(1.0, 6.0) * np.eye(3)[j])


OUTSIDE: dict[str, Outside] = {
    d.__name__: d for d in (drifting_stiffness, sudden_loss, impacts, run_up, swinging_gain, rattle, dropouts)
}
NAMES = (*CATALOGUE, *OUTSIDE, *("pair",) * 5, *("clean",) * 4)
"""One round of trials."""


def structure(seed: int, name: str) -> Truth:
    """The frame of a seed, alike for every name."""
    return draw_truth(seed)


def draw(truth: Truth, name: str, seed: int, size: float | None = None) -> Plan:
    """The trial `name`; place, sign and size (its first one, unless it is given) from the seed."""
    site = site_of(truth, seed, size, TEMPERATURE_S if name == "temperature" else RECORD_S)
    kind, hidden, act = _drawn(site, name)
    return Plan(kind, hidden, lambda: world.blocks(world.record(act, site.duration_s, seed), act.degc))


def site_of(truth: Truth, seed: int, size: float | None, duration_s: float = RECORD_S) -> Site:
    """Where an effect of a trial is hidden."""
    act, motion = healthy(truth, seed)
    sizes = iter(() if size is None else (size,))
    return Site(truth, motion, act, np.random.default_rng([seed, 103]), duration_s, sizes)


def _drawn(site: Site, name: str) -> tuple[str, tuple[Hidden, ...], Act]:
    if name == "clean":
        return "clean", (), site.act
    if name in OUTSIDE:
        return "outside", *OUTSIDE[name](site)
    if name != "pair":
        hidden, act = CATALOGUE[name](site)
        return "single", (hidden,), act
    first, second = str(site.rng.choice(FIRST)), str(site.rng.choice(SECOND))
    if first == "stiffness_change":  # of the lowest story is a base's tie
        one, act = stiffness_change(site, int(site.rng.integers(2)))
    else:
        one, act = CATALOGUE[first](site)
    other, act = CATALOGUE[second](replace(site, act=act))
    return "pair", (one, other), act
