"""Every effect of the contract at a place and size that a seed draws, as an `Act` of the other simulator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations

import numpy as np

from tests.hidden import world
from tests.hidden.frame import answer, drifts
from tests.hidden.truth import CHANNELS, Hidden, Site
from tests.hidden.world import Act

Draw = Callable[[Site], tuple[Hidden, Act]]


def _story(s: Site) -> int:
    return int(s.rng.integers(3))


def stiffness_change(s: Site, story: int | None = None, everywhere: bool = False) -> tuple[Hidden, Act]:
    relative = (-1.0 if s.rng.random() < 0.75 else 1.0) * s.pick(0.02, 0.04, 0.08, 0.15)
    j = _story(s) if story is None else story
    stories = s.truth.frame.stories * (1.0 + relative * (np.ones(3) if everywhere else np.eye(3)[j]))
    place = "frame" if everywhere else f"story {j + 1}"
    frame = (
        s.truth.frame if not everywhere else replace(s.truth.frame, joint=_scaled(s.truth.frame.joint, 1.0 + relative))
    )
    return Hidden("stiffness_change", place, {"relative": relative}), s.matrices(replace(frame, stories=stories))


def _scaled(joint: float | None, factor: float) -> float | None:
    return None if joint is None else joint * factor


def uniform_change(s: Site) -> tuple[Hidden, Act]:
    return stiffness_change(s, everywhere=True)


def added_mass(s: Site) -> tuple[Hidden, Act]:
    j, frame = _story(s), s.truth.frame
    mass = s.pick(0.03, 0.06, 0.12) * float(frame.masses[j])
    moved = s.matrices(replace(frame, masses=frame.masses + mass * np.eye(3)[j]))
    return Hidden("added_mass", f"floor {j + 1}", {"mass_kg": mass}), moved


def uniform_mass(s: Site) -> tuple[Hidden, Act]:
    relative = s.pick(0.03, 0.06, 0.12)
    moved = s.matrices(replace(s.truth.frame, masses=s.truth.frame.masses * (1.0 + relative)))
    return Hidden("added_mass", "frame", {"relative": relative}), moved


def temperature(s: Site, measured: bool = True) -> tuple[Hidden, Act]:
    """With a channel: two hours in which it warms or cools; without: a day warmer than the baseline's."""
    per_degc = s.sign() * s.between(5e-4, 2e-3)
    lag_s = float(s.rng.choice([0.0, s.rng.uniform(120.0, 1200.0)])) if measured else 0.0
    t = np.arange(round(s.duration_s) + 1)
    swing = s.sign() * s.rng.uniform(10.0, 16.0)
    if measured:
        excess = swing * 0.5 * (1.0 - np.cos(np.pi * t / t[-1])) + np.sin(2.0 * np.pi * t / 2400.0)
    else:
        excess = np.full(t.size, swing)
    lagged = excess.copy()
    if lag_s:
        for i in range(1, t.size):
            lagged[i] = lagged[i - 1] + (1.0 - np.exp(-1.0 / lag_s)) * (excess[i] - lagged[i - 1])
    measured_degc = 20.0 + excess + 0.02 * s.rng.standard_normal(t.size) if measured else None
    act = replace(s.act, moving=s.act.stiffness, course=per_degc * lagged, degc=measured_degc)
    return Hidden("temperature_stiffness", "frame", {"per_degc": per_degc, "lag_s": lag_s}), act


def warm_day(s: Site) -> tuple[Hidden, Act]:
    return temperature(s, measured=False)


def with_law(s: Site, direction: np.ndarray, kind: int, p: float, q: float) -> Act:
    return replace(s.act, laws=(*s.act.laws, (kind, direction, p, q)))


def cubic_stiffness(s: Site) -> tuple[Hidden, Act]:
    j = _story(s)
    k, sd = float(s.truth.frame.stories[j]), float(s.motion.drift[j])
    k3 = s.sign() * s.between(0.02, 0.1) * k / (3.0 * sd**2)
    act = with_law(s, drifts(3)[j], world.CUBIC, k3, float(np.sqrt(0.9 * k / abs(k3))))
    return Hidden("cubic_stiffness", f"story {j + 1}", {"k3_n_per_m3": k3}), act


def gap_contact(s: Site) -> tuple[Hidden, Act]:
    j = _story(s)
    gap = s.sign() * s.rng.uniform(1.2, 2.2) * float(s.motion.drift[j])
    contact = s.between(0.5, 2.0) * float(s.truth.frame.stories[j])
    parameters = {"gap_m": gap, "contact_stiffness_n_per_m": contact}
    return Hidden("gap_contact", f"story {j + 1}", parameters), with_law(s, drifts(3)[j], world.CONTACT, gap, contact)


def bilinear_stiffness(s: Site) -> tuple[Hidden, Act]:
    j, drop = _story(s), s.pick(0.1, 0.2, 0.3)
    act = with_law(s, drifts(3)[j], world.CONTACT, 0.0, -drop * float(s.truth.frame.stories[j]))
    return Hidden("bilinear_stiffness", f"story {j + 1}", {"relative_drop": drop}), act


def coulomb_friction(s: Site) -> tuple[Hidden, Act]:
    j = _story(s)
    force = s.between(0.02, 0.1) * float(s.motion.story_force[j])
    act = with_law(s, drifts(3)[j], world.FRICTION, force, 0.01 * float(s.motion.drift_velocity[j]))
    return Hidden("coulomb_friction", f"story {j + 1}", {"friction_force_n": force}), act


def quadratic_damping(s: Site) -> tuple[Hidden, Act]:
    j = _story(s)
    own = float(s.act.damping[j, j])
    c2 = s.between(0.3, 2.0) * own / float(np.sqrt(8.0 / np.pi) * s.motion.floor_velocity[j])
    return Hidden("quadratic_damping", f"floor {j + 1}", {"coefficient_n_s2_per_m2": c2}), with_law(
        s, np.eye(3)[j], world.DRAG, c2, 0.0
    )


def story_damper(s: Site) -> tuple[Hidden, Act]:
    j, c = _story(s), s.between(0.4, 2.0)
    act = replace(s.act, damping=s.act.damping + c * np.outer(drifts(3)[j], drifts(3)[j]))
    return Hidden("story_damper", f"story {j + 1}", {"damping_n_s_per_m": c}), act


def base_flexibility(s: Site) -> tuple[Hidden, Act]:
    """A footing of its own on the spring, light enough to swing at six times the highest mode."""
    frame = s.truth.frame
    k = s.between(8.0, 30.0) * float(frame.stories[2])
    one = np.ones((3, 1))
    carry = np.hstack([np.eye(3), -one])
    stiffness = carry.T @ s.act.stiffness @ carry
    stiffness[3, 3] += k
    mass = np.diag([*np.diag(s.act.mass), stiffness[3, 3] / (2.0 * np.pi * 6.0 * frame.hz()[-1]) ** 2])
    a, b = frame.rayleigh()
    damping = carry.T @ (b * s.act.stiffness) @ carry + np.diag([*(a * np.diag(s.act.mass)), 0.0])
    act = replace(s.act, mass=mass, damping=damping, stiffness=stiffness)
    return Hidden("base_flexibility", "base", {"stiffness_n_per_m": k}), act


def gravity_softening(s: Site) -> tuple[Hidden, Act]:
    factor = s.within(0.6, 2.4)
    return Hidden("gravity_softening", "frame", {"factor": factor}), s.matrices(replace(s.truth.frame, lean=factor))


def joint_flexibility(s: Site) -> tuple[Hidden, Act]:
    """The size is sealed where the healthy frame's joints were stiff: elsewhere only their change is to be found."""
    ratio, frame = s.between(1.5, 10.0), s.truth.frame
    size = {"girder_to_column_ratio": ratio} if frame.joint is None else {}
    return Hidden("joint_flexibility", "frame", size), s.matrices(replace(frame, joint=frame.girder(ratio)))


def attached_oscillator(s: Site) -> tuple[Hidden, Act]:
    j = _story(s)
    mass = s.between(0.03, 0.1) * float(s.truth.frame.masses[j])
    hz, ratio = s.between(6.0, 25.0), s.between(0.01, 0.05)
    w = 2.0 * np.pi * hz
    parameters = {"mass_kg": mass, "frequency_hz": hz, "damping_ratio": ratio}
    act = world.with_dof(s.act, j, mass, mass * w**2, 2.0 * ratio * w * mass)
    return Hidden("attached_oscillator", f"floor {j + 1}", parameters), act


def harmonic_excitation(s: Site) -> tuple[Hidden, Act]:
    j = _story(s)
    near = float(s.rng.choice(s.truth.frame.hz())) * (1.0 + s.rng.uniform(-0.02, 0.02))
    hz = near if s.rng.random() < 0.3 and near > 6.0 else s.rng.uniform(6.0, 30.0)
    rms = s.between(0.1, 1.0) * float(s.motion.channel[j])
    force = float(np.sqrt(2.0)) * rms / answer(s.truth.frame, j, hz)
    parameters = {"frequency_hz": hz, "force_n": force}
    return Hidden("harmonic_excitation", f"floor {j + 1}", parameters), replace(s.act, line=(j, hz, force))


def coloured_excitation(s: Site) -> tuple[Hidden, Act]:
    corner = s.between(4.0, 20.0)
    return Hidden("coloured_excitation", "frame", {"corner_hz": corner}), replace(s.act, corner_hz=corner)


def base_excitation(s: Site) -> tuple[Hidden, Act]:
    share = s.within(0.2, 0.9)
    by_force, by_ground = s.motion.channel**2, s.motion.ground_variance
    trial = np.exp(np.linspace(-25.0, 25.0, 20001)) * by_force.mean() / by_ground.mean()
    shares = (trial[:, None] * by_ground / (trial[:, None] * by_ground + by_force)).mean(axis=1)
    return Hidden("base_excitation", "base", {"share": share}), replace(
        s.act, ground=float(np.interp(share, shares, trial))
    )


def _channel(s: Site) -> int:
    return int(s.rng.integers(s.act.gain.size))


def _only(s: Site, j: int, value: float) -> np.ndarray:
    return value * np.eye(s.act.gain.size)[j]


def sensor_gain(s: Site) -> tuple[Hidden, Act]:
    j, gain = _channel(s), 1.0 + s.sign() * s.pick(0.02, 0.05, 0.1)
    changed = s.act.gain + _only(s, j, gain - 1.0)
    return Hidden("sensor_gain", f"channel a{j + 1}", {"gain": gain}), replace(s.act, gain=changed)


def sensor_polarity(s: Site) -> tuple[Hidden, Act]:
    j = _channel(s)
    return Hidden("sensor_polarity", f"channel a{j + 1}"), replace(s.act, gain=s.act.gain - _only(s, j, 2.0))


def channel_swap(s: Site) -> tuple[Hidden, Act]:
    pairs = list(combinations(range(s.act.gain.size), 2))
    a, b = pairs[int(s.rng.integers(len(pairs)))]
    order = list(s.act.order)
    order[a], order[b] = b, a
    return Hidden("channel_swap", f"channel a{a + 1},a{b + 1}"), replace(s.act, order=tuple(order))


def time_offset(s: Site) -> tuple[Hidden, Act]:
    j, seconds = _channel(s), s.sign() * s.between(5e-4, 5e-3)
    hidden = Hidden("time_offset", f"channel a{j + 1}", {"seconds": seconds})
    return hidden, replace(s.act, delay_s=_only(s, j, seconds))


def clock_rate(s: Site) -> tuple[Hidden, Act]:
    relative = s.sign() * s.between(1e-3, 2e-2)
    return Hidden("clock_rate", "frame", {"relative": relative}), replace(s.act, clock=relative)


def sensor_clipping(s: Site) -> tuple[Hidden, Act]:
    j = _channel(s)
    limit = s.within(1.5, 2.5) * float(s.motion.channel[j])
    return Hidden("sensor_clipping", f"channel {CHANNELS[j]}", {"limit_m_s2": limit}), replace(
        s.act, limit=np.where(np.arange(3) == j, limit, np.inf)
    )


def sensor_noise(s: Site) -> tuple[Hidden, Act]:
    j = _channel(s)
    rms = s.between(0.15, 0.6) * float(s.motion.channel[j])
    return Hidden("sensor_noise", f"channel {CHANNELS[j]}", {"rms_m_s2": rms}), replace(
        s.act, noise=np.sqrt(s.act.noise**2 + rms**2 * np.eye(3)[j])
    )


CATALOGUE: dict[str, Draw] = {
    d.__name__: d
    for d in (
        stiffness_change, uniform_change, added_mass, uniform_mass, temperature, warm_day, cubic_stiffness, gap_contact,
        bilinear_stiffness, coulomb_friction, quadratic_damping, story_damper, base_flexibility, gravity_softening,
        joint_flexibility, attached_oscillator, harmonic_excitation, coloured_excitation, base_excitation, sensor_gain,
        sensor_polarity, channel_swap, time_offset, clock_rate, sensor_clipping, sensor_noise,
    )
}  # fmt: skip
