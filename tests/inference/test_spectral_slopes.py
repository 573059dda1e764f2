"""Slopes of the spectra by one solution of the linear system, and their products, against finite differences and whole rows."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from monitor.inference import Posterior, with_coordinates
from monitor.inference.ambient_posterior import _slope
from monitor.inference.spectral_slopes import joint_directions, whitening_roots
from monitor.inference.system_slopes import modal_changes
from monitor.inference.wishart import grown_by
from monitor.model import Effect, System, parse_effect
from tests.support.turning_frame import TORSION, posterior

COUPLED = parse_effect(
    "unmodelled_mode:frame:frequency_hz=9.0,damping_ratio=0.02,shape_1=1.0,shape_2=0.8,shape_3=0.45,"
    "force_ratio=0.6,eccentricity_1=-0.361,eccentricity_2=-0.325,eccentricity_3=-0.167,"
    "force_arm_1=-0.3,force_arm_2=0.25,force_arm_3=0.0"
)
EFFECTS = (
    COUPLED,
    *TORSION,
    parse_effect("attached_oscillator:floor 1:mass_kg=0.05,frequency_hz=7.0,damping_ratio=0.03"),
    parse_effect("stiffness_change:story 2:relative=-0.05"),
    parse_effect("added_mass:floor 3:mass_kg=0.1"),
    parse_effect("sensor_gain:channel a2:gain=1.05"),
    parse_effect("time_offset:channel a1:seconds=0.003"),
    parse_effect("coloured_excitation:frame:corner_hz=20.0"),
)
TONE = parse_effect("harmonic_excitation:floor 2:frequency_hz=12.3,force_n=0.01")


@pytest.fixture(scope="module")
def at() -> Posterior:
    return posterior(np.ones(3))


def point(at: Posterior, effects: tuple[Effect, ...]) -> np.ndarray:
    x = np.concatenate([at.prior.mean, np.zeros(at.layout.n_nuisance - at.prior.mean.size)])
    x[at.layout.levels] = np.linspace(-0.5, 0.5, at.n_classes)
    x[at.layout.noise] = -4.0
    return np.concatenate([x, *[e.coordinates for e in effects]])


@pytest.mark.parametrize("effects", [EFFECTS, (COUPLED, TONE)], ids=["many effects", "a tone"])
def test_slopes_are_those_of_finite_differences(at: Posterior, effects: tuple[Effect, ...]) -> None:
    x, middle = point(at, effects), at.n_classes // 2
    slopes = at.slopes(x, effects, at.scatter(x, effects))
    # The frequencies of tones and of modes that are not coupled are moved by finite steps, which are far on a narrow peak.
    names = [(e, p.name) for e in effects for p in e.parameters]
    far = [j for j, (e, name) in enumerate(names) if name == "frequency_hz" and e in (*TORSION, TONE)]
    for i in np.delete(np.arange(x.size), np.array(far, dtype=int) + at.layout.n_nuisance):
        step = 1e-6 * np.eye(x.size)[i] * max(abs(x[i]), 1.0)
        ends = [(x + d, with_coordinates(effects, (x + d)[at.layout.effects])) for d in (step, -step)]
        above, below = (at.scatter(moved, e, classes=[middle])[0] for moved, e in ends)
        expected = (above - below) / (2.0 * step[i])
        if i in range(x.size)[at.layout.levels] and i != at.layout.levels.start + middle:
            continue  # it moves another class
        # The slopes by noise leave out the gain of the lowpass, which is one but for the band's end.
        is_noise = i == at.layout.noise or i in range(x.size)[at.layout.channel_noise]
        assert np.abs(slopes[i, middle] - expected).max() < (2e-2 if is_noise else 5e-3) * np.abs(expected).max(), i


@pytest.mark.parametrize("effects", [(), (*TORSION, EFFECTS[6], EFFECTS[8])], ids=["none", "of sensors and forces"])
def test_slopes_of_a_linear_structure_are_exact(at: Posterior, effects: tuple[Effect, ...]) -> None:
    basis = np.stack([np.diag([1.0, 2.0, 3.0]), np.ones((3, 3))])
    mean, ends = at.prior.mean, np.cumsum([0, *at.prior.sizes])
    at = replace(
        at,
        prior=replace(
            at.prior,
            basis=basis,
            mean=np.insert(mean, ends[4], [30.0, -20.0]),
            precision=np.eye(mean.size + 2),
        ),
    )
    x = point(at, effects)
    x[at.layout.masses] += [0.1, -0.2, 0.3]
    everything = at.effects(x, effects)
    turn, exact = at._exact_changes(x, everything, at.system(x, everything))
    layout, i = at.layout, range(x.size)
    assert set(exact) == {*i[layout.stiffness], *i[layout.masses], *i[layout.damping], *i[layout.correction]}
    for j, change in exact.items():
        step = 1e-5 * np.eye(x.size)[j] * max(abs(x[j]), 1.0)
        above, below = (at.system(x + d, at.effects(x + d, effects)) for d in (step, -step))
        for name, own in zip(("mass", "damping", "stiffness"), change, strict=True):
            expected = (getattr(above, name) - getattr(below, name)) / (2.0 * step[j])
            np.testing.assert_allclose(
                turn @ own @ turn.T, expected, rtol=0.0, atol=1e-6 * np.abs(getattr(above, name)).max()
            )


def test_where_two_modes_have_one_frequency_or_an_effect_changes_the_structure_no_slope_is_exact(at: Posterior) -> None:
    one = System(np.eye(2), 0.02 * np.eye(2), np.eye(2))
    assert modal_changes(one, np.full(2, 0.01), np.zeros((1, 2, 2)), np.ones((1, 2, 2))) is None
    x, everything = point(at, EFFECTS), at.effects(point(at, EFFECTS), EFFECTS)
    assert at._exact_changes(x, everything, at.system(x, everything)) == (None, {})


def test_information_and_products_are_those_of_the_whitened_rows(at: Posterior) -> None:
    x = point(at, EFFECTS)
    prediction = at.predict(x, EFFECTS)
    found, residual, _ = at.linearized(x, EFFECTS, prediction)
    rows = at.whitened(prediction.spectra, at.slopes(x, EFFECTS, prediction.spectra), prediction.data)[0]
    size = np.linalg.norm(rows, axis=0)
    assert np.abs((found.information - rows.T @ rows) / np.outer(size, size)).max() < 1e-10
    assert np.abs((found.along(residual) - rows.T @ residual) / size).max() < 1e-8 * np.linalg.norm(residual)
    both = np.stack([residual, rows[:, 3]], axis=1)
    assert found.along(both)[:, 0] == pytest.approx(found.along(residual))
    some = np.array([2, 5, 30])
    assert found.by(some).along(residual) == pytest.approx(found.along(residual)[some])
    assert found.by(some).information == pytest.approx(found.information[np.ix_(some, some)])


def test_classes_of_one_model_share_directions_and_others_do_not(at: Posterior) -> None:
    x = point(at, EFFECTS)
    spectra, root = at.scatter(x, EFFECTS), at.root_information()
    assert joint_directions(whitening_roots(spectra, root)) is not None
    spectra[1] = at.scatter(point(at, (COUPLED,)), (COUPLED,))[1]
    assert joint_directions(whitening_roots(spectra, root)) is None


def test_a_step_that_leaves_a_peak_of_no_power_is_shortened() -> None:
    """The slope of a peak of a mode of light damping, by a step that suits the other bins; else the baseline holds no numbers."""
    spectra = np.zeros((1, 2, 2, 2), dtype=complex)
    spectra[0] = np.eye(2) * np.array([1.0, 1e-7])[:, None, None]
    along = -np.broadcast_to(np.eye(2), spectra.shape).astype(complex)
    less = partial(grown_by, relative=np.broadcast_to(-0.6 * np.eye(2), spectra.shape).astype(complex))
    assert np.isnan(less(spectra + 1e-5 * along)[0, 1]).all()
    np.testing.assert_allclose(_slope(less, less(spectra), spectra, along, 1e-5), 0.4 * along, rtol=1e-6, atol=1e-12)
