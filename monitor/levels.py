"""What each force, or the ground, makes of the spectra, and how strong each was: wind comes and goes floor by floor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from monitor.effects import Effect
from monitor.likelihood import Problem
from monitor.results import Array, ComplexArray

_NONE = -100.0
"""Logarithm of a force's or of noise's density that is none."""
_APART = 1e-6
"""How different what forces make must be for each to have a level of its own."""
_STEPS = 4
"""Of Fisher scoring to the levels; from nearby it converges in two."""
_LEAST = 0.1
"""What one step leaves of a level."""


def by_force(problem: Problem, x: Array, effects: Sequence[Effect]) -> ComplexArray:
    """Each force's part of the spectra without noise, shape (n, classes, n_bins, c, c); what none makes alone is shared."""
    p, n = problem.reference.mean.size, problem.context.structure.n_dofs
    still = _silent(problem, x)
    signal, linear = problem.scatter(still, effects), replace(problem, offset=None)
    forces = still[p : p + n].copy()
    still[p : p + n] = _NONE
    alone = []
    for j in range(n):
        one = still.copy()
        one[p + j] = forces[j]
        alone.append(linear.scatter(one, effects) - linear.scatter(still, effects))
    parts = np.stack(alone)
    return np.asarray(parts + (signal - parts.sum(axis=0)) / n)


def ground_levels(problem: Problem, x: Array, effects: Sequence[Effect]) -> Array:
    """How strongly an unmeasured ground shook, over the forces, relative to the whole recording, shape (classes,)."""
    still, linear = _silent(problem, x), replace(problem, offset=None)
    without = tuple(replace(c, ground=0.0) for c in problem.conditions)
    forces = replace(linear, conditions=without).scatter(still, effects)
    ground = linear.scatter(still, effects) - forces
    noise = linear.scatter(x, effects) - ground - forces
    e = problem.evidence
    own = np.array([levels(np.stack(c[:2]), *c[2:]) for c in zip(forces, ground, noise, e.spectra, strict=True)])
    relative = np.array([c.ground for c in problem.conditions]) * own[:, 1] / own[:, 0]
    strength = e.counts * np.einsum("kfaa->k", own[:, :1, None, None] * forces).real
    return np.asarray(relative * strength.sum() / (relative @ strength))


def levels(parts: ComplexArray, noise: ComplexArray, data: ComplexArray) -> Array:
    """Factors on the parts, each of shape (n_bins, c, c), that explain the data best beside the noise, shape (n_parts,)."""
    level = np.ones(len(parts))
    for _ in range(_STEPS):
        model = np.tensordot(level, parts, axes=1) + noise
        inverse = np.linalg.inv(model)
        slopes = inverse @ parts
        rise = np.einsum("jfab,fba->j", slopes @ inverse, data - model).real
        step = np.linalg.lstsq(np.einsum("ifab,jfba->ij", slopes, slopes).real, rise, rcond=_APART)[0]
        level = np.maximum(level + step, _LEAST * level)
    return level


def _silent(problem: Problem, x: Array) -> Array:
    """The nuisances without noise."""
    still = x.copy()
    still[problem.n_nuisance - 1] = _NONE
    return still
