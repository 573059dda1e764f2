"""The damage index: differential, at the right story, honest about a wrong drawing."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from monitor.config import Configuration
from monitor.core import BadInputError, ModalEstimate, WindowResult
from monitor.damage import Baseline, damage_index, load_baseline, save_baseline
from monitor.damage.baseline_learning import mean_observation
from monitor.damage.damage_index import sequential_reading
from monitor.damage.updating import observe
from monitor.model import Model, parse_effect, simulate
from monitor.pipeline import Pipeline
from monitor.runs import cut_into_blocks
from tests.support.exact_modes import JOINTS, drawing, exact_modes, truth
from tests.support.frames import shear_frame
from tests.support.learned import baseline_of
from tests.support.results import modal_estimate


@pytest.mark.parametrize("signs", [(1, 1, 1), (1, -1, 1), (-1, 1, -1), (-1, -1, 1)])
@pytest.mark.parametrize("story", [1, 2, 3])
def test_wrong_masses_and_flexible_joints_bias_a_5_percent_loss_by_less_than_half_a_point(
    signs: tuple[int, int, int], story: int
) -> None:
    config = drawing(signs)
    healthy = baseline_of(config, [exact_modes(truth((0, 0, 0)))])
    loss = tuple(0.05 if j + 1 == story else 0.0 for j in range(3))
    _, reading = damage_index.step(exact_modes(truth(loss)), healthy.model, healthy, np.eye(3), config.updating)
    assert np.abs(reading.ddi - loss).max() < 0.005
    assert int(np.argmax(reading.ddi)) == story - 1


@pytest.mark.parametrize("story", [1, 2, 3])
def test_beside_joints_that_the_model_knows_a_loss_is_that_of_the_columns(story: int) -> None:
    plain = drawing((0, 0, 0)).model_dump(mode="json", exclude_unset=True)
    joints = {"effect": JOINTS[0].name, "location": JOINTS[0].location, "parameters": JOINTS[0].values()}
    config = Configuration.model_validate({**plain, "effects": [joints]})
    healthy = baseline_of(config, [exact_modes(truth((0, 0, 0)))])
    lost = parse_effect(f"stiffness_change:story {story}:relative=-0.15")
    now = exact_modes(Model(truth((0, 0, 0)).structure, (*JOINTS, lost)))
    _, reading = damage_index.step(now, healthy.model, healthy, np.eye(3), config.updating)
    np.testing.assert_allclose(reading.ddi, 0.15 * np.eye(3)[story - 1], atol=2e-3)


def test_an_unchanged_structure_reads_zero_however_wrong_the_drawing() -> None:
    config = drawing((1, -1, 1))
    healthy = baseline_of(config, [exact_modes(truth((0, 0, 0)))])
    assert np.abs(healthy.misfit).max() > 0.005  # the drawing is wrong indeed, and stays so
    _, reading = damage_index.step(exact_modes(truth((0, 0, 0))), healthy.model, healthy, np.eye(3), config.updating)
    assert np.abs(reading.ddi).max() < 1e-6


def test_a_story_judged_by_its_frequency_alone_loses_what_the_frequency_tells_and_leaves_no_misfit() -> None:
    """Nothing is left to be misfitted, nor expected to be: as many data as stiffnesses."""
    config = shear_frame([1.3], [2000.0], updating={"use_shapes": False, "penalty": "least_squares"})

    def modes(loss: float) -> ModalEstimate:
        model = config.model().with_stiffness(np.array([2000.0 * (1.0 - loss)]))
        return modal_estimate(model.modes().frequencies_hz, np.ones((1, 1)), deviations=np.full((1, 1, 4), 1e-3))

    healthy = baseline_of(config, [modes(0.0)])
    estimate, reading = damage_index.step(modes(0.1), healthy.model, healthy, np.eye(1), config.updating)
    np.testing.assert_allclose(reading.ddi, [0.1], atol=1e-9)
    assert estimate.misfit == 0.0 and 0.0 < reading.covariance[0, 0] < 0.01**2


def test_the_mean_of_one_window_is_that_window() -> None:
    modes, updating = exact_modes(truth((0.1, 0, 0))), drawing((0, 0, 0)).updating
    mean, alone = mean_observation([modes], updating), observe(modes, updating)
    for name in ("z", "weight", "deviations"):
        np.testing.assert_array_equal(getattr(mean, name), getattr(alone, name), err_msg=name)


@pytest.mark.parametrize("losses", [(0.2, 0.0, 0.0), (0.0, 0.2, 0.1), (0.3, 0.1, 0.4)])
def test_the_papers_sequential_reading_is_the_ratio_of_stories_in_a_shear_frame(losses: tuple[float, ...]) -> None:
    reading = sequential_reading(truth((0, 0, 0), ()).stiffness_matrix(), truth(losses, ()).stiffness_matrix())
    np.testing.assert_allclose(reading, losses, atol=1e-12)


def windows_of(model: Model, config: Configuration, healthy: Baseline | None, seed: int) -> list[WindowResult]:
    floors = simulate(model, duration_s=500.0, rate_hz=200.0, noise=0.1, seed=seed).floors
    pipeline = Pipeline(config, healthy)
    results = [
        r for b in cut_into_blocks("/acceleration", floors, ("a1", "a2", "a3"), 200.0, 0, 997) for r in pipeline.push(b)
    ]
    return [r for r in results if isinstance(r, WindowResult)]


def test_from_samples_a_5_percent_loss_is_found_at_the_right_story() -> None:
    """Wrong masses, flexible joints, 10 % noise: the mean over windows lies within half a point, in one story."""
    config = drawing((1, -1, 1), window_s=200.0, hop_s=50.0)
    calm = windows_of(truth((0, 0, 0)), config, None, seed=1)
    healthy = baseline_of(config, calm)
    for story in (1, 2, 3):
        loss = tuple(0.05 if j + 1 == story else 0.0 for j in range(3))
        readings = [r.damage for r in windows_of(truth(loss), config, healthy, seed=1 + story) if r.damage is not None]
        mean = np.mean([r.ddi for r in readings], axis=0)
        spread = np.sqrt(np.mean([r.ddi_std**2 for r in readings], axis=0))
        assert np.abs(mean - loss).max() < 0.005 + 2 * spread.max()
        assert int(np.argmax(mean)) == story - 1


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("windows", "x"),
        ("windows", None),
        ("windows", 1.5),
        ("span_ns", ["a"]),
        ("span_ns", [0, 1, 2]),
        ("reference_temperature_degc", "x"),
        ("level_range_m_s2", ["a", "b"]),
        ("model_mode", ["a", 1, 2]),
        ("model_mode", [0, 1, -1]),
        ("model_mode", [0, 1, 1]),
        ("gauges", [0.5, 1, 2]),
        ("gauges", [-1, 1, 2]),
        ("log", 1),
        ("channels", "a1"),
        ("channels", [1, 2, 3]),
        ("recordings", [{"file": 3}]),
        ("recordings", {}),
        ("z", [True] * 9),
        ("misfit", [[0.0]]),
        ("covariance", "x"),
        ("stiffness_n_per_m", ["2", "3", "4"]),
        ("masses_kg", [0.0, 1.0, 1.0]),
        ("law", {"axes": []}),
        ("law", 3),
        ("origin", None),
        ("converged", 1),
        ("stiffness_correction_n_per_m", [0.0]),
        ("reference", {}),
        ("reference", []),
        ("format", "1"),
        ("colour", "red"),
    ],
)
def test_a_baseline_with_one_wrong_key_is_refused_by_name(tmp_path, key: str, value: object) -> None:
    config, place = drawing((1, 1, -1)), tmp_path / "b.json"
    healthy = baseline_of(config, [exact_modes(truth((0, 0, 0)))], [{"file": "x"}])
    save_baseline(healthy, place)
    content = json.loads(place.read_text())
    place.write_text(json.dumps(content | {key: value}))
    with pytest.raises(BadInputError, match=rf"^{re.escape(str(place))}: .*({key}|modes are)"):
        load_baseline(place, config.instrumented(), config.updating)


def test_a_baseline_without_one_of_its_keys_is_refused_by_name(tmp_path) -> None:
    config, place = drawing((1, 1, -1)), tmp_path / "b.json"
    healthy = baseline_of(config, [exact_modes(truth((0, 0, 0)))])
    save_baseline(healthy, place)
    content = json.loads(place.read_text())
    for key in content:
        place.write_text(json.dumps({name: value for name, value in content.items() if name != key}))
        with pytest.raises(BadInputError, match=key):
            load_baseline(place, config.instrumented(), config.updating)


def test_a_baseline_survives_its_file(tmp_path) -> None:
    config = drawing((1, 1, -1))
    healthy = baseline_of(config, [exact_modes(truth((0, 0, 0)))], [{"file": "x"}])
    save_baseline(healthy, tmp_path / "b.json")
    again = load_baseline(tmp_path / "b.json", config.instrumented(), config.updating)
    modes = exact_modes(truth((0.0, 0.05, 0.0)))
    first, second = (damage_index.step(modes, b.model, b, np.eye(3), config.updating)[1] for b in (healthy, again))
    np.testing.assert_array_equal(first.ddi, second.ddi)
    np.testing.assert_array_equal(first.covariance, second.covariance)
