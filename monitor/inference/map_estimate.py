"""Most probable parameters: Fisher scoring with Levenberg-Marquardt steps."""

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
    """A model fitted to evidence."""

    x: Array
    """Structural nuisances, excitation, then the extra effects' coordinates."""
    effects: tuple[Effect, ...]
    """The extra effects."""
    log_likelihood: float
    """Tempered for correlated bins and segments, nats; without the prior."""
    log_prior: float
    covariance: Array
    """Of x."""
    converged: bool
    jacobian: Array
    """Whitened slopes, each row weighed by the root of its information, shape (rows, p): classes * bins * c * c rows of
    the spectra, then those of the segments' means where the ground was measured."""
    residual: Array
    """Whitened and weighed residual of the spectra's rows."""
    mean_residual: Array
    """That of the means' rows."""

    @property
    def log_posterior(self) -> float:
        """Of the fit, up to a constant."""
        return self.log_likelihood + self.log_prior

    @property
    def n_effect(self) -> int:
        """Coordinates of the extra effects."""
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
    """Most probable parameters near `x` by Fisher scoring with Levenberg-Marquardt steps.

    Parameters
    ----------
    x : ndarray
        Nuisances; the effects' coordinates are taken from `effects`.
    tolerance : float
        Converged when a step promises less gain than this, nats.
    frozen : ndarray, optional
        Whitened slopes of the nuisances, shape (rows, n_nuisance), taken as they are: quicker, for a ranking.
    """
    layout = posterior.layout
    x = np.concatenate([x[layout.nuisances], *[e.coordinates for e in effects]])
    here = posterior.predict(x, effects)
    ll, lp = posterior.log_likelihood(here.spectra, here.data), posterior.score(x, effects)[1]
    damping, converged, gain = 1e-3, False, np.inf
    rows, residual, mean_residual, normal = np.zeros((0, x.size)), np.zeros(0), np.zeros(0), np.eye(x.size)
    for _ in range(iterations if np.isfinite(ll) else 0):  # a law that runs away at its start leads nowhere
        if gain > _FIXED_SLOPES_GAIN or here.left is not None:
            rows, residual, mean_residual = posterior.jacobian(
                x, effects, here, first=0 if frozen is None else layout.n_nuisance
            )
            if frozen is not None:
                rows = np.concatenate([frozen, rows], axis=1)
        else:  # so near the end slopes change no more
            residual = posterior.whitened(here.spectra, here.spectra[None][:0], here.data)[1]
        mean, precision = posterior.normal_prior(x, effects)
        normal = rows.T @ rows + precision
        gradient = rows.T @ np.concatenate([residual, mean_residual]) - precision @ (x - mean)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
        accepted = False
        for _ in range(6):
            step = scale * np.linalg.solve(
                normal * scale[:, None] * scale + (damping + 1e-12) * np.eye(x.size), scale * gradient
            )
            moved = _limited(posterior, x, step, effects)
            there = with_coordinates(effects, moved[layout.effects])
            moved = np.concatenate([moved[layout.nuisances], *[e.coordinates for e in there]])
            candidate = posterior.predict(moved, there)
            new_ll = posterior.log_likelihood(candidate.spectra, candidate.data)
            m, q = posterior.normal_prior(moved, there)
            new_lp = -0.5 * float((moved - m) @ q @ (moved - m))
            if new_ll + new_lp > ll + lp - 1e-9:
                accepted = True
                break
            damping = max(10.0 * damping, 1e-2)
        if not accepted:
            converged = float(gradient @ step) < 10.0 * tolerance
            break
        gain = new_ll + new_lp - ll - lp
        x, effects, here, ll, lp = moved, there, candidate, new_ll, new_lp
        damping *= 0.1
        if gain < tolerance:
            converged = True
            break
    covariance = inverse(normal)
    return MapEstimate(x, effects, ll, lp, covariance, converged, rows, residual, mean_residual)


def _limited(posterior: Posterior, x: Array, step: Array, effects: Sequence[Effect]) -> Array:
    """A step bounded so that a bad start cannot run away."""
    bound, layout = np.full(x.size, np.inf), posterior.layout
    bound[layout.stiffness] = bound[layout.masses] = bound[layout.correction] = 0.1
    bound[layout.damping] = bound[layout.channel_noise] = 1.0
    bound[layout.persistent] = _MAX_EFFECT_STEP * posterior.prior.units[layout.persistent]
    bound[layout.excitation] = 2.0
    logarithms = [p.scale == "log" for e in effects for p in e.parameters]
    bound[layout.effects] = np.where(logarithms, 0.5, np.inf)
    return np.asarray(x + np.clip(step, -bound, bound))
