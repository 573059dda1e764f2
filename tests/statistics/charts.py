"""The two control charts of a textbook, against which detection without a model is measured.

Series: regression on the covariates, bilinear about 0 degC for temperatures, and Hotelling's T2 of what it leaves, with the F
distribution's 99.9 % for a limit; a change is announced at four readings in a row.  Records: the coefficients of an AR model of
each channel in short segments, and T2 of two samples.  Rows with a missing value are not judged.

References
----------
D. C. Montgomery, Introduction to Statistical Quality Control, chapter 11 (multivariate charts); H. Sohn, C. R. Farrar, Smart
Mater. Struct. 10 (2001) 446-451 (AR coefficients as features).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_toeplitz
from scipy.stats import f

from monitor.core import Array
from monitor.damage import FeatureTable

SURE = 0.999
"""Quantile of the F distribution that is the limit. [1; convention]"""
IN_A_ROW = 4
"""Readings in a row at which a change is announced. [readings; convention: Western Electric's four of five]"""


@dataclass(frozen=True, eq=False)
class Chart:
    """T2 of readings, over its limit."""

    statistic: Annotated[Array, "w"]
    """NaN of a reading that is not judged."""
    in_a_row: int

    def announced(self, limit: float = 1.0) -> Annotated[NDArray[np.bool_], "w"]:
        """Tell at which readings a change is announced: this and those judged before it are beyond the limit."""
        judged = np.flatnonzero(np.isfinite(self.statistic))
        beyond = np.zeros(self.in_a_row - 1 + judged.size, dtype=bool)
        beyond[self.in_a_row - 1 :] = self.statistic[judged] > limit
        out = np.zeros(self.statistic.size, dtype=bool)
        if judged.size:
            out[judged] = np.lib.stride_tricks.sliding_window_view(beyond, self.in_a_row).all(axis=1)
        return out


def of_series(table: FeatureTable, learned_until_ns: int, in_a_row: int = IN_A_ROW) -> Chart:
    """Judge the rows after a time by the regression on the rows up to it."""
    y, x = np.column_stack(list(table.features.values())), _regressors(table)
    learned = int(np.searchsorted(table.t_ns, learned_until_ns, side="right"))
    whole = np.asarray(np.isfinite(np.column_stack([y, x])).all(axis=1))
    rows = np.flatnonzero(whole[:learned])
    coefficients, *_ = np.linalg.lstsq(x[rows], y[rows], rcond=None)
    left = y - x @ coefficients
    freedom = rows.size - int(np.linalg.matrix_rank(x[rows]))
    covariance = left[rows].T @ left[rows] / max(freedom, 1)
    return Chart(_over_limit(left[learned:], covariance, 1.0 + 1.0 / rows.size, freedom), in_a_row)


def of_segments(learned: Annotated[Array, "n k"], later: Annotated[Array, "m k"]) -> Chart:
    """Judge each segment by the learned ones."""
    covariance = np.atleast_2d(np.cov(learned, rowvar=False))
    return Chart(_over_limit(later - learned.mean(axis=0), covariance, 1.0 + 1.0 / len(learned), len(learned) - 1), 1)


def between(a: Annotated[Array, "n k"], b: Annotated[Array, "m k"]) -> float:
    """Compute the T2 of two samples of segments, over its limit."""
    freedom = len(a) + len(b) - 2
    pooled = ((len(a) - 1) * np.cov(a, rowvar=False) + (len(b) - 1) * np.cov(b, rowvar=False)) / freedom
    distance = (a.mean(axis=0) - b.mean(axis=0))[None]
    return float(_over_limit(distance, np.atleast_2d(pooled), 1.0 / len(a) + 1.0 / len(b), freedom)[0])


def ar_coefficients(samples: Annotated[Array, "n c"], segment_n: int, order: int) -> Annotated[Array, "m k"]:
    """Compute the AR coefficients of each channel in each segment (Yule and Walker)."""
    out = []
    for start in range(0, len(samples) - segment_n + 1, segment_n):
        part = samples[start : start + segment_n] - samples[start : start + segment_n].mean(axis=0)
        lags = np.array([(part[: segment_n - lag] * part[lag:]).sum(axis=0) for lag in range(order + 1)])
        out.append(np.concatenate([solve_toeplitz(r[:-1], r[1:]) for r in lags.T]))
    return np.array(out)


def _regressors(table: FeatureTable) -> Annotated[Array, "w p"]:
    """Form the columns: one, each covariate, and of a temperature what is above and below 0 degC."""
    columns = [np.ones(table.t_ns.size)]
    for name, values in table.covariates.items():
        columns += [np.maximum(values, 0.0), np.minimum(values, 0.0)] if "temperature" in name else [values]
    return np.column_stack(columns)


def _over_limit(
    away: Annotated[Array, "w k"], covariance: Annotated[Array, "k k"], variance: float, freedom: int
) -> Annotated[Array, "w"]:
    """Compute T2 over its limit; NaN of rows with a missing value, and of all where too little was learned."""
    k = len(covariance)
    out = np.full(len(away), np.nan)
    known = np.isfinite(away).all(axis=1)
    if freedom < k or not known.any():
        return out
    square = np.einsum("wk,kw->w", away[known], np.linalg.solve(covariance * variance, away[known].T))
    out[known] = square / (k * freedom / (freedom - k + 1) * f.ppf(SURE, k, freedom - k + 1))
    return out
