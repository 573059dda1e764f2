"""Buildings: floors that move along x and y and turn, on storeys counted from the ground."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from monitor.config import Configuration
from monitor.model import Building, Model, ShearFrame, parse_effect, simulate
from monitor.model.structures.building import frames_at_edges
from tests.support.samples import Cli

N = 3
MASSES = np.array([1.2e5, 1e5, 0.9e5])
ALONG_X, ALONG_Y = np.array([9e7, 8e7, 7e7]), np.array([6e7, 5.5e7, 5e7])
PLAN = np.tile([20.0, 12.0], (N, 1))
TURN = frames_at_edges(ALONG_X, ALONG_Y, PLAN)
SYMMETRIC = Building(MASSES, np.concatenate([ALONG_X, ALONG_Y, TURN]), 0.01, PLAN, np.zeros((N, 2)))


def hz(structure: Building | ShearFrame) -> np.ndarray:
    return Model(structure).modes().frequencies_hz


def test_a_symmetric_building_is_two_frames_and_a_shaft() -> None:
    radius = np.sqrt((20.0**2 + 12.0**2) / 12.0)
    alone = [
        hz(ShearFrame(MASSES[::-1], ALONG_X[::-1], 0.01)),
        hz(ShearFrame(MASSES[::-1], ALONG_Y[::-1], 0.01)),
        hz(ShearFrame(MASSES[::-1] * radius**2, TURN[::-1], 0.01)),
    ]
    np.testing.assert_allclose(hz(SYMMETRIC), np.sort(np.concatenate(alone)), rtol=1e-10)


def test_one_storey_with_eccentricity_has_the_frequencies_of_the_textbook() -> None:
    """Coupling along y with torsion by an eccentricity e along x: (wy^2 - w^2)(wt^2 - w^2 (1 + e^2/r^2)) = w^4 e^2/r^2."""
    m, ky, kt, e = 1e5, 4e7, 2.5e9, 1.5
    plan = np.array([[16.0, 10.0]])
    r2 = float((plan**2).sum() / 12.0)
    one = Building(np.array([m]), np.array([9e7, ky, kt]), 0.01, plan, np.array([[e, 0.0]]))
    wy2, wt2, share = ky / m, kt / (m * r2), e**2 / r2
    squared = np.roots([1.0, -(wt2 + wy2 * (1.0 + share)), wy2 * wt2])
    expected = np.sort(np.sqrt([9e7 / m, *squared])) / (2.0 * np.pi)
    np.testing.assert_allclose(hz(one), expected, rtol=1e-10)


def test_a_sensor_sees_the_rotation_by_its_place() -> None:
    moved = np.zeros(3 * N)
    moved[[1, 4, 7]] = 0.003, -0.002, 1e-4 * SYMMETRIC.gyration_m[1]
    assert SYMMETRIC.sensor_row(2, "x", (5.0, -3.0)) @ moved == pytest.approx(0.003 + 3.0 * 1e-4)
    assert SYMMETRIC.sensor_row(2, "y", (5.0, -3.0)) @ moved == pytest.approx(-0.002 + 5.0 * 1e-4)
    assert not (SYMMETRIC.sensor_row(1, "y", (5.0, -3.0)) @ moved).any()


FILE = """
[structure]
kind = "building"
name = "tower"
"""
for _m, _x, _y in zip(MASSES, ALONG_X, ALONG_Y, strict=True):
    FILE += (
        f"[[storeys]]\nmass_kg = {_m}\nplan_m = [20.0, 12.0]\nstiffness_x_n_per_m = {_x}\nstiffness_y_n_per_m = {_y}\n"
    )


def sensors(axes: str, at: tuple[float, float] = (0.0, 0.0)) -> str:
    rows = [(floor, axis) for floor in range(1, N + 1) for axis in axes]
    return "".join(
        f'[[sensors]]\nchannel = "{axis}{floor}"\nfloor = {floor}\naxis = "{axis}"\nposition_m = [{at[0]}, {at[1]}]\n'
        for floor, axis in rows
    )


def configuration(text: str) -> Configuration:
    return Configuration.model_validate(tomllib.loads(text))


@pytest.mark.parametrize(("axis", "stiffness"), [("x", ALONG_X), ("y", ALONG_Y)])
def test_sensors_along_one_axis_reduce_it_to_a_frame(axis: str, stiffness: np.ndarray) -> None:
    site = configuration(FILE + sensors(axis)).instrumented()
    frame = Model(ShearFrame(MASSES[::-1], stiffness[::-1], 0.01))
    np.testing.assert_allclose(site.model.modes().frequencies_hz, frame.modes().frequencies_hz, rtol=1e-12)
    wanted = simulate(frame, duration_s=20.0, rate_hz=50.0, excitation="impulse").floors[:, ::-1]
    moved = simulate(site.model, duration_s=20.0, rate_hz=50.0, excitation="impulse", context=site.context(50.0)).floors
    np.testing.assert_allclose(moved, wanted, atol=1e-9 * np.abs(wanted).max())
    assert site.model.structure.story_places == tuple(f"storey {j} {axis}" for j in (1, 2, 3))


@pytest.mark.parametrize("more", [sensors("xy"), sensors("y", (4.0, 0.0))])
def test_two_axes_or_a_lever_keep_all_directions(more: str) -> None:
    config = configuration(FILE + more)
    assert config.model().structure.n_stories == 3 * N
    assert config.story_names[N] == "storey 1 (ground to 1st floor), along y"


def test_what_no_sensor_sees_is_not_watched() -> None:
    """Boxes in the middle of a plan without eccentricity do not see torsion; a lever, or what couples it, does."""
    eccentric = FILE.replace("plan_m", "eccentricity_m = [0.5, 0.0]\nplan_m")
    for text, hidden in (
        (FILE + sensors("xy"), (7, 8, 9)),
        (FILE + sensors("xy", (4.0, 0.0)), ()),
        (eccentric + sensors("xy"), ()),
        (FILE + sensors("y", (4.0, 0.0)), (1, 2, 3)),
        (FILE + sensors("x"), ()),
        (FILE + sensors("x") + "[alarm]\nunwatched = [2]\n", (2,)),
    ):
        assert configuration(text).unwatched == hidden


def test_torsion_is_known_within_a_factor_of_two_unless_it_is_drawn() -> None:
    std = configuration(FILE + sensors("xy")).drawn.prior_std()
    np.testing.assert_allclose(std, np.repeat([0.2, 0.5, 0.05], [2 * N, N, N]))


def test_what_does_not_fit_is_said(main: Cli, tmp_path: Path) -> None:
    bad = FILE.replace("plan_m = [20.0, 12.0]", "plan_m = [20.0, 12.0]\neccentricity_m = [11.0, 0.0]")
    for text, says in ((FILE.partition("[[")[0], "needs its [[storeys]]"), (bad, "outside the plan")):
        path = tmp_path / "s.toml"
        path.write_text(text + sensors("xy"))
        done = main("check", path)
        assert done.returncode == 78 and says in done.stderr


def test_effects_have_the_places_of_the_contract() -> None:
    moved = Model(SYMMETRIC, (parse_effect("stiffness_change:storey 2 y:relative=-0.1"),)).altered_structure()
    changed = moved.stiffness_n_per_m / SYMMETRIC.stiffness_n_per_m
    np.testing.assert_allclose(changed, np.where(np.arange(9) == 4, 0.9, 1.0))
    for text, says in (
        ("stiffness_change:storey 4 x:relative=-0.1", "9 storeys, storey 1 x to storey 3 torsion"),
        ("added_mass:floor 2 x:mass_kg=1", "3 floors"),
        ("quadratic_damping:floor 2:coefficient_n_s2_per_m2=1", "9 floors, floor 1 x to floor 3 torsion"),
    ):
        with pytest.raises(ValueError, match=says):
            parse_effect(text).check(SYMMETRIC, ())


def test_added_mass_moves_every_way() -> None:
    heavy = Model(SYMMETRIC, (parse_effect("added_mass:floor 3:mass_kg=9000"),)).mass_matrix()
    np.testing.assert_allclose(np.diag(heavy) - MASSES[[0, 1, 2] * 3], np.tile([0.0, 0.0, 9000.0], 3), atol=1e-6)


def test_the_ground_moves_one_way() -> None:
    moved = simulate(Model(SYMMETRIC), duration_s=20.0, rate_hz=50.0, excitation="ground").floors
    assert np.abs(moved[:, :N]).max() > 0.1
    assert np.abs(moved[:, N:]).max() < 1e-9


def test_a_rotated_box_shows_what_the_other_channel_should() -> None:
    site = configuration(FILE + sensors("xy", (3.0, 2.0))).instrumented()
    turned = parse_effect("sensor_rotation:channel x2,y2:angle_deg=30")
    context = site.context(50.0)
    assert turned.location in type(turned).places_in(context) and len(type(turned).places_in(context)) == N
    true = np.random.default_rng(1).standard_normal((50, 2 * N))
    recorded = turned.measure(true, 50.0, context, np.random.default_rng(0))
    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    np.testing.assert_allclose(recorded[:, 2:4], true[:, 2:4] @ np.array([[c, -s], [s, c]]), rtol=1e-12)
    np.testing.assert_array_equal(recorded[:, [0, 1, 4, 5]], true[:, [0, 1, 4, 5]])


def test_check_says_what_the_sensors_will_see(main: Cli, tmp_path: Path) -> None:
    roof = "".join(
        f'[[sensors]]\nchannel = "{name}"\nfloor = 3\naxis = "y"\nposition_m = [{x}, 0.0]\n'
        for name, x in (("east", 9.0), ("west", -9.0))
    )
    path = tmp_path / "roof.toml"
    path.write_text(FILE + roof + "[processing]\nrate_hz = 20.0\ncutoff_hz = 4.0\n")
    done = main("check", path)
    assert done.returncode == 0, done.stderr
    assert "along x: not seen" in done.stdout
    assert (
        "along y: seen as a whole: a loss moves the frequencies, but no storey is told from the others" in done.stdout
    )
    path.write_text(FILE + sensors("xy", (9.0, 5.0)))
    assert main("check", path).stdout.count("every storey is told from the others") == 3


def test_a_box_off_the_plan_is_told_and_all_modes_are_looked_for(main: Cli, tmp_path: Path) -> None:
    path = tmp_path / "off.toml"
    path.write_text(FILE + sensors("xy", (80.0, 5.0)))
    done = main("check", path)
    assert done.returncode == 0 and "x1 is outside the plan of floor 1" in done.stderr
    assert configuration(FILE + sensors("xy")).selection.max_modes == 12
    assert configuration(FILE + sensors("xy") + "[selection]\nmax_modes = 4\n").selection.max_modes == 4
