"""Scatter between records: how far windows lie from what was learned without their record, beyond what they state of themselves.

A window states the sampling error of its data.  Records of an intact structure differ by more: temperature, load, fixing.  Each
record is left out of the learning in turn (where there is one record alone, each window is), and what its windows then differ by,
over what they state, gives a mean square between records and one within them (one-way analysis of variance with random effects).
Few records tell a variance badly.  So the variance ratios of all components, or of those of a kind (frequencies, shapes), are
drawn toward what they have in common, as far as they agree (moderated variances), and each has its degrees of freedom: five
records give no five sigma.

References
----------
S. R. Searle, G. Casella, C. E. McCulloch, Variance components (1992), section 3.6 (unbalanced data); F. E. Satterthwaite,
Biometrics Bull. 2 (1946) 110-114; G. K. Smyth, Stat. Appl. Genet. Mol. Biol. 3 (2004) article 3, section 6.2 (moderated
variances).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy.special import digamma, polygamma

from monitor.core import Array

_LEFT_OUT = 8
"""Most parts of the healthy data that are left out of the learning in turn. [1; convention: cross-validation by 5 to 10 folds]"""

Predict = Callable[[NDArray[np.intp], NDArray[np.intp]], tuple[Array, Array]]
"""From the windows that are learned from, and those that are left out, to the values expected of the latter and their variance,
each of shape (left, d)."""


@dataclass(frozen=True, eq=False, slots=True)
class RecordScatter:
    """How windows of another record scatter about what was learned."""

    stated: Annotated[Array, "d"]
    """Mean variance that a healthy window stated."""
    scale: Annotated[Array, "d"]
    """What a window's stated variance is to be multiplied by, at most 1: less where windows differ by less than they state."""
    beyond: Annotated[Array, "d"]
    """Variance beyond it, which all windows of a record have in common."""
    freedom: Annotated[Array, "d"]
    """Degrees of freedom of the sum of both; 0 where no second window shared no data with the first."""
    records: int
    """Records that were left out in turn; of one record alone, windows that share no data."""

    @property
    def total(self) -> Annotated[Array, "d"]:
        """Variance of a window of another record."""
        return np.asarray(self.stated * self.scale + self.beyond)

    def of_mean(self, covariance: Annotated[Array, "d d"]) -> Annotated[Array, "d d"]:
        """Return the covariance of the mean over all windows, from the stated one."""
        root = np.sqrt(self.scale)
        return np.asarray(covariance * np.outer(root, root) + np.diag(self.beyond / self.records))


def learn_scatter(
    values: Annotated[Array, "w d"],
    stated: Annotated[Array, "d"],
    t_ns: Sequence[int],
    records: Sequence[int],
    window_ns: int,
    kinds: Sequence[slice],
    predict: Predict,
) -> RecordScatter:
    """Learn the scatter of windows that end at `t_ns` (UTC, increasing), each in one of the numbered records.

    `kinds` are the components that are alike.
    """
    ends = np.asarray(t_ns, dtype=np.int64)
    apart = _apart(ends, window_ns)
    record = np.asarray(records) if len(set(records)) > 1 else np.arange(ends.size)
    names = np.unique(record[apart])
    if names.size < 2:
        return RecordScatter(
            stated, np.ones_like(stated), np.zeros_like(stated), np.zeros_like(stated), int(names.size)
        )
    left = np.zeros((apart.size, stated.size))
    folds = np.array_split(names, min(_LEFT_OUT, names.size))
    for fold in folds:
        out = np.isin(record[apart], fold)
        shares = (np.abs(ends[:, None] - ends[apart[out]]) < window_ns).any(axis=1)
        rest = np.flatnonzero(~shares & ~np.isin(record, fold))
        expected, variance = predict(rest, apart[out])
        # Of channels that are copies rounding leaves a variance of none, or less.
        std = np.sqrt(np.maximum(stated + np.maximum(variance, 0.0), np.finfo(float).tiny))
        left[out] = (values[apart[out]] - expected) / std
    # The rest's mean has an error of its own, by which what is left out differs more.
    left /= np.sqrt(1.0 + 1.0 / (names.size * (1.0 - 1.0 / len(folds))))
    ratio, freedom = _ratio(left, np.searchsorted(names, record[apart]), names.size)
    ratio, freedom = _moderated(ratio, freedom, kinds)
    beyond = stated * np.maximum(ratio - 1.0, 0.0)
    return RecordScatter(stated, np.minimum(ratio, 1.0), beyond, freedom, int(names.size))


def _apart(ends: NDArray[np.int64], window_ns: int) -> NDArray[np.intp]:
    """Choose windows that share no data, in order."""
    chosen: list[int] = []
    for k, end in enumerate(ends.tolist()):
        if not chosen or end - int(ends[chosen[-1]]) >= window_ns:
            chosen.append(k)
    return np.array(chosen, dtype=np.intp)


def _ratio(left: Annotated[Array, "w d"], record: NDArray[np.intp], n: int) -> tuple[Array, Array]:
    """Estimate the variance of a window of another record, over the stated one, and its degrees of freedom; n records."""
    counts = np.bincount(record, minlength=n)[:, None]
    means = np.zeros((n, left.shape[1]))
    np.add.at(means, record, left)
    means /= counts
    between, within_freedom = (counts * means**2).mean(axis=0), len(left) - n
    if not within_freedom:
        return between, np.full(between.size, n - 1.0)
    within = ((left - means[record]) ** 2).sum(axis=0) / within_freedom
    size = (len(left) - (counts**2).sum() / len(left)) / (n - 1)
    parts = between / size, within * (1.0 - 1.0 / size)
    ratio = parts[0] + parts[1]
    return ratio, ratio**2 / (parts[0] ** 2 / (n - 1) + parts[1] ** 2 / within_freedom)


def _moderated(
    ratio: Annotated[Array, "d"], freedom: Annotated[Array, "d"], kinds: Sequence[slice]
) -> tuple[Array, Array]:
    """Draw variance ratios toward a common one, as far as they scatter no more than their degrees of freedom let expect.

    What they have in common is that of all components or of those of the same kind, whichever is known better.
    """
    ratio = np.maximum(ratio, np.finfo(float).tiny)
    prior, common, most = (np.empty_like(ratio) for _ in range(3))
    for kind in kinds:
        pools = [_pool(ratio[of], freedom[of]) for of in (kind, slice(None))]
        prior[kind], common[kind], most[kind] = max(pools)
    return (prior * common + freedom * ratio) / (prior + freedom), np.minimum(prior + freedom, most)


def _pool(ratio: Array, freedom: Array) -> tuple[float, float, float]:
    """Return the degrees of freedom of what variance ratios have in common, that itself, and the most there are."""
    ln = np.log(ratio) - digamma(0.5 * freedom) + np.log(0.5 * freedom)
    most = float(freedom.sum())
    excess = (ln.var(ddof=1) if ln.size > 1 else np.inf) - float(polygamma(1, 0.5 * freedom).mean())
    prior = min(2.0 * _trigamma_inverse(excess), most) if excess > 0.0 else most
    return prior, float(np.exp(ln.mean() + digamma(0.5 * prior) - np.log(0.5 * prior))), most


def _trigamma_inverse(value: float) -> float:
    """Return y with trigamma(y) = value, by Newton's method on 1 / trigamma, which is convex."""
    y = 0.5 + 1.0 / value
    for _ in range(20):
        now = float(polygamma(1, y))
        y += now * (1.0 - now / value) / float(polygamma(2, y))
    return y
