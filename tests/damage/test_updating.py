"""Model updating: the paper's iteration, derivatives, penalties."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from monitor.damage.alternative_solutions import second_solutions
from monitor.damage.updating import Observation, UpdatingSettings, counterparts, predict, update
from monitor.model import MatrixStructure, Model, ShearFrame, parse_effect
from monitor.runs import paper_tables
from tests.support.two_directions import HEALTHY, two_directions

MASSES = np.array([0.3253, 0.3514, 0.3129])
INITIAL = np.array([2251.8509, 2251.8509, 1811.292])
PAPER = UpdatingSettings(use_shapes=False, eigenvalue="linear")


def frequencies(values: list[float]) -> Observation:
    lam = (2 * np.pi * np.array(values)) ** 2
    return Observation(lam, np.diag(lam**-2.0), np.zeros((1, lam.size)), tuple(range(lam.size)), (), log=False)


def everything(model: Model, gauges: tuple[int, ...], log: bool = True) -> Observation:
    n = model.structure.n_stories
    empty = Observation(np.zeros(0), np.eye(n * n), np.zeros((1, n * n)), tuple(range(n)), gauges, log)
    z, _ = predict(model, np.eye(n), empty, with_masses=False)
    return Observation(z, 1e6 * np.eye(z.size), np.zeros((1, z.size)), tuple(range(n)), gauges, log)


def frame(stiffness: np.ndarray, masses: np.ndarray = MASSES) -> Model:
    return Model(ShearFrame(masses, stiffness, 0.01))


@pytest.mark.parametrize("penalty", ["weighted", "least_squares", "minimum_norm"])
def test_table_4_step_by_step(penalty: str) -> None:
    fit = update(
        frame(INITIAL), np.eye(3), frequencies([5.2, 16.3, 23.0]), PAPER.model_copy(update={"penalty": penalty})
    )
    expected = [
        (2589.8896, 1990.4474, 1590.5425),
        (2881.4900, 1629.9189, 1731.9624),
        (3019.4312, 1362.3138, 1982.3421),
        (2929.4206, 1492.4831, 1902.9934),
        (2909.5691, 1515.0086, 1897.1818),
        (2909.4514, 1514.8503, 1897.6989),
        (2909.4512, 1514.8507, 1897.6987),
    ]
    np.testing.assert_allclose(fit.history[1:8], expected, atol=6e-5)
    assert fit.converged


def test_three_frequencies_have_a_second_exact_solution() -> None:
    fit = update(frame(np.array([1600.0, 980.0, 5300.0])), np.eye(3), frequencies([5.2, 16.3, 23.0]), PAPER)
    np.testing.assert_allclose(fit.parameters, [1603.03, 978.68, 5331.21], atol=0.01)


@given(
    st.lists(st.floats(0.5, 2.0), min_size=8, max_size=8),
    st.lists(st.integers(0, 3), min_size=4, max_size=4),
    st.booleans(),
    st.booleans(),
)
@settings(max_examples=25, deadline=None)
def test_sensitivities_are_the_derivatives(factors: list[float], gauges: list[int], log: bool, joints: bool) -> None:
    stiffness, masses = 2000.0 * np.array(factors[:4]), 0.3 * np.array(factors[4:])
    effects = (parse_effect("joint_flexibility:frame:girder_to_column_ratio=4"),) if joints else ()
    model = Model(ShearFrame(masses, stiffness, 0.01), effects)
    shapes = model.modes().shapes
    # A gauge at a node has no finite ratio; the monitor takes the largest component.
    safe = tuple(
        g if abs(shapes[g, i]) > 0.2 * abs(shapes[:, i]).max() else int(abs(shapes[:, i]).argmax())
        for i, g in enumerate(gauges)
    )
    observation = Observation(np.zeros(0), np.eye(16), np.zeros((1, 16)), (0, 1, 2, 3), safe, log)
    z, sensitivity = predict(model, np.eye(4), observation, with_masses=True)
    for j, value in enumerate(np.concatenate([stiffness, masses])):
        h = 1e-6 * value
        theta = [np.concatenate([stiffness, masses]) for _ in range(2)]
        theta[0][j] += h
        theta[1][j] -= h
        up, down = (
            predict(model.with_stiffness(t[:4]).with_masses(t[4:]), np.eye(4), observation, with_masses=True)[0]
            for t in theta
        )
        np.testing.assert_allclose(
            (up - down) / (2 * h), sensitivity[:, j], rtol=1e-4, atol=1e-5 * np.abs(z).max() / value
        )


@pytest.mark.parametrize("penalty", ["weighted", "least_squares", "step"])
def test_frequencies_and_shapes_recover_any_stiffness(penalty: str) -> None:
    truth = np.array([2000.0, 1500.0, 2500.0, 1800.0, 2200.0])
    masses = np.full(5, 0.3)
    target = everything(frame(truth, masses), (0, 1, 2, 3, 4))
    fit = update(frame(np.full(5, 2000.0), masses), np.eye(5), target, UpdatingSettings(penalty=penalty))
    assert fit.converged
    np.testing.assert_allclose(fit.parameters, truth, rtol=1e-6)


def test_the_initial_penalty_holds_what_data_cannot_see() -> None:
    """Masses and stiffnesses together have a free scale; the prior keeps it at the drawing's."""
    truth = frame(np.array([2400.0, 1700.0, 2000.0]))
    target = everything(truth, (0, 2, 1))
    fit = update(
        frame(INITIAL),
        np.eye(3),
        target,
        UpdatingSettings(penalty="initial"),
        prior_std=np.full(6, 0.1),
        with_masses=True,
    )
    assert fit.converged
    ratio = fit.parameters / np.concatenate([truth.structure.stiffness_n_per_m, MASSES])
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-3)
    assert abs(ratio[0] - 1) < 0.1


def test_minimum_norm_meets_too_few_data_with_the_shortest_step() -> None:
    target = frequencies([5.2])
    fit = update(frame(INITIAL), np.eye(3), target, PAPER.model_copy(update={"penalty": "minimum_norm"}))
    assert fit.converged
    assert fit.model.modes().frequencies_hz[0] == pytest.approx(5.2, abs=1e-8)


def test_not_converging_is_a_value() -> None:
    fit = update(
        frame(INITIAL), np.eye(3), frequencies([5.2, 5.3, 5.4]), PAPER.model_copy(update={"max_iterations": 5})
    )
    assert not fit.converged
    assert (fit.parameters > 0).all()


def measured(model: Model, sensors: np.ndarray, modes: tuple[int, ...], std: float) -> Observation:
    """The first modes at few sensors, each number with standard deviation `std`; no error yet."""
    gauges = tuple(int(np.abs(sensors @ model.modes().shapes[:, i]).argmax()) for i in modes)
    size = len(modes) * len(sensors)
    blank = Observation(np.zeros(size), np.eye(size), np.zeros((1, size)), modes, gauges, True)
    z, _ = predict(model, sensors, blank, with_masses=False)
    return Observation(z, np.eye(size) / std**2, std * np.eye(size), modes, gauges, True)


def test_three_sensors_see_every_story_and_the_prior_changes_nothing() -> None:
    target = measured(frame(INITIAL * [1.0, 0.8, 1.1]), np.eye(3), (0, 1, 2), 2e-3)
    plain = update(frame(INITIAL), np.eye(3), target, UpdatingSettings())
    held = update(frame(INITIAL), np.eye(3), target, UpdatingSettings(), prior_std=np.full(3, 0.2))
    np.testing.assert_array_equal(held.parameters, plain.parameters)
    np.testing.assert_array_equal(held.gain, plain.gain)
    assert held.unseen.shape == (0, 3)
    assert held.identifiable.min() > 0.999
    assert np.abs(held.prior_left).max() < 1e-9 * (0.2 * INITIAL.max()) ** 2


def test_what_two_springs_in_parallel_share_is_seen_and_what_they_trade_is_not() -> None:
    spring = np.array([[1.0, -1.0], [-1.0, 1.0]])
    slopes = np.array([spring, spring, np.diag([0.0, 1.0])])
    nominal = np.array([500.0, 500.0, 1500.0])
    structure = MatrixStructure.create(np.eye(2), np.tensordot(nominal, slopes, axes=1), slopes, nominal, 0.01)
    truth = Model(structure.with_stiffness(np.array([400.0, 500.0, 1500.0])))
    fit = update(
        Model(structure), np.eye(2), measured(truth, np.eye(2), (0, 1), 1e-3), UpdatingSettings(),
        prior_std=np.full(3, 0.2),
    )  # fmt: skip
    assert fit.converged
    assert fit.parameters[:2].sum() == pytest.approx(900.0, rel=1e-3)
    assert fit.parameters[2] == pytest.approx(1500.0, rel=1e-3)
    np.testing.assert_allclose(np.abs(fit.unseen), [[np.sqrt(0.5), np.sqrt(0.5), 0.0]], atol=1e-3)
    np.testing.assert_allclose(fit.identifiable, [0.5, 0.5, 1.0], atol=1e-3)
    np.testing.assert_allclose(np.sqrt(np.diag(fit.prior_left)) / nominal, [np.sqrt(0.02), np.sqrt(0.02), 0], atol=1e-3)


def test_few_sensors_on_a_tall_frame_leave_an_honest_uncertainty() -> None:
    """Truths drawn from the prior lie within the stated deviation, also where nearly nothing is seen."""
    n, sensors, prior, std = 8, np.eye(8)[[0, 4]], 0.1, 4e-3
    drawn = Model(ShearFrame(np.full(n, 0.3), np.full(n, 5000.0), 0.01))
    rng = np.random.default_rng(3)
    scores = []
    for _ in range(60):
        change = prior * rng.standard_normal(n)
        target = measured(drawn.with_stiffness(5000.0 * (1.0 + change)), sensors, (0, 1, 2), std)
        noisy = Observation(target.z + std * rng.standard_normal(target.z.size), target.weight, target.deviations,
                            target.model_mode, target.gauges, True)  # fmt: skip
        fit = update(drawn, sensors, noisy, UpdatingSettings(), prior_std=np.full(n, prior))
        covariance = std**2 * fit.gain @ fit.gain.T + fit.prior_left
        scores.append((fit.parameters / 5000.0 - 1.0 - change) * 5000.0 / np.sqrt(np.diag(covariance)))
        assert fit.converged
    assert len(fit.unseen) >= 2
    assert fit.identifiable.min() < 0.5 < fit.identifiable.max()
    assert 0.93 < np.mean(np.abs(scores) < 1.96) < 0.98
    assert np.sqrt(np.mean(np.square(scores), axis=0)).max() < 1.35


def test_the_second_exact_solution_is_found_from_the_first_and_back() -> None:
    first, target = frame(paper_tables.updating_history()[-1]), frequencies([5.2, 16.3, 23.0])
    (other,) = second_solutions(first, np.eye(3), target, PAPER)
    np.testing.assert_allclose(other, [1603.03, 978.68, 5331.21], atol=0.01)
    (back,) = second_solutions(frame(other), np.eye(3), target, PAPER)
    np.testing.assert_allclose(back, paper_tables.updating_history()[-1], rtol=1e-6)


def test_shapes_leave_no_second_solution() -> None:
    first = frame(paper_tables.updating_history()[-1])
    target = measured(first, np.eye(3), (0, 1, 2), 1e-3)
    assert second_solutions(first, np.eye(3), target, UpdatingSettings()).shape == (0, 3)


"""First modes at 5.00 and 5.20 Hz."""


@pytest.mark.parametrize("loss", [0.03, 0.10, 0.30])
def test_modes_that_change_places_are_followed(loss: float) -> None:
    truth = HEALTHY * [1.0, 1.0, 1.0 - loss, 1.0 - loss]
    order = (0, 1, 2, 3) if loss < 0.05 else (1, 0, 3, 2)
    gauges, size = (0, 2, 1, 3), 16
    blank = Observation(np.zeros(0), np.eye(size), np.zeros((1, size)), order, gauges, True)
    z, _ = predict(two_directions(truth), np.eye(4), blank, with_masses=False)
    target = Observation(z, 1e6 * np.eye(size), np.zeros((1, size)), (0, 1, 2, 3), gauges, True)
    assert counterparts(two_directions(HEALTHY).modes(), np.eye(4), target) == (0, 1, 2, 3)
    fit = update(two_directions(HEALTHY), np.eye(4), target, UpdatingSettings(), prior_std=np.full(4, 0.2))
    assert fit.converged
    np.testing.assert_allclose(fit.parameters, truth, rtol=1e-6)
    assert counterparts(fit.model.modes(), np.eye(4), target) == order


def test_a_mode_without_motion_at_its_gauge_does_not_converge_and_changes_nothing() -> None:
    model, size = two_directions(HEALTHY), 4
    z = np.array([np.log((2.0 * np.pi * 5.0) ** 2), 0.9, 0.7, 0.9])
    target = Observation(z, np.eye(size), np.zeros((1, size)), (0,), (2,), True)
    with pytest.raises(np.linalg.LinAlgError, match="gauge"):
        predict(model, np.eye(4), target, with_masses=False)
    fit = update(model, np.eye(4), target, UpdatingSettings())
    assert not fit.converged and fit.iterations == 0
    np.testing.assert_array_equal(fit.parameters, HEALTHY)
    np.testing.assert_allclose(np.sqrt(np.diag(fit.prior_left)), 0.2 * HEALTHY)
