"""Parts of the spectra by each force and by the ground, and their levels: wind varies from floor to floor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated

import numpy as np

from monitor.core import Array, ComplexArray
from monitor.inference.arrays import Spectrum
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
    """Split the spectra without noise into the parts of each force and, last, of an unmeasured ground.

    The rest, which none of them causes alone, is shared equally by the forces.  Shape (n + 1, classes, bins, c, c).
    """
    layout, n = posterior.layout, posterior.context.structure.n_dofs
    posterior, noiseless = posterior.without_drift(), x.copy()
    noiseless[layout.noise] = _LOG_NOTHING
    # The simulated correction and the known model error are relative to the spectra of all forces together.
    linear = posterior.of_model_alone()
    calm = replace(linear, conditions=tuple(replace(c, ground=0.0) for c in posterior.conditions))
    whole = posterior.scatter(noiseless, effects)
    ground = linear.scatter(noiseless, effects) - calm.scatter(noiseless, effects)
    none = noiseless.copy()
    none[layout.forces] = _LOG_NOTHING
    alone, unforced = [], calm.scatter(none, effects)
    for j in range(n):
        one = none.copy()
        one[layout.forces][j] = noiseless[layout.forces][j]
        alone.append(calm.scatter(one, effects) - unforced)
    parts = np.stack([*alone, ground])
    parts[:n] += (whole - parts.sum(axis=0)) / n
    return parts


def ground_levels(posterior: Posterior, x: Array, effects: Sequence[Effect]) -> Annotated[Array, "classes"]:
    """Estimate the level of an unmeasured ground over that of the forces in every class, relative to the whole recording."""
    e, linear = posterior.observed, replace(posterior, offset=None)
    *alone, ground = spectra_by_force(linear, x, effects)
    forces = np.sum(alone, axis=0)
    noise = linear.scatter(x, effects) - ground - forces
    own = np.array([fit_levels(np.stack(c[:2]), *c[2:]) for c in zip(forces, ground, noise, e.spectra, strict=True)])
    relative = np.array([c.ground for c in posterior.conditions]) * own[:, 1] / own[:, 0]
    strength = e.counts * own[:, 0] * np.einsum("kfaa->k", forces).real
    return np.asarray(relative * strength.sum() / (relative @ strength))


def fit_levels(parts: Annotated[ComplexArray, "parts bins c c"], noise: Spectrum, data: Spectrum) -> Array:
    """Fit the factors on the parts of a spectrum that explain the data best, together with the noise, by Fisher scoring.

    Examples
    --------
    >>> import numpy as np
    >>> from monitor.inference import fit_levels
    >>> parts = np.ones((1, 4, 1, 1), dtype=complex)
    >>> fit_levels(parts, noise=0.1 * parts[0], data=2.1 * parts[0]).round(6)
    array([2.])
    """
    level = np.ones(len(parts))
    for _ in range(_SCORING_STEPS):
        model = np.tensordot(level, parts, axes=1) + noise
        inverse = np.linalg.inv(model)
        slopes = inverse @ parts
        rise = np.einsum("jfab,fba->j", slopes @ inverse, data - model).real
        step = np.linalg.lstsq(np.einsum("ifab,jfba->ij", slopes, slopes).real, rise, rcond=_MIN_SPECTRAL_DIFFERENCE)[0]
        level = np.maximum(level + step, _MIN_LEVEL_FACTOR * level)
    return level
