"""The project's simulation against the other simulator, of `tests/hidden`: the same forces must move both alike."""

from __future__ import annotations

import numpy as np
import pytest

from monitor.model import Model, ShearFrame, parse_effect
from monitor.model.simulation import respond
from tests.hidden import catalogue, shaken, world
from tests.hidden.frame import Frame, drifts
from tests.hidden.truth import PLAIN, Site, healthy

FRAME = PLAIN.frame
OURS = ShearFrame(FRAME.masses, FRAME.stories, FRAME.ratio, FRAME.heights)
N = 8 * round(world.KNOT_HZ)


def _site() -> Site:
    act, motion = healthy(PLAIN, 1)
    return Site(PLAIN, motion, act, np.random.default_rng(3), 8.0)


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
    seen, _ = world.march(
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
    act = catalogue.with_law(_site(), drifts(3)[1], world.CUBIC, k3, float(np.sqrt(0.9 * 1700.0 / abs(k3))))
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
