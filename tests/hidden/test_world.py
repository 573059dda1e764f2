"""The other simulator against the project's own: the same forces must move both alike; and against the sizes it promises."""

from __future__ import annotations

import numpy as np
import pytest

from monitor.model import Model, ShearFrame, parse_effect
from monitor.model.simulation import respond
from tests.hidden import catalogue, shaken, world
from tests.hidden.frame import Frame, drifts
from tests.hidden.truth import Site, Truth, healthy

FRAME = Frame(
    np.array([0.3253, 0.3514, 0.3129]), np.array([2900.0, 1700.0, 1900.0]), np.array([0.093, 0.093, 0.1]), 0.01
)
TRUTH = Truth(FRAME, "none", FRAME.masses, FRAME.stories, "ratios")
OURS = ShearFrame(FRAME.masses, FRAME.stories, FRAME.ratio, FRAME.heights)
N = 8 * round(world.KNOT_HZ)


def _site() -> Site:
    act, motion = healthy(TRUTH, 1)
    return Site(TRUTH, motion, act, np.random.default_rng(3), 8.0)


def _drive() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    forces = 2.0 * rng.standard_normal((N, 3))
    forces[0] = 0.0
    ground = rng.standard_normal(N)
    ground[0] = 0.0
    return forces, ground, 10.0 * np.arange(N) / N


def _theirs(act: world.Act, forces: np.ndarray, ground: np.ndarray, course: np.ndarray) -> np.ndarray:
    size = act.mass.shape[0]
    drive = np.zeros((N, size + 2))
    drive[:, :3], drive[:, size] = forces, ground
    if act.course is not None:
        drive[:, size + 1] = course
    seen, _ = world._march(
        np.linalg.inv(act.mass), act.damping, act.stiffness,
        np.zeros((size, size)) if act.moving is None else act.moving,
        np.array([law[0] for law in act.laws], dtype=np.int64),
        np.array([law[1] for law in act.laws], dtype=float).reshape(-1, size),
        np.array([law[2:] for law in act.laws], dtype=float).reshape(-1, 2),
        drive, np.zeros(2 * size + len(act.laws)), 1.0 / world.KNOT_HZ, 3,
    )  # fmt: skip
    return seen


MATRICES = (
    "stiffness_change", "uniform_change", "added_mass", "uniform_mass", "gravity_softening", "joint_flexibility",
)  # fmt: skip
LAWS = ("gap_contact", "bilinear_stiffness", "quadratic_damping", "story_damper", "attached_oscillator")


@pytest.mark.engine
@pytest.mark.parametrize("name", ["healthy", *MATRICES, *LAWS])
def test_both_simulators_move_alike(name: str) -> None:
    forces, ground, course = _drive()
    site = _site()
    model, act = Model(OURS), site.act
    if name != "healthy":
        hidden, act = catalogue.CATALOGUE[name](site)
        values = ",".join(f"{k}={v!r}" for k, v in hidden.parameters.items())
        model = Model(OURS, (parse_effect(f"{hidden.effect}:{hidden.location}:{values}"),))
    ours = respond(model, forces, ground, world.KNOT_HZ)[1:]
    theirs = _theirs(act, forces, ground, course)
    assert np.sqrt(((ours - theirs) ** 2).mean() / (ours**2).mean()) < 1e-3


def test_a_warming_frame_softens_alike() -> None:
    forces, ground, course = _drive()
    site = _site()
    act = site.matrices(FRAME)
    act = world.replace(act, moving=act.stiffness, course=1e-3 * course)
    model = Model(OURS, (parse_effect("temperature_stiffness:frame:per_degc=1e-3,lag_s=0"),))
    ours = respond(model, forces, ground, world.KNOT_HZ, course)[1:]
    theirs = _theirs(act, forces, ground, 1e-3 * course)
    assert np.sqrt(((ours - theirs) ** 2).mean() / (ours**2).mean()) < 1e-3


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_small_cubic_terms_agree_to_third_order(sign: float) -> None:
    forces, ground, course = _drive()
    k3 = sign * 2e7
    act = catalogue._law(_site(), drifts(3)[1], world.CUBIC, k3, float(np.sqrt(0.9 * 1700.0 / abs(k3))))
    ours = respond(Model(OURS, (parse_effect(f"cubic_stiffness:story 2:k3_n_per_m3={k3}"),)), forces, ground, 4096.0)[
        1:
    ]
    plain = _theirs(_site().act, forces, ground, course)
    theirs = _theirs(act, forces, ground, course)
    assert np.abs(ours - theirs).max() < 0.02 * np.abs(ours - plain).max()


@pytest.mark.parametrize("stories", [(1,), (0, 1, 2)])
def test_joints_that_slip_move_alike(stories: tuple[int, ...]) -> None:
    forces, ground, course = _drive()
    hidden, act = shaken.slipping(_site().act, FRAME, stories, 0.2, 3e-3)
    values = ",".join(f"{k}={v!r}" for k, v in hidden.parameters.items())
    model = Model(OURS, (parse_effect(f"{hidden.effect}:{hidden.location}:{values}"),))
    ours = respond(model, forces, ground, world.KNOT_HZ)[1:]
    plain, theirs = _theirs(_site().act, forces, ground, course), _theirs(act, forces, ground, course)
    assert ((ours - theirs) ** 2).mean() < 1e-3 * ((ours - plain) ** 2).mean()


def test_a_footing_on_a_spring_is_a_softer_lowest_story() -> None:
    forces, _, course = _drive()
    hidden, act = catalogue.base_flexibility(_site())
    k = hidden.parameters["stiffness_n_per_m"]
    soft = 1.0 / (1.0 / FRAME.stories[2] + 1.0 / k)
    series = _site().matrices(Frame(FRAME.masses, np.array([*FRAME.stories[:2], soft]), FRAME.heights, FRAME.ratio))
    quiet = np.zeros(N)
    series, plain = _theirs(series, forces, quiet, course), _theirs(_site().act, forces, quiet, course)
    footing = _theirs(act, forces, quiet, course)
    assert ((footing - series) ** 2).mean() < 0.05 * ((footing - plain) ** 2).mean()


@pytest.mark.engine
def test_recorded_motion_is_as_the_sizes_assume(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(world, "wander", lambda duration_s, rng: np.ones(round(duration_s) + 2))
    act, motion = healthy(TRUTH, 1)
    samples = world.record(act, 240.0, 4)[10 * 1024 :]
    assert samples.std(axis=0) == pytest.approx(np.hypot(motion.channel, act.noise), rel=0.04)
    _, shaken = catalogue.base_excitation(_site())
    shaken = world.record(shaken, 240.0, 4)[10 * 1024 :]
    share = 1.0 - ((samples.var(axis=0) - act.noise**2) / (shaken.var(axis=0) - act.noise**2)).mean()
    assert share == pytest.approx(catalogue.base_excitation(_site())[0].parameters["share"], abs=0.05)


def test_the_level_wanders_as_stated() -> None:
    level = world.wander(400_000.0, np.random.default_rng(2))
    assert (level**2).mean() == pytest.approx(1.0, rel=0.05)
    assert level.std() / level.mean() == pytest.approx(0.35, rel=0.05)


def test_sensors_do_what_they_are_told() -> None:
    act, _ = healthy(TRUTH, 1)
    quiet = world.replace(act, noise=np.zeros(3))
    plain = world.record(quiet, 30.0, 4)
    late = world.record(world.replace(quiet, delay_s=np.array([0.0, 4.0 / 1024.0, 0.0])), 30.0, 4)
    assert late[1000:2000, 1] == pytest.approx(plain[996:1996, 1], abs=1e-3)
    assert late[:, 0] == pytest.approx(plain[:, 0])
    swapped = world.record(world.replace(quiet, order=(2, 1, 0), limit=np.array([np.inf, 1.0, np.inf])), 30.0, 4)
    assert (swapped[:, 0] == plain[:, 2]).all()
    assert np.abs(swapped[:, 1]).max() == 1.0


def test_a_fast_clock_makes_tones_slow() -> None:
    act, _ = healthy(TRUTH, 1)
    tone = world.replace(act, strength=np.zeros(3), line=(0, 11.0, 1.0), clock=0.01, noise=np.zeros(3))
    x = world.record(tone, 120.0, 4)[20 * 1024 :, 0]
    hz = np.fft.rfftfreq(8 * x.size, 1.0 / 1024.0)[np.abs(np.fft.rfft(x * np.hanning(x.size), 8 * x.size)).argmax()]
    assert hz == pytest.approx(11.0 / 1.01, abs=2e-3)
