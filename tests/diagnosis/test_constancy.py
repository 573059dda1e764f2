"""What ranges say together of a coordinate, on fits of which all is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from monitor.diagnosis.constancy import CommonSize, LinearFit, common_size, products, products_of_channels

ROWS, P, RANGES = 600, 5, 6


def fitted(seed: int, deviation: float = 0.0, size: float = 1.0, noise: float = 1.0) -> tuple[CommonSize, float]:
    """A linear fit of noise; coordinate 0 deviates from range to range by `deviation`.  Return its common size and the fitted."""
    rng = np.random.default_rng(seed)
    slopes = rng.standard_normal((ROWS, P))
    slopes[:, 0] += 0.5 * slopes[:, 1]
    block = np.arange(ROWS) * RANGES // ROWS
    sizes = size + deviation * rng.standard_normal(RANGES)
    data = slopes[:, 0] * sizes[block] + noise * rng.standard_normal(ROWS)
    covariance = np.linalg.inv(slopes.T @ slopes)
    x = covariance @ slopes.T @ data
    rows = np.column_stack([slopes, data - slopes @ x])
    return common_size(products(rows[:, None]), 0, covariance), float(x[0])


def test_a_right_model_is_rejected_as_often_as_stated() -> None:
    found = [fitted(seed)[0] for seed in range(1000)]
    rejected = np.mean([chi2.sf(one.statistic, one.rank) < 0.05 for one in found])
    assert 0.03 < rejected < 0.07
    assert {one.rank for one in found} == {RANGES - 1}


@pytest.mark.parametrize(
    ("deviation", "noise", "least"), [(0.0, 1.0, 0.93), (0.3, 1.0, 0.9), (1.0, 1.0, 0.9), (0.0, np.sqrt(30.0), 0.9)]
)
def test_intervals_hold_what_the_model_does_not_know(deviation: float, noise: float, least: float) -> None:
    """Sizes that differ by three and ten times their error in a range, and spectra whose variance is wrong by a factor of 30."""
    found = [fitted(seed, deviation, noise=noise) for seed in range(500)]
    errors = np.array([(x - 1.0) / common.std for common, x in found])
    assert least < np.mean(np.abs(errors) < 1.96) < 0.98


@pytest.mark.parametrize(("deviation", "noise"), [(0.0, 1.0), (0.3, 1.0), (1.0, 1.0), (0.0, np.sqrt(30.0))])
def test_what_is_not_there_is_hardly_ever_certain(deviation: float, noise: float) -> None:
    """Once in a hundred by chance 0.5 % of either sign; the seeds allow for three times that."""
    chances = [common.chance_of_none(x) for common, x in (fitted(seed, deviation, 0.0, noise) for seed in range(1000))]
    assert np.mean(np.array(chances) < 0.5e-2) < 3e-2


def test_what_is_there_stays_certain() -> None:
    common, x = fitted(3)
    assert common.std == pytest.approx(1.0 / np.sqrt(ROWS), rel=0.1)
    assert common.chance_of_none(x) < 1e-9 and common.chance_of_none(-x) < 1e-9
    for_nothing, x = fitted(3, size=0.0)
    assert for_nothing.chance_of_none(x) > 0.01


def test_a_coordinate_that_only_the_prior_knows_has_its_own_interval() -> None:
    common = common_size(np.tile(np.diag([0.0, 1.0]), (10, 1, 1)), 0, np.eye(1))
    assert (common.std, common.rank) == (pytest.approx(1.0), 0)


def spectra_of(seed: int, p: int = 4) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Spectra of three channels, p slopes of them, and the root of the information."""
    rng = np.random.default_rng(seed)

    def hermitian(*shape: int) -> np.ndarray:
        x = rng.standard_normal((*shape, 3, 3)) + 1j * rng.standard_normal((*shape, 3, 3))
        return np.asarray(x + x.conj().swapaxes(-1, -2))

    root = hermitian(2, 5)
    return root @ root.conj().swapaxes(-1, -2) + np.eye(3), hermitian(p, 2, 5), rng.uniform(1.0, 2.0, (2, 5))


def whiten(spectra: np.ndarray, slopes: np.ndarray, root: np.ndarray) -> np.ndarray:
    """Whitened slopes as real rows, in the order of the posterior's: the lower triangle, row by row."""
    inverse = np.linalg.inv(np.linalg.cholesky(spectra))
    whitened = root[..., None, None] * (inverse @ slopes @ inverse.conj().swapaxes(-1, -2))
    rows = []
    for i in range(spectra.shape[-1]):
        for j in range(i):
            rows += [np.sqrt(2.0) * whitened[..., i, j].real, np.sqrt(2.0) * whitened[..., i, j].imag]
        rows.append(whitened[..., i, i].real)
    return np.stack(rows, axis=-1).reshape(len(slopes), -1).T


def test_what_is_lost_without_a_channel_is_what_the_others_alone_do_not_say() -> None:
    """Against whitening the sub-array's spectra and means directly."""
    predicted, slopes, root = spectra_of(1)
    rng, label = np.random.default_rng(2), np.array([0, 1, 1])
    means = rng.standard_normal((4, 3, 5, 3)) + 1j * rng.standard_normal((4, 3, 5, 3))

    def said(channels: list[int]) -> np.ndarray:
        these = np.ix_(channels, channels)
        part = predicted[..., these[0], these[1]]
        rows = whiten(part, slopes[..., these[0], these[1]], root)
        whitened = np.linalg.solve(np.linalg.cholesky(part)[label], means[..., channels, None])
        flat = np.concatenate([whitened.real.reshape(4, -1), whitened.imag.reshape(4, -1)], axis=1)
        return np.asarray(rows.T @ rows + flat @ flat.T)

    whole = whiten(predicted, slopes, root).reshape(2, 5, 9, 4)
    of_means = np.linalg.solve(np.linalg.cholesky(predicted)[label], means[..., None])[..., 0]
    lost = products_of_channels(predicted, whole, np.moveaxis(of_means, 0, -1), label)
    for channel, of_channel in enumerate(lost):
        others = [i for i in range(3) if i != channel]
        np.testing.assert_allclose(said([0, 1, 2]) - of_channel, said(others), rtol=1e-9, atol=1e-9)


def without_a_channel(*of_each: tuple[float, float]) -> tuple[CommonSize, ...]:
    """Sizes without each of two channels that measure one coordinate, each with a value and an information."""
    values, information = np.array(of_each).T
    size = float(values @ information / information.sum())
    alone = np.array([[[n, n * (x - size)], [0.0, 0.0]] for x, n in of_each])
    alone[:, 1] = alone[:, :, 1]
    some = np.zeros((1, 2, 2))
    return LinearFit(np.eye(1) / information.sum(), np.zeros(1), np.zeros(1), some, some, alone).common_sizes(0)[2:]


def test_a_size_that_one_channel_alone_wants_may_be_none() -> None:
    wanted = without_a_channel((3.0, 400.0), (0.0, 100.0))  # fitted: 2.4
    assert wanted[0].chance_of_none(2.4) == pytest.approx(0.5)
    assert wanted[1].chance_of_none(2.4) < 1e-9  # the faulty channel, alone
    agreed = without_a_channel((3.0, 400.0), (3.1, 100.0))
    assert [(one.rank, one.std) for one in agreed] == [(0, pytest.approx(500.0**-0.5))] * 2


def test_what_the_other_channels_cannot_see_is_left_as_it_was() -> None:
    """As a fault of the channel itself, whatever the prior says of its size."""
    gain = np.array([[[400.0, 0.0], [0.0, 0.0]], np.zeros((2, 2))])
    fit = LinearFit(np.eye(1) / 401.0, np.ones(1), np.array([-9.0]), gain[:1], gain[:1], gain)
    assert [one.chance_of_none(9.0) < 1e-9 for one in fit.common_sizes(0)] == [True] * 4
