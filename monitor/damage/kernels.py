"""Compiled loops of the alarm's test statistic and of the smallest detectable loss."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, compiled


@compiled()
def evidence_of_loss(
    means: Annotated[Array, "k n"],
    covariance: Annotated[Array, "k n n"],
    model_form: float,
    significant: float,
    credit: float,
    sure: float,
) -> tuple[Annotated[Array, "k n"], Annotated[Array, "k n"]]:
    """Compute the z-scores of `sequential_test.statistic`, and the standard deviations of the means.

    `model_form` is the share of another part's change that may show in a part (one standard deviation), `significant` the
    distance up to which two parts' changes agree, and `credit` what is added to the z-score against a uniform change, in
    standard deviations, unless the others by themselves show one of more than `sure` standard deviations.
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
            difference, square, of_others = 0.0, 0.0, 0.0
            for i in range(n):
                difference += contrast[i] * mean[i]
                square += (contrast[i] * leak[i]) ** 2
                for other in range(n):
                    part = contrast[i] * covariance[s, i, other] * contrast[other]
                    square += part
                    of_others += part if i != j and other != j else 0.0
            unchanged = abs(mean[j] - difference) <= sure * np.sqrt(of_others)
            z[s, j] = min(z[s, j], difference / np.sqrt(square) + (credit if unchanged else 0.0))
    return z, std


@compiled(part=True, error_model="numpy")
def _needed_in_trial(
    begin: int,
    total: Array,
    first: int,
    lengths: NDArray[np.int64],
    factor: Array,
    of_error: Array,
    off: float,
    of_alone: Array,
    alone_off: Array,
    needed: Array,
    leak: Array,
    square: Array,
    wanted: Array,
    error: Array,
    alone: Array,
) -> float:
    """Compute the smallest loss of one story that is seen in one trial, at the looks from `begin` on; infinite where none is.

    The parameters are those of `seen_by_most` for this trial and story; `wanted`, `error` and `alone`, of one value a look, are
    overwritten.
    """
    # Slices, because a loop whose index does not begin with 0 is not vectorized.
    wanted, error, alone = wanted[begin:], error[begin:], alone[begin:]
    looks = wanted.size
    for k in range(looks):
        wanted[k] = np.inf
    for s in range(lengths.size):
        if leak[s] <= 0.0:
            continue
        of_all = alone_off[s]
        for k in range(looks):
            error[k], alone[k] = off, of_all
        for i in range(len(total)):
            by_error, by_alone = of_error[s, i], of_alone[s, i]
            now, before = total[i, first + begin :], total[i, first + begin - lengths[s] :]
            for k in range(looks):
                passed = now[k] - before[k]
                error[k] += by_error * passed
                alone[k] += by_alone * passed
        least, kept, of_square, per_leak = needed[s], 1.0 - leak[s], leak[s] * square[s], 1.0 / leak[s]
        times = factor[s, begin:]
        for k in range(looks):
            against_none = least - error[k]
            against_alike = (np.sqrt(kept * alone[k] * alone[k] + of_square) - alone[k]) * per_leak
            loss = (against_alike if against_alike > against_none else against_none) * times[k]
            wanted[k] = loss if loss < wanted[k] else wanted[k]
    smallest = np.inf
    for k in range(looks):
        smallest = min(smallest, wanted[k])
    return smallest


@compiled(error_model="numpy")
def seen_by_most(
    total: Annotated[Array, "trials n first+looks"],
    first: int,
    lengths: Annotated[NDArray[np.int64], "s"],
    factor: Annotated[Array, "s looks"],
    of_error: Annotated[Array, "s n n"],
    off: Annotated[Array, "trials n"],
    of_alone: Annotated[Array, "s n n"],
    alone_off: Annotated[Array, "s trials n"],
    needed: Annotated[Array, "s n"],
    leak: Annotated[Array, "s n"],
    square: Annotated[Array, "s n"],
    unseen: int,
) -> Annotated[Array, "n"]:
    """Compute the smallest loss of each story that is seen in all trials but `unseen`; infinite where none is.

    In a trial it is seen where it is significant at one of the looks, over one of s stretches of windows.  Only the trials that
    need the largest losses count: of the others a bound is enough.  `unseen` is less than the number of trials.

    `total` are sums of standard normal increments up to each look: of the healthy data, then after the loss, from look `first`
    on; more looks may follow.  `lengths` are the looks in each stretch, increasing, at most `first`; `factor` is the length of a
    stretch over that of its part behind the loss.  `of_error` is the error of each story's mean over a stretch as a combination
    of the increments' sums over it, `off` the errors that all windows have in common; `of_alone` and `alone_off` are the same of
    each story less what the others say that all stories have in common.  `needed` is the mean that is announced where nothing
    else changed; `leak` (at most 1) and `square` are coefficients of the quadratic equation for the mean that is significant
    against a change of all stories alike.  Where `leak` is not positive, no mean is.
    """
    trials, n = off.shape
    stretches, looks = factor.shape
    seen, wanted, error, alone = np.empty(n), np.empty(looks), np.empty(looks), np.empty(looks)
    whole = max(int(np.sum(lengths <= looks)), 1)  # of the stretches, those that may lie wholly behind the loss
    for j in range(n):
        most = np.full(trials, np.inf)  # loss that each trial needs at most
        largest = np.full(unseen + 1, -np.inf)  # losses that trials need, the largest first
        for is_bound in (True, False):  # by the last looks over one stretch alone, then by all
            begin, low, high = (looks - 1, whole - 1, whole) if is_bound else (0, 0, stretches)
            some_lengths, factors = lengths[low:high], factor[low:high]
            errors, alones, alone_offs = of_error[low:high, j], of_alone[low:high, j], alone_off[low:high, :, j]
            least, leaks, squares = needed[low:high, j], leak[low:high, j], square[low:high, j]
            for t in np.argsort(-most):
                if most[t] <= largest[unseen]:
                    break
                most[t] = _needed_in_trial(
                    begin,
                    total[t],
                    first,
                    some_lengths,
                    factors,
                    errors,
                    off[t, j],
                    alones,
                    alone_offs[:, t],
                    least,
                    leaks,
                    squares,
                    wanted,
                    error,
                    alone,
                )
                if is_bound or most[t] <= largest[unseen]:
                    continue
                k = unseen
                while k > 0 and largest[k - 1] < most[t]:
                    largest[k] = largest[k - 1]
                    k -= 1
                largest[k] = most[t]
        seen[j] = largest[unseen]
    return seen


@compiled(error_model="numpy")
def beside_each_other(
    losses: Annotated[Array, "k n"],
    of_learned: Annotated[Array, "k n n"],
    of_total: Annotated[Array, "k n n"],
    stretches: float,
) -> tuple[Annotated[Array, "k n"], Annotated[Array, "k n n"], Annotated[Array, "k n"], Annotated[Array, "k"]]:
    """Compare each of n stories with the others, in k measurements.

    `of_learned` and `of_total` are the inverse covariance of the losses: as learned, and with what is of any size; `stretches`
    is the number of independent stretches that it was learned from.  Returned are the arrays of `common_change._Compared`.
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
