"""Deviations of a window's blocks from their mean: those of the direct sums of the samples."""

from __future__ import annotations

import numpy as np

from monitor.identification.kernels import scatter
from tests.support.simulated import whole_window

N, SIZE, LAGS = 200, 20, 6


def test_deviations_of_the_blocks_are_those_of_the_direct_sums() -> None:
    samples = np.random.default_rng(1).normal([3.0, -1.0], size=(N, 2))
    sums, v = whole_window(samples, 100.0, SIZE, LAGS).sums, samples - samples.mean(axis=0)
    used = N - LAGS + 1  # every lag sums the same number of products
    spans = [np.arange(b, min(b + SIZE, used)) for b in range(0, N, SIZE)]
    blocks = np.array([[v[k].T @ v[k + tau] for tau in range(LAGS)] for k in spans])
    share = (sums.counts / sums.counts.sum())[:, None, None, None]
    wanted = (blocks - share * blocks.sum(axis=0))[:, 1:, [1, 0]].transpose(1, 2, 3, 0)
    found = scatter(sums.products, sums.shifted, sums.mean, sums.counts, np.array([1, 0]))
    np.testing.assert_allclose(found, wanted, atol=1e-10 * np.abs(v).max() ** 2 * N)
