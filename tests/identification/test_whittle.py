"""Maximum-likelihood refinement: exact derivatives, better than its start, honest where it cannot work."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from monitor.core import ModalEstimate, Window
from monitor.identification import whittle
from monitor.identification.ssi import SsiSettings
from monitor.identification.stabilization import SelectionSettings, identify
from monitor.identification.whittle import RefinementSettings, refine
from monitor.identification.whittle_model import cross_spectra, layout_of, predict
from monitor.model import Model, ShearFrame, simulate
from monitor.signals import (
    LEAKAGE_OFFSETS,
    Conditioner,
    SegmentDesign,
    WindowGrid,
    leakage,
    overlap_correlation,
    taper,
    transform,
    windows as window,
)
from tests.support.simulated import PAPER_FRAME

FRAME = Model(PAPER_FRAME)


def windowed(values: np.ndarray) -> tuple[Window, ModalEstimate]:
    grid = WindowGrid.design(100.0, values.shape[0] / 100.0, 10.0, 50)
    _, windows = window.step(grid, window.start(grid, 3, index=0), values, 0)
    assert isinstance(windows[0], Window)
    modes = identify(windows[0], (0, 1, 2), FRAME.modes(), np.eye(3), SsiSettings(), SelectionSettings())
    assert isinstance(modes, ModalEstimate)
    return windows[0], modes


@pytest.fixture(scope="module")
def one() -> tuple[Window, ModalEstimate]:
    return windowed(simulate(FRAME, duration_s=400.0, rate_hz=100.0, noise=0.05, seed=2).floors)


def test_the_leakage_kernel_is_that_of_the_taper() -> None:
    n = 256
    power = np.abs(np.fft.fft(taper(n), 2 * n)) ** 2
    power /= power.sum()
    np.testing.assert_allclose(leakage(), power[LEAKAGE_OFFSETS], atol=1e-3)


def test_the_overlap_correlation_is_that_of_the_taper() -> None:
    power = taper(256) ** 2
    assert overlap_correlation() == pytest.approx((power[:128] * power[128:]).sum() / (power**2).sum())


def test_the_transform_has_the_density_of_white_noise() -> None:
    noise = np.random.default_rng(0).standard_normal((200, 512, 2))
    design = SegmentDesign(100.0, 512, 200)
    density = np.mean([np.abs(transform(design, x)) ** 2 for x in noise], axis=0)[5:]
    assert density.mean() == pytest.approx(1.0 / 100.0, rel=0.02)


def test_slopes_are_the_derivatives_of_the_model(one: tuple[Window, ModalEstimate]) -> None:
    item, modes = one
    layout = layout_of(modes, 12.0, len(item.segments[0]), item.segment_bin_hz)
    point = whittle.starting_point(layout, modes, cross_spectra(layout, item.segments).mean(axis=0))
    spectrum = predict(layout, point)
    half = np.einsum("ap,kbp->pkab", spectrum.u, spectrum.v.conj())
    slopes = np.add.reduceat(half + half.conj().swapaxes(-1, -2), layout.columns)
    for i in range(len(slopes)):
        step = np.zeros(len(slopes))
        size = min(1e-4, 1e-6 * np.abs(spectrum.value).max() / np.abs(slopes[i]).max())
        step[i] = size
        up = predict(layout, whittle.take_step(layout, point, step)).value
        down = predict(layout, whittle.take_step(layout, point, -step)).value
        np.testing.assert_allclose((up - down) / (2 * size), slopes[i], atol=2e-4 * np.abs(slopes[i]).max())


def test_a_pool_of_the_model_is_the_mean_of_its_bins(one: tuple[Window, ModalEstimate]) -> None:
    item, modes = one
    pooled = layout_of(modes, 12.0, len(item.segments[0]), item.segment_bin_hz)
    point = whittle.starting_point(pooled, modes, cross_spectra(pooled, item.segments).mean(axis=0))
    single = layout_of(modes, 12.0, len(item.segments[0]), item.segment_bin_hz, pool_width=0.0)
    assert (single.sizes == 1).all()
    assert single.sizes.sum() == pooled.sizes.sum() > 3 * pooled.sizes.size
    begins = np.searchsorted(single.first, pooled.first)
    means = np.add.reduceat(predict(single, point).value, begins) / pooled.sizes[:, None, None]
    size = np.einsum("kaa->k", means).real
    error = np.abs(predict(pooled, point).value - means).max(axis=(1, 2)) / size
    # To a small part of what a pool's own scatter over 400 s leaves uncertain.
    assert error.max() < 0.01


def test_refinement_gains_where_the_level_wanders() -> None:
    """The same records: smaller errors in frequency than the subspace estimate's, over modes and records."""
    errors = []
    for seed in range(12):
        floors = simulate(FRAME, duration_s=400.0, rate_hz=100.0, noise=0.05, level_spread=0.35, seed=40 + seed).floors
        item, modes = windowed(floors)
        refined = refine(item, modes, RefinementSettings())
        assert refined.refined
        truth = FRAME.modes().frequencies_hz
        errors.append((modes.frequencies_hz / truth - 1, refined.frequencies_hz / truth - 1))
    rms = np.sqrt((np.array(errors) ** 2).mean(axis=0))  # (2, modes)
    bound = np.array([0.88e-3, 0.50e-3, 0.47e-3])  # Cramer-Rao, 400 s
    assert (rms[1] / bound).mean() < (rms[0] / bound).mean()
    assert (rms[1] / bound).mean() < 1.3


def test_the_covariance_is_the_models_where_the_scatter_agrees_with_it() -> None:
    """A covariance read off 39 segments alone has standard deviations that scatter by 11 %; shrunk, by less than half."""
    rng = np.random.default_rng(5)
    mix = rng.standard_normal((12, 12))
    model = mix @ mix.T
    scattered, shrunk = [], []
    for _ in range(200):
        influence = rng.standard_normal((39, 12)) @ mix.T / np.sqrt(39.0)
        influence -= influence.mean(axis=0)
        rows, factor = whittle.shrunk_uncertainty(influence, model)
        np.testing.assert_allclose(factor.T @ factor, model)
        scattered.append(np.sqrt(np.diag(influence.T @ influence)))
        shrunk.append(np.sqrt(np.diag(rows.T @ rows)))
    spread = [np.mean(np.std(x, axis=0) / np.mean(x, axis=0)) for x in (scattered, shrunk)]
    assert spread[1] < 0.5 * spread[0]
    truth = np.sqrt((1.0 + 2.0 * overlap_correlation()) * np.diag(model))
    np.testing.assert_allclose(np.mean(shrunk, axis=0) / truth, 1.0, atol=0.02)


def test_the_covariance_is_the_scatters_where_the_model_is_wrong() -> None:
    rng = np.random.default_rng(6)
    wide = np.array([4.0] + [1.0] * 11)  # one direction scatters four times as much as the model says
    rows, _ = whittle.shrunk_uncertainty(rng.standard_normal((400, 12)) * wide / 20.0, np.eye(12))
    std = np.sqrt((rows**2).sum(axis=0)) / np.sqrt(1.0 + 2.0 * overlap_correlation())
    assert std[0] == pytest.approx(4.0, rel=0.15)
    np.testing.assert_allclose(std[1:], 1.0, atol=0.2)


def test_the_covariance_stands_where_segments_are_few() -> None:
    rng = np.random.default_rng(7)
    variance = []
    for _ in range(100):
        influence = rng.standard_normal((8, 12)) / np.sqrt(8.0)
        rows, _ = whittle.shrunk_uncertainty(influence - influence.mean(axis=0), np.eye(12))
        assert rows.shape == (8, 12)
        variance.append((rows**2).sum(axis=0))
    np.testing.assert_allclose(np.mean(variance, axis=0), 1.0 + 2.0 * overlap_correlation(), rtol=0.15)


def test_coloured_excitation_does_not_bend_the_modes() -> None:
    """Forces whose density falls to a half at 10 Hz: taken for white, they move the third mode by several deviations."""
    truth, z = FRAME.modes().frequencies_hz, []
    pole = np.exp(-2.0 * np.pi * 10.0 / 400.0)
    for seed in range(4):
        white = simulate(FRAME, duration_s=400.0, rate_hz=400.0, noise=0.0, seed=80 + seed).floors
        coloured = lfilter([1.0 - pole], [1.0, -pole], white, axis=0)
        noise = 0.05 * coloured.std() * np.random.default_rng(seed).standard_normal(coloured.shape)
        conditioner = Conditioner.design(400.0, 100.0, 40.0, 10.0)
        _, values = conditioner.step_block(conditioner.start(3), coloured + noise)
        refined = refine(*windowed(values), RefinementSettings())
        assert refined.refined
        z.append((refined.frequencies_hz - truth) / refined.frequencies_std_hz)
    assert np.abs(np.mean(z, axis=0)).max() < 1.5  # a standard deviation of 0.5


def test_bands_that_reach_to_zero_frequency_are_fitted() -> None:
    damped = Model(ShearFrame(FRAME.structure.masses_kg, FRAME.structure.stiffness_n_per_m, 0.06))
    floors = simulate(damped, duration_s=400.0, rate_hz=100.0, noise=0.05, seed=3).floors
    refined = refine(*windowed(floors), RefinementSettings())
    assert refined.refined
    z = (refined.frequencies_hz - FRAME.modes().frequencies_hz) / refined.frequencies_std_hz
    assert np.abs(z[:1]).max() < 4.0


def test_too_few_segments_leave_the_subspace_estimate(one: tuple[Window, ModalEstimate]) -> None:
    item, modes = one
    assert refine(item, modes, RefinementSettings(min_segments=100)) is modes
    assert refine(item, modes, RefinementSettings(enabled=False)) is modes


def test_data_without_variance_leave_the_subspace_estimate(one: tuple[Window, ModalEstimate]) -> None:
    item, modes = one
    still = Window(**{f: getattr(item, f) for f in Window.__slots__} | {"segments": np.zeros_like(item.segments)})
    assert refine(still, modes, RefinementSettings()) is modes


def test_a_source_without_room_above_the_band_is_refined_too() -> None:
    """At 100 Hz the noise hides below the response; the fit must neither warn nor give up."""
    refined = 0
    for seed in range(4):
        floors = simulate(FRAME, duration_s=400.0, rate_hz=100.0, noise=0.01, seed=60 + seed).floors
        refined += refine(*windowed(floors), RefinementSettings()).refined
    assert refined == 4
