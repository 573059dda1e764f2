"""What each force, or the ground, makes of the spectra, and how strong each was: wind comes and goes floor by floor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from monitor.core import Array, ComplexArray
from monitor.inference.posterior import Posterior
from monitor.model import Effect

_LOG_NOTHING = -100.0
"""Logarithm of the density of a force or of noise that is absent. [1; definition]"""
_MIN_SPECTRAL_DIFFERENCE = 1e-6
"""How different the spectra that forces cause must be for each force to have a level of its own. [ratio; rounding]"""
_SCORING_STEPS = 4
"""Steps of Fisher scoring to the levels. [iterations; converges in two from nearby]"""
_MIN_LEVEL_FACTOR = 0.1
"""Least share of a level that one step leaves. [ratio; judgement]"""


def spectra_by_force(posterior: Posterior, x: Array, effects: Sequence[Effect]) -> ComplexArray:
    """Each force's part of the spectra without noise and, last, an unmeasured ground's, shape (n + 1, classes, n_bins, c, c).

    What none of them makes alone is shared by the forces.
    """
    layout, n = posterior.layout, posterior.context.structure.n_dofs
    still = _silent(posterior, x)
    # What simulation adds, and what the model gets wrong from the start, is relative to all that acts together.
    linear = posterior.of_model_alone()
    calm = replace(linear, conditions=tuple(replace(c, ground=0.0) for c in posterior.conditions))
    whole, ground = posterior.scatter(still, effects), linear.scatter(still, effects) - calm.scatter(still, effects)
    none = still.copy()
    none[layout.forces] = _LOG_NOTHING
    alone, unforced = [], calm.scatter(none, effects)
    for j in range(n):
        one = none.copy()
        one[layout.forces][j] = still[layout.forces][j]
        alone.append(calm.scatter(one, effects) - unforced)
    parts = np.stack([*alone, ground])
    parts[:n] += (whole - parts.sum(axis=0)) / n
    return parts


def ground_levels(posterior: Posterior, x: Array, effects: Sequence[Effect]) -> Array:
    """How strongly an unmeasured ground shook in every class, over the forces, relative to the whole recording: (classes,)."""
    e, linear = posterior.observed, replace(posterior, offset=None)
    *alone, ground = spectra_by_force(linear, x, effects)
    forces = np.sum(alone, axis=0)
    noise = linear.scatter(x, effects) - ground - forces
    own = np.array([fit_levels(np.stack(c[:2]), *c[2:]) for c in zip(forces, ground, noise, e.spectra, strict=True)])
    relative = np.array([c.ground for c in posterior.conditions]) * own[:, 1] / own[:, 0]
    strength = e.counts * own[:, 0] * np.einsum("kfaa->k", forces).real
    return np.asarray(relative * strength.sum() / (relative @ strength))


def fit_levels(parts: ComplexArray, noise: ComplexArray, data: ComplexArray) -> Array:
    """Factors on the parts, each of shape (n_bins, c, c), that explain the data best beside the noise, shape (n_parts,)."""
    level = np.ones(len(parts))
    for _ in range(_SCORING_STEPS):
        model = np.tensordot(level, parts, axes=1) + noise
        inverse = np.linalg.inv(model)
        slopes = inverse @ parts
        rise = np.einsum("jfab,fba->j", slopes @ inverse, data - model).real
        step = np.linalg.lstsq(np.einsum("ifab,jfba->ij", slopes, slopes).real, rise, rcond=_MIN_SPECTRAL_DIFFERENCE)[0]
        level = np.maximum(level + step, _MIN_LEVEL_FACTOR * level)
    return level


def _silent(posterior: Posterior, x: Array) -> Array:
    """The nuisances without noise."""
    still = x.copy()
    still[posterior.layout.noise] = _LOG_NOTHING
    return still
