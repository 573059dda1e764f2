"""The healthy state as some of the channels see it: no bias between arrays looks like damage."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from monitor.damage import Baseline, damage_index
from monitor.damage.origin import Origin
from monitor.damage.updating import Observation, UpdatingSettings, predict
from monitor.model import Model, ShearFrame
from tests.support.results import modal_estimate

MASSES, STIFFNESS = np.array([0.3253, 0.3514, 0.3129]), np.array([2909.4511, 1514.8507, 1897.6986])
SENSORS = np.eye(3)
FRAME = Model(ShearFrame(MASSES, STIFFNESS, 0.01))
ARRAYS = [array for n in (1, 2) for array in itertools.combinations(range(3), n)]


def seen(model: Model, gauges: tuple[int, ...], channels: tuple[int, ...]) -> np.ndarray:
    """The measured vector of a model, without noise."""
    o = Observation(np.zeros(3 * len(channels)), np.eye(1), np.zeros((1, 1)), (0, 1, 2), gauges, True)
    return predict(model, SENSORS[list(channels)], o, with_masses=False)[0]


@pytest.fixture
def baseline() -> Baseline:
    """A model that is off: the frame moves otherwise than the model says by a misfit of some percent."""
    rng, gauges = np.random.default_rng(4), (0, 2, 1)
    z = seen(FRAME, gauges, (0, 1, 2))
    misfit, factor = rng.normal(scale=0.02, size=z.size), 1e-3 * rng.normal(size=(20, z.size))
    return Baseline(
        model=FRAME,
        covariance=np.zeros((6, 6)),
        z=z + misfit,
        z_covariance=factor.T @ factor,
        misfit=misfit,
        model_mode=(0, 1, 2),
        gauges=gauges,
        log=True,
        frequencies_hz=np.exp(0.5 * z[:3]) / (2.0 * np.pi),
        frequencies_std_hz=np.ones(3),
        damping_ratio=np.full(3, 0.01),
        channels=("a1", "a2", "a3"),
        floors=(1, 2, 3),
        windows=1,
        level_range_m_s2=(1.0, 1.0),
        origin=Origin("frame", "shear_frame", (), (), "", "m/s^2", None, None),
    )


@pytest.mark.parametrize("channels", ARRAYS)
def test_the_model_stands_in_it_as_before(baseline: Baseline, channels: tuple[int, ...]) -> None:
    reduced = baseline.seen_by(channels)
    assert reduced.channels == tuple(baseline.channels[k] for k in channels)
    np.testing.assert_allclose(reduced.z - reduced.misfit, seen(FRAME, reduced.gauges, channels), rtol=1e-9)
    shapes = np.ones((3, 3))
    shapes[np.arange(3) != np.array(baseline.gauges)[:, None]] = baseline.z[3:]
    for i, gauge in enumerate(reduced.gauges):
        own = shapes[i, list(channels)] / shapes[i, channels[gauge]]
        n = len(channels) - 1
        np.testing.assert_allclose(reduced.z[3 + i * n : 3 + (i + 1) * n], np.delete(own, gauge))


@pytest.mark.parametrize("channels", ARRAYS)
def test_its_covariance_is_that_of_the_reduced_quantities(baseline: Baseline, channels: tuple[int, ...]) -> None:
    """Against draws of the whole state, each of them reduced."""
    size = 1e-2
    small = replace(baseline, z_covariance=size**2 * baseline.z_covariance)
    draws = np.random.default_rng(5).multivariate_normal(small.z, small.z_covariance, size=4000)
    gauges = small.seen_by(channels).gauges
    reduced = [replace(small, z=z).seen_by(channels) for z in draws]
    assert all(r.gauges == gauges for r in reduced)
    expected = small.seen_by(channels).z_covariance
    found = np.cov([r.z for r in reduced], rowvar=False)
    np.testing.assert_allclose(np.sqrt(np.diag(found)), np.sqrt(np.diag(expected)), rtol=0.06)
    np.testing.assert_allclose(found, expected, atol=0.08 * np.diag(expected).max())


def test_all_channels_leave_it_as_it_is(baseline: Baseline) -> None:
    same = baseline.seen_by((0, 1, 2))
    assert same.z is baseline.z and same.z_covariance is baseline.z_covariance and same.gauges == baseline.gauges


@pytest.mark.parametrize("channels", ARRAYS)
@pytest.mark.parametrize("lost", [(0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.0, 0.05, 0.0)])
def test_the_index_is_that_of_the_change_whatever_array_sees_it(
    baseline: Baseline, channels: tuple[int, ...], lost: tuple[float, ...]
) -> None:
    """The same structure, its misfit included, seen by fewer channels: no change reads as none, a loss as itself."""
    reduced = baseline.seen_by(channels)
    now = seen(FRAME.with_stiffness(STIFFNESS * (1.0 - np.array(lost))), reduced.gauges, channels)
    z = now + reduced.misfit
    shapes = np.ones((3, len(channels)), dtype=complex)
    shapes[np.arange(len(channels)) != np.array(reduced.gauges)[:, None]] = z[3:]
    deviations = 1e-4 * np.random.default_rng(6).normal(size=(40, 3, 2 + 2 * len(channels)))
    hz = np.exp(0.5 * z[:3]) / (2.0 * np.pi)
    modes = modal_estimate(hz, shapes, deviations=deviations)
    sensors = SENSORS[list(channels)]
    _, reading = damage_index.step(modes, FRAME, reduced, sensors, UpdatingSettings(), prior_std=np.full(3, 0.2))
    np.testing.assert_allclose(reading.ddi, lost, atol=4e-3)
    assert (np.abs(reading.ddi - lost) < 3.0 * reading.ddi_std + 1e-4).all()
