"""Compiled loops of the alarm's test statistic and of the smallest detectable loss."""

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


@compiled()
def lower_to_needed(
    wanted: Array,
    error: Array,
    alone: Array,
    share: Array,
    against_none: Array,
    leak: Array,
    square: Array,
    min_loss: float,
) -> None:
    """Lower the losses wanted so far to those that the alarm's statistic sees over one more stretch, in place.

    Parameters
    ----------
    wanted : ndarray, shape (trials, looks, n)
        Smallest loss of each story at which any stretch so far is significant.
    error : ndarray, shape (trials, looks, n)
        Errors of the means over the stretch.
    alone : ndarray, shape (trials, looks, n)
        Error of each story beyond what the others say that all stories have in common; of no use for one story.
    share : ndarray, shape (looks,)
        Share of the stretch that lies behind the loss.
    against_none : ndarray, shape (n,)
        Mean that is significant against no change.
    leak, square : ndarray, shape (n,)
        Coefficients of the quadratic equation for the mean that is significant against a change of all stories alike.
    min_loss : float
        Least loss that is announced.
    """
    trials, looks, n = wanted.shape
    for t in range(trials):
        for k in range(looks):
            for j in range(n):
                e = error[t, k, j]
                loss = max(against_none[j] - e, min_loss - e)
                if n > 1:
                    if leak[j] > 0.0:
                        a = alone[t, k, j]
                        root = np.sqrt(max(a * a - leak[j] * (a * a - square[j]), 0.0))
                        loss = max(loss, (root - a) / leak[j])
                    else:
                        loss = np.inf
                wanted[t, k, j] = min(wanted[t, k, j], loss / share[k])


@compiled()
def least_held(wanted: Array, held: int) -> Array:
    """Compute the smallest loss that is significant in `held` looks in a row, shape (trials, n).

    Parameters
    ----------
    wanted : ndarray, shape (trials, looks, n)
        Smallest loss that is significant at each look; `held` <= looks.
    """
    trials, looks, n = wanted.shape
    least = np.full((trials, n), np.inf)
    for t in range(trials):
        for j in range(n):
            for k in range(looks - held + 1):
                largest = wanted[t, k, j]
                for i in range(k + 1, k + held):
                    largest = max(largest, wanted[t, i, j])
                least[t, j] = min(least[t, j], largest)
    return least
