"""The poles of small matrices are LAPACK's, and so is what is seen of their vectors."""

from __future__ import annotations

import numpy as np
import pytest

from monitor.identification import eigen
from monitor.identification.eigen import tridiagonal_vectors, upper_poles


def assert_lapack_agrees(a: np.ndarray, c: np.ndarray, tolerance: float) -> None:
    _, values, logarithms, shapes = upper_poles(a, c, (len(a),))
    np.testing.assert_allclose(np.exp(logarithms), values)
    wanted, vectors = np.linalg.eig(a)
    above = np.flatnonzero(wanted.imag > 0)
    assert values.size == above.size and shapes.shape == (above.size, len(c))
    for value, shape in zip(values, shapes, strict=True):
        at = above[np.abs(wanted[above] - value).argmin()]
        assert abs(wanted[at] - value) < tolerance
        seen = c @ vectors[:, at]
        alike = abs(np.vdot(seen, shape)) / (np.linalg.norm(seen) * np.linalg.norm(shape))
        assert alike == pytest.approx(1.0, abs=tolerance)


@pytest.mark.parametrize("n", [2, 3, 4, 5, 6, 7, 10, 15, 20, 30, 40])
def test_random_matrices(n: int) -> None:
    rng = np.random.default_rng(n)
    for _ in range(20):
        assert_lapack_agrees(rng.standard_normal((n, n)), rng.standard_normal((3, n)), 1e-8)


def test_lightly_damped_poles_of_very_different_size() -> None:
    rng = np.random.default_rng(0)
    poles = np.array([0.999, 0.95, 1e-3, 1e-6]) * np.exp(1j * np.array([0.05, 1.0, 2.0, 3.1]))
    blocks = np.zeros((8, 8))
    for k, pole in enumerate(poles):
        blocks[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = [[pole.real, pole.imag], [-pole.imag, pole.real]]
    turn, _ = np.linalg.qr(rng.standard_normal((8, 8)))
    assert_lapack_agrees(turn @ blocks @ turn.T, rng.standard_normal((2, 8)), 1e-12)
    assert_lapack_agrees(blocks, rng.standard_normal((2, 8)), 1e-12)  # falls apart at once


@pytest.mark.parametrize("a", [np.zeros((4, 4)), np.eye(6), np.triu(np.ones((5, 5))), np.diag([1.0, 2.0])])
def test_nothing_lies_above_the_axis(a: np.ndarray) -> None:
    space, values, _, shapes = upper_poles(a, np.ones((2, len(a))), (len(a),))
    assert space.shape == values.shape == (0,) and shapes.shape == (0, 2)


def test_shifts_in_a_cycle_are_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(eigen, "by_lapack", lambda *_: pytest.fail("the iteration gave up"))
    a = np.roll(np.eye(4), 1, axis=0)  # the fourth roots of one: the plain shifts stand still on it
    assert_lapack_agrees(a, np.ones((1, 4)), 1e-12)


def test_what_does_not_succeed_is_left_to_lapack() -> None:
    rng = np.random.default_rng(0)
    a, c = rng.standard_normal((7, 7)), rng.standard_normal((3, 7))
    given_up, lapack = upper_poles(a, c, (7,), sweeps=0), eigen.by_lapack(a, c, (7,), eigen.EVERYWHERE)
    for found, wanted in zip(given_up, lapack, strict=True):
        np.testing.assert_array_equal(found, wanted)


def test_leading_parts_are_matrices_of_their_own_and_a_region_only_leaves_out() -> None:
    rng = np.random.default_rng(1)
    a, c = rng.standard_normal((12, 12)) / 4.0, rng.standard_normal((3, 12))
    orders, region = (4, 6, 7, 12), (0.8, 2.5, 0.0, 0.9)
    space, values, logarithms, shapes = upper_poles(a, c, orders)
    kept = [0.8 < abs(x) < 2.5 and 0.0 < -x.real / abs(x) < 0.9 for x in logarithms]
    assert 0 < sum(kept) < len(kept)
    for found, wanted in zip(upper_poles(a, c, orders, region), (space, values, logarithms, shapes), strict=True):
        np.testing.assert_array_equal(found, wanted[kept])
    assert all(len(found) == sum(kept) for found in eigen.by_lapack(a, c, orders, region))
    for k, n in enumerate(orders):
        alone = upper_poles(a[:n, :n], c[:, :n], (n,))
        np.testing.assert_array_equal(alone[1], values[space == k])
        np.testing.assert_array_equal(alone[3], shapes[space == k])


def test_vectors_of_a_tridiagonal_matrix_are_orthonormal() -> None:
    rng = np.random.default_rng(4)
    diagonal, beside = rng.standard_normal(60), rng.standard_normal(59)
    diagonal[30:], beside[30:] = diagonal[:30] + 1e-10, beside[:29]  # two matrices in one, of nearly the same values
    beside[29] = 0.0
    whole = np.diag(diagonal) + np.diag(beside, 1) + np.diag(beside, -1)
    values = np.linalg.eigvalsh(whole)[-25:]
    vectors = tridiagonal_vectors(diagonal, beside, values)
    np.testing.assert_allclose(vectors @ vectors.T, np.eye(25), atol=1e-10)
    np.testing.assert_allclose(vectors @ whole, values[:, None] * vectors, atol=1e-12)
