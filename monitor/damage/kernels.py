"""Compiled loop of the alarm's test statistic."""

from __future__ import annotations

import numpy as np

from monitor.core import Array, compiled


@compiled()
def evidence_of_loss(
    means: Array, covariance: Array, model_form: float, significant: float, credit: float
) -> tuple[Array, Array]:
    """Compute the z-scores of `sequential_test.statistic`.

    Parameters
    ----------
    means : ndarray, shape (k, n)
    covariance : ndarray, shape (k, n, n)
    model_form : float
        Share of another story's change that may show in a story (one standard deviation).
    significant : float
        Distance up to which two stories' changes agree, in standard deviations.
    credit : float
        Standard deviations added to the z-score against a uniform change.

    Returns
    -------
    z, std : ndarray, shape (k, n)
        z-score of the loss, and standard deviation of the mean.
    """
    k, n = means.shape
    z, std = np.empty((k, n)), np.empty((k, n))
    leak, weight = np.zeros(n), np.zeros(n)
    for s in range(k):
        mean = means[s]
        for j in range(n):
            leak[j] = 0.0
            for i in range(n):
                leak[j] = max(leak[j], model_form * abs(mean[i])) if i != j else leak[j]
            std[s, j] = np.sqrt(covariance[s, j, j] + leak[j] ** 2)
            z[s, j] = mean[j] / std[s, j]
        for j in range(n if n > 1 else 0):
            least = 1 if j == 0 else 0  # the other story that changed least
            for i in range(n):
                if i != j and abs(mean[i]) < abs(mean[least]):
                    least = i
            for i in range(n):
                spread = np.sqrt(std[s, i] ** 2 + std[s, least] ** 2)
                agrees = i != j and abs(mean[i] - mean[least]) <= significant * spread
                weight[i] = 1.0 / std[s, i] ** 2 if agrees else 0.0
            contrast = -weight / weight.sum()
            contrast[j] = 1.0
            difference, square = 0.0, 0.0
            for i in range(n):
                difference += contrast[i] * mean[i]
                square += (contrast[i] * leak[i]) ** 2
                for other in range(n):
                    square += contrast[i] * covariance[s, i, other] * contrast[other]
            z[s, j] = min(z[s, j], difference / np.sqrt(square) + credit)
    return z, std
