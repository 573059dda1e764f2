"""Forces and a ground that come and go each by itself, noise that follows the motion: none of them is a cause."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag

from drivers.base import ACCELERATION
from monitor.core import Array
from monitor.diagnosis import DiagnosisSettings, diagnose
from monitor.diagnosis.healthy_prior import learn_prior
from monitor.diagnosis.lack_of_fit import drift_bands, find_changed_effects
from monitor.diagnosis.score_test import _line_offset, candidate_starts
from monitor.inference.force_levels import fit_levels, ground_levels, spectra_by_force
from monitor.inference.map_estimate import MapEstimate
from monitor.inference.observed_spectra import ObservedSpectra, classify
from monitor.inference.posterior import Posterior
from monitor.inference.segments import gather
from monitor.model import Model, ModelDiscrepancy, parse_effect, prior_from_drawing, simulate
from monitor.runs import cut_into_blocks
from monitor.signals import hann_amplitude
from tests.support.jointed_frame import CONFIG, RATE, posed

pytestmark = pytest.mark.engine

GROUND = parse_effect("base_excitation:base:share=0.4")


@pytest.fixture(scope="module")
def shaken() -> tuple[Posterior, MapEstimate]:
    return posed(parse_effect("stiffness_change:story 1:relative=0.001"))


def test_parts_add_up_and_their_levels_are_found(shaken: tuple[Posterior, MapEstimate]) -> None:
    problem, null = shaken
    parts = spectra_by_force(problem, null.x, (GROUND,))
    predicted = problem.scatter(null.x, (GROUND,))
    k, true = 2, np.array([0.5, 1.4, 1.0, 2.0])
    noise = predicted[k] - parts[:, k].sum(axis=0)
    assert np.abs(noise - np.einsum("fab,ab->fab", noise, np.eye(3))).max() < 1e-9 * np.abs(predicted[k]).max()
    data = np.tensordot(true, parts[:, k], axes=1) + noise
    assert fit_levels(parts[:, k], noise, data) == pytest.approx(true, rel=1e-3)


def test_noise_that_a_sensor_adds_is_no_part_of_the_error_of_the_healthy_model(
    shaken: tuple[Posterior, MapEstimate],
) -> None:
    """A baseline that predicts three times too much between the modes had noise of 1.06 m/s^2 told as 1.65."""
    problem, null = shaken
    hz = problem.observed.band.hz
    error = ModelDiscrepancy(hz, np.full((hz.size, 1, 1), -0.6) * np.eye(3), np.full(hz.size, 0.01))
    at = replace(problem, prior=replace(problem.prior, error=error))
    noise = parse_effect("sensor_noise:channel a2:rms_m_s2=0.3")
    healthy, noisy = at.scatter(null.x, ()), at.scatter(null.x, (noise,))
    np.testing.assert_allclose(healthy, 0.4 * problem.scatter(null.x, ()), rtol=1e-9)
    added = noisy - healthy
    density = 0.3**2 / at.context.rate_hz * problem.observed.band.gain
    np.testing.assert_allclose(added[..., 1, 1], np.tile(density, (len(added), 1)), rtol=1e-6)
    assert np.abs(added[..., 0, 0]).max() < 1e-9 * density.max()


def test_a_ground_may_shake_more_in_one_class_than_in_another(shaken: tuple[Posterior, MapEstimate]) -> None:
    problem, null = shaken
    true = np.linspace(0.5, 1.5, problem.n_classes)
    there = replace(
        problem, conditions=tuple(replace(c, ground=g) for c, g in zip(problem.conditions, true, strict=True))
    )
    seen = replace(problem.observed, spectra=there.scatter(null.x, (GROUND,)))
    found = ground_levels(replace(problem, observed=seen), null.x, (GROUND,))
    assert found / found[0] == pytest.approx(true / true[0], rel=1e-3)
    # On the mean over time the share is what it was.
    weight = seen.counts * np.exp(null.x[problem.layout.levels])
    assert found @ weight / weight.sum() == pytest.approx(1.0, rel=0.05)


def test_wind_that_moves_from_floor_to_floor_is_no_drift(shaken: tuple[Posterior, MapEstimate]) -> None:
    problem, null = shaken
    e = problem.observed
    late = e.t_s > np.median(e.t_s)
    values = e.segments.values.copy()
    rng = np.random.default_rng(3)
    for half, factors in ((late, [0.6, 1.0, 1.5]), (~late, [1.5, 1.0, 0.6])):
        x = null.x.copy()
        x[problem.layout.forces] += 2.0 * np.log(factors)
        spectra = problem.scatter(x, ())
        for k, members in enumerate(e.members):
            these = members[half[members]]
            root = np.linalg.cholesky(spectra[k])
            white = rng.standard_normal((2, len(these), *root.shape[:2])) / np.sqrt(2.0)
            values[these] = np.einsum("fab,sfb->sfa", root, white[0] + 1j * white[1])
    made = replace(problem, observed=replace(e, segments=replace(e.segments, values=values)))
    assert np.abs(drift_bands(made, null)).max() < 6.0


def test_a_line_is_found_between_its_bins() -> None:
    bins = np.arange(20.0)
    for at in (10.0, 10.24, 9.76, 10.49):
        power = np.asarray(hann_amplitude(bins - at)) ** 2
        k = int(power.argmax())
        assert k + _line_offset(power, k) == pytest.approx(at, abs=1e-6)
    assert _line_offset(-np.ones(5), 2) == 0.0
    assert _line_offset(np.array([1.0, 0.5]), 0) == 0.0


def test_what_stood_at_calibration_and_changed_is_told(shaken: tuple[Posterior, MapEstimate]) -> None:
    problem, null = shaken
    joints, known = parse_effect("joint_flexibility:frame:girder_to_column_ratio=10"), problem.prior
    mean = np.append(known.mean, joints.coordinates)
    standing = replace(
        known,
        model=replace(known.model, effects=(joints,)),
        mean=mean,
        precision=block_diag(known.precision, np.eye(1) / 0.002**2),
    )
    there = replace(problem, prior=standing)
    for ratio, told in ((9.9, []), (6.0, ["joint flexibility of frame"])):
        x = problem.layout.with_structure(null.x, np.append(null.x[problem.layout.structure], 1.0 / ratio))
        assert [m.where for m in find_changed_effects(there, replace(null, x=x), DiagnosisSettings())] == told


def test_where_a_law_bends_no_other_is_tried(shaken: tuple[Posterior, MapEstimate]) -> None:
    problem, null = shaken
    law = parse_effect("cubic_stiffness:story 2:k3_n_per_m3=1e6")
    tried = {
        (e.name, e.location)
        for e in candidate_starts(problem, replace(null, effects=(law,)), [("cubic_stiffness", "story 2")])
    }
    assert ("gap_contact", "story 2") not in tried
    assert {("gap_contact", "story 1"), ("stiffness_change", "story 2")} <= tried


def test_noise_that_follows_each_channels_motion_is_no_cause() -> None:
    """Healthy and later forces differ by floor, so that noise of five percent of each channel does too."""
    config = CONFIG
    context = config.instrumented().context(RATE)

    def evidence(factor: Array, seed: int) -> ObservedSpectra:
        model = Model(config.model().structure)
        floors = simulate(model, duration_s=200.0, rate_hz=RATE, noise=0.0, seed=seed, context=context).floors
        noise = 0.05 * floors.std(axis=0) * factor
        floors = floors + noise * np.random.default_rng([seed, 9]).standard_normal(floors.shape)
        return classify(
            gather(cut_into_blocks(ACCELERATION, floors, config.channels, RATE, 10**18, 128), config.front_end())
        )

    healthy = evidence(np.ones(3), 1)
    known, _ = learn_prior(healthy, prior_from_drawing(config.model(), np.full(6, 0.002), 3), context, config.diagnosis)
    later = diagnose(evidence(np.array([1.0, 1.0, 1.25]), 2), known, context, config.diagnosis)
    assert later.verdict == "none"
    noisy = diagnose(evidence(np.array([1.0, 1.0, 5.0]), 3), known, context, config.diagnosis)
    assert [(c.effect.name, c.effect.location) for c in noisy.causes] == [("sensor_noise", "channel a3")]
