"""Temperature dependence of the healthy stiffness: learned at calibration, removed from the damage index.

The law is a constant relative change per kelvin, story by story: ``k(T) = k(T_ref) exp(a (T - T_ref))``, where T is the
measured temperature after a first-order thermal lag.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.special import chdtri, ndtr  # scipy.stats takes a second to load

from monitor.core import Array, Temperature
from monitor.signals import LAGS_S, TemperatureSettings

_MIN_INDEPENDENT_WINDOWS = 4
"""Fewest windows without overlap from which a temperature dependence is learned. [windows; judgement]"""
_MIN_LAG_GAIN = 4.0
"""Gain in squared distance from which a thermal lag is preferred to none. [variances; convention: two standard
deviations squared]"""


@dataclass(frozen=True, eq=False, slots=True)
class Dependence:
    """Temperature dependence of the healthy stories' stiffness."""

    per_degc: Array
    """Shape (n,): relative change of each story's stiffness per K."""
    covariance: Array
    """Shape (n, n), 1/K^2."""
    lag_s: float
    """First-order thermal lag, one of `LAGS_S`."""
    reference_degc: float
    """Mean of the healthy windows' lagged temperatures: the temperature of the baseline's stiffness."""
    range_degc: tuple[float, float]
    """Lowest and highest of the healthy windows' lagged temperatures."""
    extrapolation: float = 0.5
    """See `TemperatureSettings.extrapolation`."""

    def expected(self, temperature: Temperature | None) -> tuple[Array, Array]:
        """Predict the change of stiffness at a window's temperature.

        Returns
        -------
        relative : ndarray, shape (n,)
            Relative change since the reference temperature; 0 where the temperature is not known.
        covariance : ndarray, shape (n, n)
            Covariance from the error of the slope and, outside the learned range, from that of the law.  Without a
            temperature it is that of a temperature uniformly distributed over the learned range.
        """
        low, high = self.range_degc
        if temperature is None:
            return np.zeros_like(self.per_degc), np.outer(self.per_degc, self.per_degc) * (high - low) ** 2 / 12.0
        t = float(temperature.lagged_degc[LAGS_S.index(self.lag_s)])
        away, beyond = t - self.reference_degc, max(low - t, t - high, 0.0)
        relative = np.expm1(self.per_degc * away)
        scale = 1.0 + relative
        law = np.outer(self.per_degc, self.per_degc) * (self.extrapolation * beyond) ** 2
        return relative, (self.covariance * away**2 + law) * np.outer(scale, scale)


def to_plain(dependence: Dependence | None) -> dict[str, Any] | None:
    """Convert a dependence to JSON types for the baseline's file."""
    if dependence is None:
        return None
    return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in asdict(dependence).items()}


def from_plain(content: dict[str, Any] | None, n_stories: int) -> Dependence | None:
    """Convert the JSON types that `to_plain` wrote back to a dependence.

    Raises
    ------
    ValueError, KeyError, TypeError
        If the content is damaged or belongs to another structure.
    """
    if content is None:
        return None
    per_degc, covariance = (np.array(content[name], dtype=float) for name in ("per_degc", "covariance"))
    low, high = map(float, content["range_degc"])
    lag_s, reference, extrapolation = (float(content[k]) for k in ("lag_s", "reference_degc", "extrapolation"))
    finite = np.isfinite([*per_degc.flat, *covariance.flat, low, high, reference, extrapolation]).all()
    if per_degc.shape != (n_stories,) or covariance.shape != (n_stories,) * 2 or not finite or lag_s not in LAGS_S:
        raise ValueError("its temperature dependence is damaged")
    return Dependence(per_degc, covariance, lag_s, reference, (low, high), extrapolation)


@dataclass(frozen=True, eq=False, slots=True)
class Change:
    """Change of a healthy window's stiffness from the baseline's."""

    relative: Array
    """Shape (n,): relative change."""
    deviations: Array
    """Shape (n_rows, n): influences whose squares sum to the covariance of `relative`."""
    places: tuple[tuple[bool, int], ...]
    """Stretch of data of each row of `deviations`: overlapping windows share stretches."""
    temperature: Temperature | None


def learn(changes: list[Change], span_s: float, settings: TemperatureSettings) -> Dependence | None:
    """Estimate the stories' temperature coefficients by least squares over healthy windows, at the lag that fits best.

    Parameters
    ----------
    changes : list of Change
        One for each healthy window.
    span_s : float
        Time from the first window to the last, s; lags up to a quarter of it are tried.

    Returns
    -------
    Dependence or None
        None if temperatures are missing in more than a tenth of the windows (their mean would not be the baseline's),
        too few windows are independent, the range is too narrow, or the dependence is not significant.

    Notes
    -----
    The slope's covariance is computed from the influences that overlapping windows share.  Where the windows scatter more
    about the line than their own covariances predict, the slope's covariance is multiplied by that ratio of variances.
    """
    known = [c for c in changes if c.temperature is not None]
    lagged = np.array([c.temperature.lagged_degc for c in known if c.temperature is not None])
    if len(known) < max(_MIN_INDEPENDENT_WINDOWS, 0.9 * len(changes)) or np.ptp(lagged[:, 0]) < settings.min_range_k:
        return None
    own = np.mean([c.deviations.T @ c.deviations for c in known], axis=0)

    def overlap(weights: Array) -> float:
        """Compute the variance of a weighted sum of the windows over its variance if the windows were independent."""
        return float(np.trace(_covariance_of_sum(known, weights)) / (weights @ weights * np.trace(own)))

    of_mean, of_slope = overlap(np.ones(len(known))), overlap(_slope_weights(lagged[:, 0]))
    if len(known) < _MIN_INDEPENDENT_WINDOWS * of_mean:
        return None
    weight, rank = _pseudo_inverse(own)
    freedom = rank * (len(known) - of_mean - of_slope)
    x = np.array([c.relative for c in known])
    misfit = np.array([_misfit(x, lagged[:, i], weight) for i, lag_s in enumerate(LAGS_S) if lag_s <= span_s / 4.0])
    best = int(misfit.argmin())
    if misfit[0] - misfit[best] < _MIN_LAG_GAIN * of_slope * max(1.0, misfit[best] / freedom):
        best = 0
    slope_weights = _slope_weights(lagged[:, best])
    covariance = max(1.0, misfit[best] / freedom) * _covariance_of_sum(known, slope_weights)
    slope, (precision, rank) = slope_weights @ x, _pseudo_inverse(covariance)
    if slope @ precision @ slope < chdtri(rank, 2.0 * ndtr(-settings.significance)):
        return None
    slope, covariance = _shrink_to_common(slope, covariance, settings.unevenness)
    degc = lagged[:, best]
    span = float(degc.min()), float(degc.max())
    return Dependence(slope, covariance, LAGS_S[best], float(degc.mean()), span, settings.extrapolation)


def _slope_weights(degc: Array) -> Array:
    """Compute the weight of each window in the least-squares slope, shape (n_windows,), 1/K."""
    centred = degc - degc.mean()
    return np.asarray(centred / (centred @ centred))


def _misfit(x: Array, degc: Array, weight: Array) -> float:
    """Sum the squared distances of all windows, shape (n_windows, n), from the regression line, weighted by `weight`."""
    residual = x - x.mean(axis=0) - np.outer(degc - degc.mean(), _slope_weights(degc) @ x)
    return float(np.einsum("wi,wi->", residual, residual @ weight))


def _pseudo_inverse(covariance: Array) -> tuple[Array, int]:
    """Return the precision, which is 0 in directions that no sensor observes, and the rank of the covariance."""
    rank = np.linalg.matrix_rank(covariance, rtol=1e-9, hermitian=True)
    return np.asarray(np.linalg.pinv(covariance, rtol=1e-9, hermitian=True)), int(rank)


def _shrink_to_common(slope: Array, covariance: Array, unevenness: float) -> tuple[Array, Array]:
    """Compute the posterior mean and covariance of the slopes, given that they scatter about an unknown common slope.

    The prior scatter is `unevenness` times the size of the slopes, or more if they differ by more than their errors
    explain.  It decides how a change that the data cannot assign to single stories is divided among them.
    """
    n, (precision, _) = slope.size, _pseudo_inverse(covariance)
    scatter = max(unevenness**2 * float(np.mean(slope**2)), float(slope.var() - np.trace(covariance) / n))
    prior = (np.eye(n) - 1.0 / n) / scatter
    posterior = np.linalg.inv(precision + prior)
    return posterior @ precision @ slope, np.asarray(posterior)


def _covariance_of_sum(known: list[Change], weights: Array) -> Array:
    """Compute the covariance of the weighted sum of the windows, shape (n, n); shared data enter once."""
    rows: dict[tuple[bool, int], Array] = {}
    for change, weight in zip(known, weights, strict=True):
        for place, row in zip(change.places, change.deviations, strict=True):
            rows[place] = rows.get(place, 0.0) + weight * row
    together = np.array(list(rows.values()))
    return np.asarray(together.T @ together)
