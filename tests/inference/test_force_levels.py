"""Forces and a ground that come and go each by itself, noise that follows the motion: none of them is a cause."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from monitor.diagnosis import diagnose, healthy_prior
from monitor.inference.force_levels import fit_levels, ground_levels, spectra_by_force
from monitor.inference.map_estimate import MapEstimate
from monitor.inference.observed_spectra import ObservedSpectra, classify
from monitor.inference.posterior import Posterior
from monitor.model import ModelDiscrepancy, parse_effect
from tests.diagnosis.jointed_frame import CONFIG, CONTEXT, known, posed, recorded

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


def test_noise_that_follows_each_channels_motion_is_no_cause() -> None:
    """Healthy and later forces differ by floor, so that noise of five percent of each channel does too."""

    def evidence(factor: list[float], seed: int) -> ObservedSpectra:
        motion = recorded(seed=seed, duration_s=200.0, noise=0.0)
        noise = 0.05 * motion.rms.mean(axis=0) * factor
        effects = [f"sensor_noise:channel a{j}:rms_m_s2={rms}" for j, rms in enumerate(noise, start=1)]
        return classify(recorded(*effects, seed=seed, duration_s=200.0, noise=0.0))

    healthy = evidence([1.0, 1.0, 1.0], 1)
    reference, _ = healthy_prior.learn_prior(healthy, known(), CONTEXT, CONFIG.diagnosis)
    later = diagnose(evidence([1.0, 1.0, 1.25], 2), reference, CONTEXT, CONFIG.diagnosis)
    assert later.verdict == "none"
    noisy = diagnose(evidence([1.0, 1.0, 5.0], 3), reference, CONTEXT, CONFIG.diagnosis)
    assert [(c.effect.name, c.effect.location) for c in noisy.causes] == [("sensor_noise", "channel a3")]
