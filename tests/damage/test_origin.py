"""Whose a baseline is: what counts as another structure, and what a changed drawing changes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from monitor.config import Configuration
from monitor.core import BadConfigurationError
from monitor.damage import Baseline, load_baseline, rebase_baseline, save_baseline
from tests.support.exact_modes import drawing, exact_modes, truth
from tests.support.frames import configured
from tests.support.learned import baseline_of


def learned(config: Configuration) -> Baseline:
    return baseline_of(config, [exact_modes(truth((0, 0, 0)))])


def matrices(coupling: float) -> Configuration:
    frame = drawing((1, 1, -1)).model().structure
    stiffness = frame.stiffness_matrix()
    stiffness[0, 2] = stiffness[2, 0] = coupling
    table = {
        "kind": "matrices",
        "mass_matrix": frame.mass_matrix().tolist(),
        "stiffness_matrix": stiffness.tolist(),
        "stiffness_derivatives": frame.stiffness_derivatives().tolist(),
        "stiffness_n_per_m": frame.stiffness_n_per_m.tolist(),
    }
    return configured(table, (1, 2, 3))


def load(path: Path, config: Configuration) -> Baseline:
    return load_baseline(path, config.instrumented(), config.updating)


def test_matrices_that_differ_only_off_the_stated_values_are_told_apart(tmp_path: Path) -> None:
    place = tmp_path / "b.json"
    save_baseline(learned(matrices(0.0)), place)
    assert load(place, matrices(0.0)).doubts == ()
    with pytest.raises(BadConfigurationError, match="its matrices differ"):
        load(place, matrices(-50.0))
    with pytest.raises(BadConfigurationError, match="it is a matrices there and a shear_frame here"):
        load(place, drawing((1, 1, -1)))


def test_the_least_change_of_a_drawing_is_told_with_digits_enough(tmp_path: Path) -> None:
    place, config = tmp_path / "b.json", drawing((1, 1, -1))
    save_baseline(learned(config), place)
    content = json.loads(place.read_text())
    content["origin"]["stiffness_n_per_m"][0] = 2251.8519
    content["origin"]["fingerprint"] = "another"
    place.write_text(json.dumps(content))
    with pytest.raises(
        BadConfigurationError, match=r"story 1 is drawn with 2251\.8519 N/m there and 2251\.8509 N/m here"
    ):
        load(place, config)


def test_an_unchanged_drawing_is_updated_to_the_same_model() -> None:
    """The baseline keeps no weights of its windows; those of their mean's covariance give the same model, far within the error
    of the model's form.
    """
    config = drawing((1, -1, 1))
    healthy = learned(config)
    again, fit = rebase_baseline(healthy, config.instrumented(), config.updating)
    assert fit.converged
    change = again.model.structure.stiffness_n_per_m / healthy.model.structure.stiffness_n_per_m - 1.0
    assert np.abs(change).max() < 0.01 < 0.25 * healthy.model_form
    np.testing.assert_array_equal(again.z, healthy.z)


def test_masses_drawn_alike_too_light_scale_the_stiffness_and_nothing_else() -> None:
    light, heavy = drawing((-1, -1, -1)), drawing((1, 1, 1))
    old, _ = rebase_baseline(learned(light), light.instrumented(), light.updating)
    new, _ = rebase_baseline(old, heavy.instrumented(), heavy.updating)
    np.testing.assert_allclose(new.model.modes().frequencies_hz, old.model.modes().frequencies_hz, rtol=0.01)
    ratio = new.model.structure.stiffness_n_per_m / old.model.structure.stiffness_n_per_m
    np.testing.assert_allclose(ratio, 1.05 / 0.95, rtol=0.02)


def test_a_baseline_whose_updating_did_not_converge_is_doubted(tmp_path: Path) -> None:
    place, config = tmp_path / "b.json", drawing((1, 1, -1))
    save_baseline(replace(learned(config), converged=False), place)
    (doubt,) = load(place, config).doubts
    assert doubt.startswith("the updating of the baseline b.json did not converge")
    save_baseline(learned(config), place)
    assert load(place, config).doubts == ()
