"""Compiled loops of the alarm's test statistic and of the smallest detectable loss."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

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


@compiled(error_model="numpy")
def least_seen(
    total: Array,
    root: Array,
    off: Array,
    lengths: NDArray[np.int64],
    share: Array,
    against_none: Array,
    contrast: Array,
    leak: Array,
    square: Array,
    held: int,
    min_loss: float,
) -> Array:
    """Compute the smallest loss of each story that is significant in `held` looks in a row, shape (trials, n).

    At each look the loss must be significant over one of some stretches of windows, whose number is s.

    Parameters
    ----------
    total : ndarray, shape (trials, n, before + looks)
        Sums of standard normal increments up to each look: of the healthy data, then after the loss.
    root : ndarray, shape (n, n)
        Root of the increments' covariance, upper triangular, on the right.
    off : ndarray, shape (trials, n)
        Errors that all windows have in common.
    lengths : ndarray of int, shape (s,)
        Looks in each stretch; at most `before`.
    share : ndarray, shape (s, looks)
        Share of the stretch that lies behind the loss.
    against_none : ndarray, shape (s, n)
        Mean that is significant against no change.
    contrast : ndarray, shape (s, n, n)
        Each story less what the others say that all stories have in common.
    leak, square : ndarray, shape (s, n)
        Coefficients of the quadratic equation for the mean that is significant against a change of all stories alike; where
        `leak` is not positive, no mean is.
    held : int
        At most `looks`.
    min_loss : float
        Least loss that is announced.
    """
    trials, n, end = total.shape
    looks = share.shape[1]
    at = end - looks
    least, wanted = np.full((trials, n), np.inf), np.empty((n, looks))
    error, alone = np.empty((n, looks)), np.empty(looks)
    for t in range(trials):
        wanted[:] = np.inf
        for s in range(lengths.size):
            before = at - lengths[s]
            for j in range(n):
                error[j] = off[t, j]
                for i in range(j + 1):
                    factor = root[i, j] / lengths[s]
                    for k in range(looks):
                        error[j, k] += factor * (total[t, i, at + k] - total[t, i, before + k])
            for j in range(n):
                fraction, largest = leak[s, j], square[s, j]
                if n > 1 and not fraction > 0.0:
                    continue
                needed = max(against_none[s, j], min_loss)
                alone[:] = 0.0
                for i in range(n):
                    weight = contrast[s, j, i]
                    for k in range(looks):
                        alone[k] += weight * error[i, k]
                for k in range(looks):
                    loss = needed - error[j, k]
                    if fraction > 0.0:
                        a = alone[k]
                        under = a * a - fraction * (a * a - largest)
                        beyond = (np.sqrt(under if under > 0.0 else 0.0) - a) / fraction
                        loss = beyond if beyond > loss else loss
                    loss /= share[s, k]
                    wanted[j, k] = loss if loss < wanted[j, k] else wanted[j, k]
        for j in range(n):
            for k in range(looks - held + 1):
                highest = wanted[j, k]
                for i in range(k + 1, k + held):
                    highest = wanted[j, i] if wanted[j, i] > highest else highest
                least[t, j] = min(least[t, j], highest)
    return least


@compiled(error_model="numpy")
def beside_each_other(
    losses: Array, of_learned: Array, of_total: Array, stretches: float
) -> tuple[Array, Array, Array, Array]:
    """Compare each of n stories with the others, in k measurements.

    Parameters
    ----------
    losses : ndarray, shape (k, n)
    of_learned, of_total : ndarray, shape (k, n, n)
        Inverse covariance of the losses: as learned, and with what is of any size.
    stretches : float
        Independent stretches that the covariance was learned from.

    Returns
    -------
    z : ndarray, shape (k, n)
        z-score of each loss beyond what the others let expect.
    weights : ndarray, shape (k, n, n)
        That loss as a combination of the measured ones.
    inflation : ndarray, shape (k, n)
        Factor of its variance.
    z_alike : ndarray, shape (k,)
        Size of the z-score of a change of all alike.
    """
    count, n = losses.shape
    z, weights, inflation, z_alike = (
        np.empty((count, n)),
        np.empty((count, n, n)),
        np.empty((count, n)),
        np.empty(count),
    )
    for k in range(count):
        inverse, loss = of_total[k], losses[k]
        square, information, evidence, largest = 0.0, 0.0, 0.0, 0.0
        distances, gap = np.zeros(n), np.zeros(n)
        for j in range(n):
            for i in range(n):
                distances[j] += of_learned[k, j, i] * loss[i]
                gap[j] += inverse[j, i] * loss[i]
                information += inverse[j, i]
            square += loss[j] * distances[j]
            evidence += gap[j]
            largest = max(largest, abs(loss[j]))
        for j in range(n):
            inflation[k, j] = 1.0 + (square - distances[j] ** 2 / of_learned[k, j, j]) / stretches
            z[k, j] = gap[j] / np.sqrt(inverse[j, j] * inflation[k, j])
            for i in range(n):
                weights[k, j, i] = inverse[j, i] / inverse[j, j]
        # A change alike that is larger than what was measured of any story is no explanation.
        along = abs(evidence) / np.sqrt(information) if abs(evidence) <= information * largest else 0.0
        z_alike[k] = along / np.sqrt(1.0 + max(square - along**2, 0.0) / stretches)
    return z, weights, inflation, z_alike
