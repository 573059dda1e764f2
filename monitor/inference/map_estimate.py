"""Most probable parameters by Fisher scoring with Levenberg-Marquardt steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from monitor.core import Array
from monitor.inference.posterior import Posterior, with_coordinates
from monitor.model import Effect, inverse

_MAX_EFFECT_STEP = 0.5
"""Longest step of the parameters of effects that are part of the model already. [effect's own unit; judgement]"""
_FIXED_SLOPES_GAIN = 1.0
"""Gain of a step below which the slopes are not computed again. [nats; judgement]"""


@dataclass(frozen=True, eq=False, slots=True)
class MapEstimate:
    """Most probable parameters of a model, with their covariance (maximum a posteriori)."""

    x: Array
    """Structural nuisances, excitation, then the extra effects' coordinates, shape (p,)."""
    effects: tuple[Effect, ...]
    """The extra effects."""
    log_likelihood: float
    """Log likelihood without the prior, tempered for correlated bins and segments, nats."""
    log_prior: float
    covariance: Array
    """Covariance of x, shape (p, p)."""
    converged: bool
    jacobian: Array
    """Whitened slopes, each row weighted by the root of its information, shape (rows, p): classes * bins * c * c rows of
    the spectra, then those of the segments' means where the ground was measured."""
    residual: Array
    """Whitened and weighted residual of the spectra's rows."""
    mean_residual: Array
    """Whitened and weighted residual of the means' rows."""

    @property
    def log_posterior(self) -> float:
        """Log posterior density of the fit up to a constant, nats."""
        return self.log_likelihood + self.log_prior

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
    frozen: Array | None = None,
) -> MapEstimate:
    """Find the most probable parameters near `x` by Fisher scoring with Levenberg-Marquardt steps.

    Parameters
    ----------
    x : ndarray, shape (n_nuisance,) or more
        Nuisances, from which the fit starts; the effects' coordinates are taken from `effects`.
    effects : tuple of Effect
        Extra effects, beside the persistent ones.
    iterations : int
        Largest number of steps.
    tolerance : float
        Gain of a step below which the fit has converged, nats.
    frozen : ndarray, shape (rows, n_nuisance), optional
        Whitened slopes of the nuisances that are not computed again: faster, for a ranking.
    """
    layout = posterior.layout
    x = np.concatenate([x[layout.nuisances], *[e.coordinates for e in effects]])
    prediction = posterior.predict(x, effects)
    ll, lp = posterior.log_likelihood(prediction.spectra, prediction.data), posterior.score(x, effects)[1]
    damping, converged, gain = 1e-3, False, np.inf
    rows, residual, mean_residual, normal = np.zeros((0, x.size)), np.zeros(0), np.zeros(0), np.eye(x.size)
    for _ in range(iterations if np.isfinite(ll) else 0):  # an unstable law at the start cannot be fitted
        if gain > _FIXED_SLOPES_GAIN or prediction.left is not None:
            rows, residual, mean_residual = posterior.jacobian(
                x, effects, prediction, first=0 if frozen is None else layout.n_nuisance
            )
            if frozen is not None:
                rows = np.concatenate([frozen, rows], axis=1)
        else:  # the slopes hardly change near the optimum
            residual = posterior.whitened(prediction.spectra, prediction.spectra[None][:0], prediction.data)[1]
        mean, precision = posterior.normal_prior(x, effects)
        normal = rows.T @ rows + precision
        gradient = rows.T @ np.concatenate([residual, mean_residual]) - precision @ (x - mean)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
        accepted = False
        for _ in range(6):
            step = scale * np.linalg.solve(
                normal * scale[:, None] * scale + (damping + 1e-12) * np.eye(x.size), scale * gradient
            )
            moved = _take_bounded_step(posterior, x, step, effects)
            moved_effects = with_coordinates(effects, moved[layout.effects])
            moved = np.concatenate([moved[layout.nuisances], *[e.coordinates for e in moved_effects]])
            candidate = posterior.predict(moved, moved_effects)
            new_ll = posterior.log_likelihood(candidate.spectra, candidate.data)
            m, q = posterior.normal_prior(moved, moved_effects)
            new_lp = -0.5 * float((moved - m) @ q @ (moved - m))
            if new_ll + new_lp > ll + lp - 1e-9:
                accepted = True
                break
            damping = max(10.0 * damping, 1e-2)
        if not accepted:
            converged = float(gradient @ step) < 10.0 * tolerance
            break
        gain = new_ll + new_lp - ll - lp
        x, effects, prediction, ll, lp = moved, moved_effects, candidate, new_ll, new_lp
        damping *= 0.1
        if gain < tolerance:
            converged = True
            break
    covariance = inverse(normal)
    return MapEstimate(x, effects, ll, lp, covariance, converged, rows, residual, mean_residual)


def _take_bounded_step(posterior: Posterior, x: Array, step: Array, effects: Sequence[Effect]) -> Array:
    """Take a bounded step from `x`, shape (p,), so that a fit from a bad start does not diverge."""
    bound, layout = np.full(x.size, np.inf), posterior.layout
    bound[layout.stiffness] = bound[layout.masses] = bound[layout.correction] = 0.1
    bound[layout.damping] = bound[layout.channel_noise] = 1.0
    bound[layout.persistent] = _MAX_EFFECT_STEP * posterior.prior.units[layout.persistent]
    bound[layout.excitation] = 2.0
    logarithms = [p.scale == "log" for e in effects for p in e.parameters]
    bound[layout.effects] = np.where(logarithms, 0.5, np.inf)
    return np.asarray(x + np.clip(step, -bound, bound))
