"""What the healthy stiffness owes to the temperature: learned at calibration, taken out of the damage index.

The law is a constant relative change per kelvin, story by story: ``k(T) = k(T_ref) exp(a (T - T_ref))``, T the measured
temperature after a first-order thermal lag.
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
    """How the healthy stories' stiffness follows the temperature."""

    per_degc: Array
    """Shape (n,): relative change of each story's stiffness per K."""
    covariance: Array
    """Shape (n, n), 1/K^2."""
    lag_s: float
    """First-order thermal lag, one of `LAGS_S`."""
    reference_degc: float
    """Mean of the healthy windows' lagged temperatures: where the baseline's stiffness holds."""
    range_degc: tuple[float, float]
    """Least and highest of them."""
    extrapolation: float = 0.5
    """See `TemperatureSettings.extrapolation`."""

    def expected(self, temperature: Temperature | None) -> tuple[Array, Array]:
        """What the temperature does to the stiffness.

        Returns
        -------
        relative : ndarray, shape (n,)
            Change since the reference temperature; 0 where the temperature is not known.
        covariance : ndarray, shape (n, n)
            Of the slope; outside the range seen of the law as well; without a temperature, of its lying anywhere in
            the range seen.
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
    """For the baseline's file."""
    if dependence is None:
        return None
    return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in asdict(dependence).items()}


def from_plain(content: dict[str, Any] | None, n_stories: int) -> Dependence | None:
    """What `to_plain` wrote.

    Raises
    ------
    ValueError, KeyError, TypeError
        If it is damaged or another structure's.
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
    """A healthy window's stiffness against the baseline's."""

    relative: Array
    """Shape (n,)."""
    deviations: Array
    """Shape (n_rows, n): influences whose squares sum to its covariance."""
    places: tuple[tuple[bool, int], ...]
    """What each row belongs to: windows that overlap share rows."""
    temperature: Temperature | None


def learn(changes: list[Change], span_s: float, settings: TemperatureSettings) -> Dependence | None:
    """The stories' dependence on temperature by least squares over healthy windows, and the lag that explains most.

    Parameters
    ----------
    span_s : float
        From the first window to the last; lags up to a quarter of it are tried.

    Returns
    -------
    Dependence or None
        None if temperatures are missing in more than a tenth of the windows (their mean would not be the baseline's),
        too few windows are independent, the range is too narrow, or nothing significant was found.

    Notes
    -----
    The slope's covariance comes from the influences that overlapping windows share.  Where the windows scatter more about
    the line than their own covariances say, it is widened by that ratio.
    """
    known = [c for c in changes if c.temperature is not None]
    lagged = np.array([c.temperature.lagged_degc for c in known if c.temperature is not None])
    if len(known) < max(_MIN_INDEPENDENT_WINDOWS, 0.9 * len(changes)) or np.ptp(lagged[:, 0]) < settings.min_range_k:
        return None
    own = np.mean([c.deviations.T @ c.deviations for c in known], axis=0)

    def overlap(pull: Array) -> float:
        """How many overlapping windows tell, weighted so, as much as one alone."""
        return float(np.trace(_shared(known, pull)) / (pull @ pull * np.trace(own)))

    of_mean, of_slope = overlap(np.ones(len(known))), overlap(_pull(lagged[:, 0]))
    if len(known) < _MIN_INDEPENDENT_WINDOWS * of_mean:
        return None
    weight, seen = _inverse(own)
    freedom = seen * (len(known) - of_mean - of_slope)
    x = np.array([c.relative for c in known])
    misfit = np.array([_misfit(x, lagged[:, i], weight) for i, lag_s in enumerate(LAGS_S) if lag_s <= span_s / 4.0])
    best = int(misfit.argmin())
    if misfit[0] - misfit[best] < _MIN_LAG_GAIN * of_slope * max(1.0, misfit[best] / freedom):
        best = 0
    pull = _pull(lagged[:, best])
    covariance = max(1.0, misfit[best] / freedom) * _shared(known, pull)
    slope, (precision, seen) = pull @ x, _inverse(covariance)
    if slope @ precision @ slope < chdtri(seen, 2.0 * ndtr(-settings.significance)):
        return None
    slope, covariance = _drawn_together(slope, covariance, settings.unevenness)
    degc = lagged[:, best]
    span = float(degc.min()), float(degc.max())
    return Dependence(slope, covariance, LAGS_S[best], float(degc.mean()), span, settings.extrapolation)


def _pull(degc: Array) -> Array:
    """Pull of each window on the slope, shape (n_windows,)."""
    centred = degc - degc.mean()
    return np.asarray(centred / (centred @ centred))


def _misfit(x: Array, degc: Array, weight: Array) -> float:
    """Squared distance of all windows from the line."""
    residual = x - x.mean(axis=0) - np.outer(degc - degc.mean(), _pull(degc) @ x)
    return float(np.einsum("wi,wi->", residual, residual @ weight))


def _inverse(covariance: Array) -> tuple[Array, int]:
    """Precision, 0 in directions that no sensor sees, and the number of the others."""
    seen = np.linalg.matrix_rank(covariance, rtol=1e-9, hermitian=True)
    return np.asarray(np.linalg.pinv(covariance, rtol=1e-9, hermitian=True)), int(seen)


def _drawn_together(slope: Array, covariance: Array, unevenness: float) -> tuple[Array, Array]:
    """Posterior of the slopes where they scatter about an unknown common one: what the data cannot tell apart.

    They scatter by `unevenness` times their size, or more if they differ by more than their errors explain.
    """
    n, (precision, _) = slope.size, _inverse(covariance)
    scatter = max(unevenness**2 * float(np.mean(slope**2)), float(slope.var() - np.trace(covariance) / n))
    prior = (np.eye(n) - 1.0 / n) / scatter
    posterior = np.linalg.inv(precision + prior)
    return posterior @ precision @ slope, np.asarray(posterior)


def _shared(known: list[Change], pull: Array) -> Array:
    """Covariance of the windows' sum weighted by `pull`, shape (n, n)."""
    rows: dict[tuple[bool, int], Array] = {}
    for change, weight in zip(known, pull, strict=True):
        for place, row in zip(change.places, change.deviations, strict=True):
            rows[place] = rows.get(place, 0.0) + weight * row
    together = np.array(list(rows.values()))
    return np.asarray(together.T @ together)
