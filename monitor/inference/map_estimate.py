"""Most probable parameters by Fisher scoring with Levenberg-Marquardt steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from monitor.core import Array, levenberg_marquardt
from monitor.inference.forward_model import Prediction
from monitor.inference.posterior import MAX_EXCITATION_STEP, Posterior, with_coordinates
from monitor.inference.spectral_slopes import JoinedSlopes, RowSlopes, Slopes
from monitor.inference.trial import require_finite, tried
from monitor.model import Effect, inverse

_MAX_STRUCTURE_STEP = 0.1
"""Longest step of the logarithm of a stiffness or a mass, and of the stiffness correction. [1; judgement: ten percent]"""
_MAX_DAMPING_STEP = 1.0
"""Longest step of the logarithm of a damping ratio or of a channel's noise. [1; judgement: a factor of e]"""
_MAX_SIZE_STEP = 0.5
"""Longest step of the logarithm of a size of an effect. [1; judgement: a factor of 1.6]"""
_MAX_EFFECT_STEP = 0.5
"""Longest step of the parameters of effects that are part of the model already. [effect's own unit; judgement]"""
_FIXED_SLOPES_GAIN = 1.0
"""Gain of a step below which the slopes are not computed again. [nats; judgement]"""


@dataclass(frozen=True, eq=False, slots=True)
class MapEstimate:
    """Most probable parameters of a model, with their covariance (maximum a posteriori)."""

    x: Annotated[Array, "p"]
    """Structural nuisances, excitation, then the extra effects' coordinates."""
    effects: tuple[Effect, ...]
    log_likelihood: float
    """Log likelihood without the prior, tempered for correlated bins and segments, nats."""
    log_prior: float
    covariance: Annotated[Array, "p p"]
    """Covariance of x."""
    converged: bool
    slopes: Slopes
    """Whitened slopes, each row weighted by the root of its information: classes * bins * c * c rows of the spectra, then
    those of the segments' means where the ground was measured."""
    residual: Array
    """Whitened and weighted residual of the spectra's rows."""
    mean_residual: Array
    """Whitened and weighted residual of the means' rows."""
    information: Annotated[Array, "p p"]
    """Fisher information of the data, without the prior."""

    @property
    def log_posterior(self) -> float:
        """Log posterior density of the fit up to a constant, nats."""
        return self.log_likelihood + self.log_prior

    @property
    def is_possible(self) -> bool:
        """Whether the fit has a likelihood, see `unfitted`."""
        return bool(np.isfinite(self.log_posterior))

    def without_slopes(self) -> MapEstimate:
        """Return the fit without its slopes, for what compares fits alone: with many channels the slopes take 0.1 GB."""
        return replace(self, slopes=RowSlopes(np.zeros((0, self.x.size))))

    def coordinates_of(self, i: int) -> slice:
        """Return the slice of the coordinates of extra effect i in `x`."""
        first = self.x.size - self.n_effect + sum(len(e.parameters) for e in self.effects[:i])
        return slice(first, first + len(self.effects[i].parameters))

    @property
    def n_effect(self) -> int:
        """Number of coordinates of the extra effects."""
        return sum(len(e.parameters) for e in self.effects)


def maximize_posterior(
    posterior: Posterior,
    x: Array,
    effects: tuple[Effect, ...] = (),
    *,
    iterations: int = 12,
    tolerance: float = 0.02,
    frozen: Slopes | None = None,
    keep_slopes: bool = True,
) -> MapEstimate:
    """Find the most probable parameters near `x` by Fisher scoring with Levenberg-Marquardt steps.

    The fit starts from the nuisances of `x` and from the coordinates of the extra effects themselves.  It has converged where
    a step gains less than the tolerance, nats.  The estimate is that of `unfitted` where the fit begins at no structure, or
    cannot be computed.

    Parameters
    ----------
    frozen : Slopes, optional
        Slopes of the first n parameters that are not computed again: faster, for a ranking, or where these do not move.
    keep_slopes : bool
        Whether the fit has its slopes, from which another search can start.
    """
    return tried(
        lambda: _maximize(posterior, x, effects, iterations, tolerance, frozen, keep_slopes=keep_slopes),
        unfitted(posterior, x, effects),
    )


def unfitted(posterior: Posterior, x: Array, effects: tuple[Effect, ...]) -> MapEstimate:
    """Return an estimate without likelihood (minus infinity) and slopes at the nuisances of `x` and the effects' coordinates."""
    x = np.concatenate([x[posterior.layout.nuisances], *[e.coordinates for e in effects]])
    none = _no_slopes(x.size)
    slopes, rows = none.slopes, none.residual
    return MapEstimate(x, effects, -np.inf, 0.0, none.normal, False, slopes, rows, rows, slopes.information)


def _maximize(
    posterior: Posterior,
    x: Array,
    effects: tuple[Effect, ...],
    iterations: int,
    tolerance: float,
    frozen: Slopes | None,
    *,
    keep_slopes: bool,
) -> MapEstimate:
    """As `maximize_posterior`; raises where something cannot be computed, see `tried`."""
    start = _evaluate(posterior, x, effects)
    stays_stable = posterior.is_stable(start.x, effects)

    def evaluate(at: _Point, step: Array) -> _Point:
        moved = at.x + step
        extra = with_coordinates(at.effects, moved[posterior.layout.effects])
        nowhere = replace(at, log_likelihood=-np.inf)  # too long a step leads to no structure
        if stays_stable and not tried(lambda: posterior.is_stable(moved, extra), False):
            return nowhere
        return tried(lambda: _evaluate(posterior, moved, extra), nowhere)

    def move(at: _Point, step: Array) -> _Point:
        return max(
            (evaluate(at, s) for s in shortened_steps(posterior, step, at.effects)), key=lambda point: point.value
        )

    search = levenberg_marquardt(
        start,
        lambda at, last: _linearize(posterior, at, last, frozen),
        move,
        iterations=iterations,
        tolerance=tolerance,
        fixed_slopes_gain=_FIXED_SLOPES_GAIN,
    )
    found = search.point
    last = search.linearization or _no_slopes(start.x.size)
    slopes, information = last.slopes, last.slopes.information
    covariance = inverse(last.normal)
    require_finite(covariance, found.log_prior)
    estimate = MapEstimate(
        found.x, found.effects, found.log_likelihood, found.log_prior, covariance, search.converged,
        slopes, last.residual, last.mean_residual, information,
    )  # fmt: skip
    return estimate if keep_slopes else estimate.without_slopes()


@dataclass(frozen=True, eq=False, slots=True)
class _Point:
    """The posterior at one point."""

    x: Array
    effects: tuple[Effect, ...]
    prediction: Prediction
    log_likelihood: float
    log_prior: float

    @property
    def value(self) -> float:
        """Log posterior up to a constant, nats."""
        return self.log_likelihood + self.log_prior


@dataclass(frozen=True, eq=False, slots=True)
class _Slopes:
    """The log posterior near a point to second order, by Fisher information."""

    slopes: Slopes
    """As `MapEstimate.slopes`."""
    residual: Array
    mean_residual: Array
    normal: Annotated[Array, "p p"]
    """Fisher information and the prior's precision."""
    gradient: Annotated[Array, "p"]
    """Of the log posterior."""


def _no_slopes(n: int) -> _Slopes:
    """Stand for the slopes at a point from which no step was taken."""
    return _Slopes(RowSlopes(np.zeros((0, n))), np.zeros(0), np.zeros(0), np.eye(n), np.zeros(n))


def _evaluate(posterior: Posterior, x: Array, effects: tuple[Effect, ...]) -> _Point:
    """Evaluate the log posterior at the nuisances of `x` and the effects' own coordinates."""
    x = np.concatenate([x[posterior.layout.nuisances], *[e.coordinates for e in effects]])
    prediction = posterior.predict(x, effects)
    log_likelihood = posterior.log_likelihood(prediction.spectra, prediction.data)
    return _Point(x, effects, prediction, log_likelihood, posterior.log_prior(x, effects))


def _linearize(posterior: Posterior, at: _Point, last: _Slopes | None, frozen: Slopes | None) -> _Slopes:
    """Linearize the prediction at a point; beside no measured ground the slopes of `last` serve again."""
    here = at.prediction
    if last is None or here.left is not None:
        if frozen is None:
            slopes, residual, mean_residual = posterior.linearized(at.x, at.effects, here)
        else:
            first = len(frozen.information)
            rows, residual, mean_residual = posterior.slope_rows(at.x, at.effects, here, first)
            slopes = JoinedSlopes.of(frozen, RowSlopes(rows))
    else:
        slopes, mean_residual = last.slopes, last.mean_residual
        residual = posterior.whitened(here.spectra, here.spectra[None][:0], here.data)[1]
    mean, precision = posterior.normal_prior(at.x, at.effects)
    both = np.concatenate([residual, mean_residual])
    gradient = slopes.along(both) - precision @ (at.x - mean)
    return _Slopes(slopes, residual, mean_residual, slopes.information + precision, gradient)


def shortened_steps(posterior: Posterior, step: Array, effects: Sequence[Effect]) -> tuple[Array, ...]:
    """Shorten a step to its bounds, so that a fit from a bad start does not diverge.

    Where a coordinate's step is too long, either that coordinate's alone is shortened, or the whole step.  The former is longer,
    and the latter keeps its direction, in which the objective rises.
    """
    bound, layout = np.full(step.size, np.inf), posterior.layout
    bound[layout.stiffness] = bound[layout.masses] = bound[layout.correction] = _MAX_STRUCTURE_STEP
    bound[layout.damping] = bound[layout.channel_noise] = _MAX_DAMPING_STEP
    # The force on a mode differs between recordings by more than that: a step may be as long as the prior is wide.
    wide = [std for e in posterior.prior.model.effects for std in e.pattern_std]
    bound[layout.persistent] = np.fmax(_MAX_EFFECT_STEP * posterior.prior.units[layout.persistent], wide)
    bound[layout.excitation] = MAX_EXCITATION_STEP
    logarithms = [p.scale == "log" for e in effects for p in e.parameters]
    bound[layout.effects] = np.where(logarithms, _MAX_SIZE_STEP, np.inf)
    longest = float((np.abs(step) / bound).max())
    return (step,) if longest <= 1.0 else (np.clip(step, -bound, bound), step / longest)
