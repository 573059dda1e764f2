"""A problem whose linearized laws are corrected by what simulation of the exact ones adds, at the simulated sizes and near."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np

from monitor.effects import EFFECTS, Effect
from monitor.likelihood import Problem
from monitor.results import Array, ComplexArray

_SMOOTH = 0.006
"""Width over which the correction is smoothed, as a share of the frequency: about a half-power bandwidth."""
_DEEPEST = -0.85
"""Share of a predicted spectrum that the correction may take away."""

_NUDGE = 1e-5
"""Change of a nuisance by which slopes are taken."""


@dataclass(frozen=True, eq=False, slots=True)
class Corrected(Problem):
    """A problem with the linear terms of the correction by the laws' sizes; `offset` is its value at their centre."""

    laws: tuple[tuple[str, str], ...] = ()
    """Names and places of the effects that were simulated."""
    centre: Array = field(default_factory=lambda: np.zeros(0))
    """Their coordinates there, shape (p,)."""
    base: ComplexArray = field(default_factory=lambda: np.zeros(0, dtype=complex))
    """Lower Cholesky factors of the linearized spectra there, shape (classes, n_bins, c, c)."""
    relative: ComplexArray = field(default_factory=lambda: np.zeros(0, dtype=complex))
    """Correction and its slopes by the coordinates, whitened by `base`, shape (1 + p, classes, n_bins, c, c)."""

    kept: dict[bytes, ComplexArray] = field(default_factory=dict)
    """The correction at the last sizes."""

    def scatter(self, x: Array, effects: Sequence[Effect], *, classes: Sequence[int] | None = None) -> ComplexArray:
        """See `Problem.scatter`."""
        linear = Problem.scatter(replace(self, offset=None), x, effects, classes=classes)
        sizes = [e.coordinates for e in effects if (e.name, e.location) in self.laws]
        if self.offset is None or len(sizes) < len(self.laws):
            return linear
        correction = self._correction(np.concatenate(sizes))
        return np.asarray(linear + (correction if classes is None else correction[list(classes)]))

    def slopes(self, x: Array, effects: tuple[Effect, ...], spectra: ComplexArray) -> ComplexArray:
        """See `Problem.slopes`; of every class its own, since a law that bends much has its peaks elsewhere in each."""
        out = Problem.slopes(self, x, effects, spectra)
        n, p = self.context.structure.n_dofs, self.reference.mean.size
        first = sum(self.reference.sizes[:3])
        for i in (*range(first), *range(first + self.reference.sizes[3], p + n)):
            moved = x.copy()
            moved[i] += _NUDGE
            out[i] = (self.smooth(self.scatter(moved, effects)) - spectra) / _NUDGE
        for k in range(self.n_classes):
            out[p + n + k, k] = out[p : p + n, k].sum(axis=0)
        return out

    def _correction(self, sizes: Array) -> ComplexArray:
        """At sizes of the laws; the last one is kept, since most predictions move other parameters."""
        key = sizes.tobytes()
        if key not in self.kept:
            relative = np.tensordot(np.concatenate([[1.0], sizes - self.centre]), self.relative, axes=1)
            large = np.einsum("kfab,kfab->kf", relative, relative.conj()).real > _DEEPEST**2
            values, vectors = np.linalg.eigh(relative[large])  # some of every spectrum is left
            relative[large] = (vectors * np.maximum(values, _DEEPEST)[:, None, :]) @ vectors.conj().swapaxes(-1, -2)
            self.kept.clear()
            self.kept[key] = self.base @ relative @ self.base.conj().swapaxes(-1, -2)
        return self.kept[key]

    def mirrored(self, law: Effect) -> Corrected:
        """The same with a law's other hand, whose spectra are the same."""
        centre, relative, first = self.centre.copy(), self.relative.copy(), 0
        for name, place in self.laws:
            n = len(EFFECTS[name].parameters)
            if (name, place) == (law.name, law.location):
                turned = np.sign(law.coordinates) != np.sign(centre[first : first + n])
                centre[first : first + n] *= np.where(turned, -1.0, 1.0)
                relative[1 + first : 1 + first + n][turned] *= -1.0
            first += n
        return replace(self, centre=centre, relative=relative, kept={})

    @property
    def slopes_by_size(self) -> ComplexArray:
        """Of the correction, shape (p, classes, n_bins, c, c)."""
        return np.asarray(self.base @ self.relative[1:] @ self.base.conj().swapaxes(-1, -2))

    def spread(self, offsets: ComplexArray) -> ComplexArray:
        """Offsets smoothed as the correction is, shape (..., classes, n_bins, c, c)."""
        inverse = np.linalg.inv(self.base)
        relative = _smooth(inverse @ offsets @ inverse.conj().swapaxes(-1, -2), self.evidence.band.hz)
        return np.asarray(self.base @ relative @ self.base.conj().swapaxes(-1, -2))


def _smooth(relative: ComplexArray, hz: Array) -> ComplexArray:
    near = np.exp(-0.5 * ((hz[:, None] - hz) / np.maximum(_SMOOTH * hz[:, None], 1e-9)) ** 2)
    near /= near.sum(axis=1, keepdims=True)
    return np.asarray(np.moveaxis(np.tensordot(near, relative, axes=(1, -3)), 0, -3))


def corrected(
    problem: Problem, x: Array, effects: tuple[Effect, ...], offset: ComplexArray, slopes: ComplexArray
) -> Corrected:
    """The problem with a correction that was simulated at given parameters, smoothed relative to the spectra.

    Parameters
    ----------
    offset : ndarray, shape (classes, n_bins, c, c)
    slopes : ndarray, shape (p, classes, n_bins, c, c) or (0, ...)
        By the coordinates of the nonlinear effects; none where they are not known.
    """
    plain = {f.name: getattr(problem, f.name) for f in fields(Problem)}
    base = np.asarray(
        np.linalg.cholesky(Problem.scatter(replace(problem, offset=None), x, effects)), dtype=np.complex128
    )
    inverse, hz = np.linalg.inv(base), problem.evidence.band.hz
    acting = [e for e in effects if e.nonlinear]
    centre = np.concatenate([e.coordinates for e in acting])
    terms = np.zeros((1 + centre.size, *offset.shape), dtype=complex)
    terms[0], terms[1 : 1 + len(slopes)] = offset, slopes
    relative = _smooth(inverse @ terms @ inverse.conj().swapaxes(-1, -2), hz)
    plain["offset"] = offset
    laws = tuple((e.name, e.location) for e in acting)
    return Corrected(**plain, laws=laws, centre=centre, base=base, relative=relative)
