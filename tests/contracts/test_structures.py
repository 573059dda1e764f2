"""What every structure promises: a new kind joins `CASES` and gets these tests."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import eigh

from monitor.model import EFFECTS, Building, Condition, Context, EffectError, MatrixStructure, ShearFrame


def cantilever(elements: int = 4) -> MatrixStructure:
    """A clamped beam of unit length, mass and bending stiffness, Hermite elements; dofs are deflection and rotation."""
    h, n = 1.0 / elements, 2 * elements
    bending = np.array(
        [[12, 6 * h, -12, 6 * h], [6 * h, 4 * h**2, -6 * h, 2 * h**2],
         [-12, -6 * h, 12, -6 * h], [6 * h, 2 * h**2, -6 * h, 4 * h**2]]
    ) / h**3  # fmt: skip
    inertia = np.array(
        [[156, 22 * h, 54, -13 * h], [22 * h, 4 * h**2, 13 * h, -3 * h**2],
         [54, 13 * h, 156, -22 * h], [-13 * h, -3 * h**2, -22 * h, 4 * h**2]]
    ) * h / 420  # fmt: skip
    slopes, mass = np.zeros((elements, n + 2, n + 2)), np.zeros((n + 2, n + 2))
    for e in range(elements):
        at = slice(2 * e, 2 * e + 4)
        slopes[e, at, at] = bending
        mass[at, at] += inertia
    slopes, mass = slopes[:, 2:, 2:], mass[2:, 2:]
    return MatrixStructure.create(mass, slopes.sum(axis=0), slopes, np.ones(elements), 0.01)


def grounded() -> MatrixStructure:
    """Two masses whose second support is no parameter."""
    slope = np.array([[[1.0, -1.0], [-1.0, 1.0]]])
    stiffness = 700.0 * slope[0] + np.diag([0.0, 900.0])
    return MatrixStructure.create(np.diag([1.0, 2.0]), stiffness, slope, np.array([700.0]), 0.02)


def building() -> Building:
    """Two storeys, the mass centres off the middle of the plan."""
    stiffness = np.array([9e3, 8e3, 6e3, 5e3, 3e5, 2e5])
    plan, off = np.array([[8.0, 5.0], [6.0, 5.0]]), np.array([[0.5, -0.2], [0.1, 0.3]])
    return Building(np.array([11.0, 9.0]), stiffness, 0.01, plan, off)


Structure = ShearFrame | MatrixStructure | Building

CASES: dict[str, Structure] = {
    "one story": ShearFrame(np.array([2.0]), np.array([800.0]), 0.01),
    "frame": ShearFrame(np.array([0.33, 0.35, 0.31]), np.array([2250.0, 2300.0, 1800.0]), 0.01),
    "beam": cantilever(),
    "building": building(),
    "fewer stiffnesses than dofs": grounded(),
}

every = pytest.mark.parametrize("structure", CASES.values(), ids=CASES.keys())


@every
def test_matrices_are_symmetric_and_positive_definite(structure: Structure) -> None:
    for matrix in (structure.mass_matrix(), structure.stiffness_matrix()):
        assert matrix.shape == (structure.n_dofs, structure.n_dofs)
        np.testing.assert_allclose(matrix, matrix.T, rtol=1e-12, atol=1e-12 * np.abs(matrix).max())
        assert np.linalg.eigvalsh(matrix)[0] > 0


@every
def test_a_single_spring_is_all_of_its_stiffness_derivative(structure: Structure) -> None:
    """Laws along a drift are for these stories only: a bending element turns and bends, and has no drift."""
    rows = structure.drift_matrix()
    springs = [np.allclose(np.outer(d, d), s) for d, s in zip(rows, structure.stiffness_derivatives(), strict=True)]
    assert structure.single_springs().tolist() == springs
    for name, kind in EFFECTS.items():
        if "story" in kind.places:
            effect = kind.starts(structure.story_places[0], _context(structure), _still(structure))[0]
            if name == "stiffness_change" or springs[0]:
                effect.check(structure, ("a",))
            else:
                with pytest.raises(EffectError, match="story 1 is not a single spring"):
                    effect.check(structure, ("a",))


def _context(structure: Structure) -> Context:
    return Context(structure, ("a",), np.eye(1, structure.n_dofs), 100.0)


def _still(structure: Structure) -> Condition:
    p, n = structure.n_stories, structure.n_dofs
    return Condition(np.ones(p), np.ones(p), np.ones(n), np.ones(1))


def test_a_beam_has_no_single_springs() -> None:
    assert not cantilever().single_springs().any()


@every
def test_derivatives_are_the_matrices_slopes(structure: Structure) -> None:
    stiffness, masses = structure.stiffness_n_per_m, structure.masses_kg
    assert structure.n_stories == stiffness.size
    assert structure.stiffness_derivatives().shape == (stiffness.size, structure.n_dofs, structure.n_dofs)
    for j, h in enumerate(1e-5 * stiffness):
        step = h * np.eye(stiffness.size)[j]
        up, down = (structure.with_stiffness(stiffness + s).stiffness_matrix() for s in (step, -step))
        slope = structure.stiffness_derivatives()[j]
        np.testing.assert_allclose((up - down) / (2 * h), slope, atol=1e-6 * np.abs(slope).max())
    for i, h in enumerate(1e-5 * masses):
        step = h * np.eye(masses.size)[i]
        up, down = (structure.with_masses(masses + s).mass_matrix() for s in (step, -step))
        slope = structure.mass_derivatives()[i]
        np.testing.assert_allclose((up - down) / (2 * h), slope, atol=1e-6 * np.abs(slope).max())


@every
def test_masses_are_the_diagonal_and_keep_the_matrix_positive(structure: Structure) -> None:
    heavier = structure.with_masses(structure.masses_kg * np.linspace(0.5, 2.0, structure.n_masses))
    np.testing.assert_allclose(np.diag(heavier.mass_matrix()), heavier.inertia_kg)
    assert np.linalg.eigvalsh(heavier.mass_matrix())[0] > 0


@every
def test_other_parameters_leave_the_structure_itself_alone(structure: Structure) -> None:
    before = structure.stiffness_matrix()
    weaker = structure.with_stiffness(0.9 * structure.stiffness_n_per_m)
    assert np.abs(weaker.stiffness_matrix() - before).max() > 0.01 * np.abs(before).max()
    np.testing.assert_array_equal(structure.stiffness_matrix(), before)


@pytest.mark.parametrize("structure", [CASES["frame"], CASES["fewer stiffnesses than dofs"]])
def test_a_spring_s_slope_is_its_drift_squared(structure: Structure) -> None:
    drift = structure.drift_matrix()
    np.testing.assert_allclose(np.einsum("ja,jb->jab", drift, drift), structure.stiffness_derivatives(), atol=1e-12)


def test_a_uniform_shear_frame_has_the_frequencies_of_the_textbook() -> None:
    """omega_i = 2 sqrt(k / m) sin((2 i - 1) pi / (4 n + 2)) for a fixed-free chain."""
    n, k, m = 10, 2000.0, 0.3
    frame = ShearFrame(np.full(n, m), np.full(n, k), 0.01)
    omega = np.sqrt(eigh(frame.stiffness_matrix(), frame.mass_matrix(), eigvals_only=True))
    expected = 2.0 * np.sqrt(k / m) * np.sin((2 * np.arange(1, n + 1) - 1) * np.pi / (4 * n + 2))
    np.testing.assert_allclose(omega, expected, rtol=1e-10)


def test_a_cantilever_has_the_frequencies_of_the_textbook() -> None:
    """Euler-Bernoulli: (beta l)^2 of a clamped-free beam."""
    beam = cantilever(12)
    omega = np.sqrt(eigh(beam.stiffness_matrix(), beam.mass_matrix(), eigvals_only=True))
    np.testing.assert_allclose(omega[:3], np.array([1.8751041, 4.6940911, 7.8547574]) ** 2, rtol=5e-4)


@every
def test_changes_of_a_stiffness_add_up_in_shares_of_what_was_built(structure: Structure) -> None:
    first = np.eye(structure.n_stories)[0]
    twice = structure.changed(-0.6 * first).changed(-0.6 * first)
    np.testing.assert_allclose(twice.stiffness_n_per_m, structure.stiffness_n_per_m * (1.0 - 1.2 * first))
    np.testing.assert_array_equal(structure.changed(0.0 * first).stiffness_matrix(), structure.stiffness_matrix())
