"""Trials on a shaken ground: joints that slip, and what resembles them, with the ground measured and without an input."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.ndimage import gaussian_filter1d

from drivers.base import SampleBlock
from tests.hidden import catalogue, world
from tests.hidden.frame import Frame, Motion, drifts, shaken_motion
from tests.hidden.plans import Plan
from tests.hidden.truth import Hidden, Site, Truth, draw_truth, healthy, log_uniform
from tests.hidden.world import Act

DURATION_S = 400.0
GROUND_RMS = 0.5
"""Of the measured ground at level 1 within half the recorded rate, m/s^2."""
WIND = 0.02
"""Of the floors' forces besides, over the force of the ground on each floor."""


@dataclass(frozen=True, eq=False)
class Shaken:
    """A frame on a shaken ground (or, unheard, in the wind alone)."""

    truth: Truth
    heard: bool
    """Whether the ground shakes and is measured."""
    slips: float = 0.0
    """Share of the stiffness of all stories that slips from the start."""

    def drawing(self) -> str:
        """The structure file."""
        return self.truth.drawing()

    def healthy_recording(self, seed: int) -> list[SampleBlock]:
        """A healthy record."""
        return _blocks(_standing(self, seed)[0], seed)

    def summary(self) -> str:
        """What is particular about it."""
        joints = "joints slip from the start" if self.slips else "no joint slips from the start"
        return f"{self.truth.summary()}, {'ground measured' if self.heard else 'no input measured'}, {joints}"


def slipping(act: Act, frame: Frame, stories: Sequence[int], relative: float, slip_m: float) -> tuple[Hidden, Act]:
    """Let a share of the stiffness of stories slip at a drift."""
    stiffness, laws, n = act.stiffness.copy(), list(act.laws), frame.stories.size
    for j in stories:
        d, share = np.zeros(len(stiffness)), relative * float(frame.stories[j])
        d[:n] = drifts(n)[j]
        stiffness -= share * np.outer(d, d)
        laws.append((world.SLIP, d, share * slip_m, slip_m))
    place = "frame" if len(stories) == n else f"story {stories[0] + 1}"
    force = relative * float(frame.stories[list(stories)].mean()) * slip_m
    hidden = Hidden("hysteretic_slip", place, {"force_n": force, "relative": relative})
    return hidden, replace(act, stiffness=stiffness, laws=tuple(laws))


def slip_story(s: Site) -> tuple[Hidden, Act]:
    j = int(s.rng.integers(3))
    slip_m = s.rng.uniform(0.7, 2.0) * float(s.motion.drift[j])
    return slipping(s.act, s.truth.frame, (j,), s.between(0.05, 0.2), slip_m)


def slip_frame(s: Site) -> tuple[Hidden, Act]:
    slip_m = s.rng.uniform(0.7, 2.0) * float(s.motion.drift.mean())
    return slipping(s.act, s.truth.frame, (0, 1, 2), s.between(0.03, 0.12), slip_m)


def loss(s: Site) -> tuple[Hidden, Act]:
    """5 to 15 % of a story's columns; what slips stays as it is."""
    j, relative = int(s.rng.integers(3)), -s.between(0.05, 0.15)
    frame = s.truth.frame
    moved = s.matrices(replace(frame, stories=frame.stories * (1.0 + relative * np.eye(3)[j])))
    moved = replace(moved, stiffness=moved.stiffness + s.act.stiffness - frame.stiffness())
    return Hidden("stiffness_change", f"story {j + 1}", {"relative": relative}), moved


DRAWS: dict[str, Callable[[Site], tuple[Hidden, Act]]] = {
    "slip_story": slip_story,
    "slip_frame": slip_frame,
    "shaken_cubic": catalogue.cubic_stiffness,
    "shaken_friction": catalogue.coulomb_friction,
    "shaken_contact": catalogue.gap_contact,
    "shaken_crack": catalogue.bilinear_stiffness,
    "shaken_drag": catalogue.quadratic_damping,
    "shaken_loss": loss,
    "loss_while_slipping": loss,
    "slip_unheard": slip_story,
    "slip_frame_unheard": slip_frame,
}
NAMES = (
    *DRAWS, "slip_story", "slip_frame", "loss_while_slipping", "shaken_clean", "clean_while_slipping", "shaken_clean",
)  # fmt: skip
"""One round of trials."""


@lru_cache(maxsize=16)
def structure(seed: int, name: str) -> Shaken:
    """The frame of a seed, alike for every name but for the joints and the input."""
    truth = replace(draw_truth(seed), wind="alike", noise="alike")
    share = log_uniform(np.random.default_rng([seed, 105]), 0.03, 0.1)
    return Shaken(truth, "unheard" not in name, share if "while_slipping" in name else 0.0)


def draw(shaken: Shaken, name: str, seed: int, size: float | None = None) -> Plan:
    """The trial `name`; place, sign and size (its first one, unless it is given) from the seed."""
    act, moving = _standing(shaken, seed)
    sizes = iter(() if size is None else (size,))
    site = Site(shaken.truth, moving, act, np.random.default_rng([seed, 103]), DURATION_S, sizes)
    if "clean" in name:
        return Plan("clean", (), lambda: _blocks(act, seed))
    hidden, act = DRAWS[name](site)
    if shaken.heard:
        return Plan("single", (hidden,), lambda: _blocks(act, seed))
    # Without an input slip is not in the catalogue: what softens or dissipates at its place comes close.
    near = ("cubic_stiffness", "coulomb_friction", "story_damper", "stiffness_change", "quadratic_damping")
    return Plan("outside", tuple(Hidden(e, hidden.location) for e in near), lambda: _blocks(act, seed))


def level(seed: int) -> np.ndarray:
    """Level of the ground once a second: quiet, with three strong motions of 20 to 50 s, two to six times as strong."""
    rng, out = np.random.default_rng([seed, 104]), np.zeros(round(DURATION_S) + 1)
    for i in range(3):
        at = rng.uniform(0.1, 0.7) * DURATION_S / 3.0 + i * DURATION_S / 3.0
        out[round(at) : round(at + rng.uniform(20.0, 50.0))] += log_uniform(rng, 2.0, 6.0)
    return 1.0 + gaussian_filter1d(out, 3.0)


def _standing(shaken: Shaken, seed: int) -> tuple[Act, Motion]:
    """A record of the frame as it was at calibration, and its RMS motion, joints that slip not counted."""
    if not shaken.heard:
        return healthy(shaken.truth, seed)
    course, frame, density = level(seed), shaken.truth.frame, GROUND_RMS**2 / world.RATE_HZ
    usual = shaken_motion(frame, density)
    act = world.healthy(frame, WIND * frame.masses * GROUND_RMS, 0.01 * float(usual.channel.mean()))
    act = replace(act, ground=density, ground_level=course, heard=True)
    if shaken.slips:
        _, act = slipping(act, frame, (0, 1, 2), shaken.slips, 2.0 * float(usual.drift.mean()))
    return act, usual.scaled(float(np.sqrt((course**2).mean())))


def _blocks(act: Act, seed: int) -> list[SampleBlock]:
    samples = world.record(act, DURATION_S, seed)
    return world.shaken_blocks(samples) if act.heard else world.blocks(samples)
