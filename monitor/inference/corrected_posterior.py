"""A posterior whose linearized laws are corrected by what simulation of the exact ones adds, at the simulated sizes and near."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, ComplexArray
from monitor.inference.ambient_posterior import AmbientPosterior
from monitor.inference.linearization import forced_drift
from monitor.inference.observed_spectra import ObservedSpectra
from monitor.inference.posterior import Posterior
from monitor.inference.wishart import definite, grown_by
from monitor.model import EFFECTS, Effect

_SMOOTHING_WIDTH = 0.006
"""Width over which the correction is smoothed, over the frequency. [ratio; a half-power bandwidth]"""
_MIN_CORRECTION = -0.85
"""Largest share of a predicted spectrum that the correction may take away, as a negative number. [ratio; judgement]"""

_CORRECTION_DIFFERENCE = 0.01
"""Relative change of a size over which slopes are taken. [ratio; judgement]"""


@dataclass(frozen=True, eq=False, slots=True)
class CorrectedPosterior(AmbientPosterior):
    """A posterior with the linear terms of the correction by the laws' sizes; `offset` is its value at their centre."""

    laws: tuple[tuple[str, str], ...] = ()
    """Names and places of the effects that were simulated, besides those that stand."""
    centre: Array = field(default_factory=lambda: np.zeros(0))
    """Their coordinates there, shape (p,)."""
    base: ComplexArray = field(default_factory=lambda: np.zeros(0, dtype=complex))
    """Lower Cholesky factors of the linearized spectra there, shape (classes, n_bins, c, c)."""
    relative: ComplexArray = field(default_factory=lambda: np.zeros(0, dtype=complex))
    """Correction and its slopes by the coordinates, relative to the linearized spectra, shape (1 + p, classes, n_bins, c, c)."""
    by_motion: ComplexArray = field(default_factory=lambda: np.zeros(0, dtype=complex))
    """The same slopes where not the law but the motion changes, shape (p, classes, n_bins, c, c)."""
    feigned: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """Information on the coordinates that the chance in their slopes feigns, shape (p, p)."""
    simulations: int = 0
    """How many the slopes are the mean of."""
    lost: float = 0.0
    """Log likelihood that the simulations' chance takes away, nats."""
    doubt: Array = field(default_factory=lambda: np.zeros(0))
    """Standard deviation of all effects' coordinates beyond their fit's own; empty where a single simulation was made."""
    drift: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """The linearized model's RMS drift there, shape (classes, n_stories), m."""
    ln_mass: float = 0.0
    """Mean logarithm of the masses there."""

    def part(self, evidence: ObservedSpectra, classes: NDArray[np.intp]) -> CorrectedPosterior:
        """See `Posterior.part`; the correction is a matter of the law, not of what was measured."""
        return replace(
            Posterior.part(self, evidence, classes),
            offset=None if self.offset is None else self.offset[classes],
            base=self.base[classes],
            relative=self.relative[:, classes],
            by_motion=self.by_motion[:, classes],
            drift=self.drift[classes],
        )

    def scatter(self, x: Array, effects: Sequence[Effect], *, classes: Sequence[int] | None = None) -> ComplexArray:
        """See `Posterior.scatter`.

        The correction is relative to the spectra: peaks that move or grow take it along.  Where the motion grows, a law acts
        as one of another size does; where all masses and stiffnesses do, as one that is as much smaller.
        """
        plain = replace(self, offset=None)
        linear = Posterior.scatter(plain, x, effects, classes=classes)
        relative = self.beyond(x, effects)
        if relative is None:
            return linear
        # A step too far gives NaN: a model that is none has no likelihood.
        return grown_by(linear, relative if classes is None else relative[list(classes)])

    def beyond(self, x: Array, effects: Sequence[Effect]) -> ComplexArray | None:
        """See `Posterior.beyond`."""
        if not self._acts(effects):
            return None
        here = [e for e in effects if (e.name, e.location) in self.laws]
        scale = self._scale(x, here)
        sizes = np.concatenate([[], *[e.coordinates for e in here]]) / scale
        relative = np.tensordot(np.append(1.0, sizes - self.centre), self.relative, axes=1)
        if any(e.amplitude_powers for e in here):
            centre = iter(np.split(self.centre * scale, np.cumsum([len(e.parameters) for e in here])))
            centred = [e.at(next(centre)) if e in here else e for e in effects]
            # What the size itself makes of the motion is in its slope.
            growth = forced_drift(replace(self, offset=None), x, centred) / self.drift
            grown = sizes * (np.hstack([_scaled(e, growth) for e in here]) - 1.0)
            relative = relative + np.einsum("kp,pkfab->kfab", grown, self.by_motion)
        return _bounded(relative)

    def _scale(self, x: Array, laws: Sequence[Effect]) -> Array:
        """By what laws' coordinates must grow to stay as strong beside the masses and stiffnesses, shape (p,)."""
        grown = np.exp(x[self.layout.masses].mean() - self.ln_mass)
        return np.array([grown if p.weighty else 1.0 for e in laws for p in e.parameters])

    def slope(self, x: Array, i: int, effects: tuple[Effect, ...], spectra: ComplexArray) -> ComplexArray:
        """See `Posterior.slope`; of every class its own, since a law that bends much has its peaks elsewhere in each."""
        if not self._acts(effects):
            return Posterior.slope(self, x, i, effects, spectra)
        return self.slope_by_class(x, i, effects, spectra)

    def _acts(self, effects: Sequence[Effect]) -> bool:
        """Whether the correction is that of these effects."""
        return self.offset is not None and set(self.laws) <= {(e.name, e.location) for e in effects}

    def mirrored(self, law: Effect) -> CorrectedPosterior:
        """The same with a law's other hand, whose spectra are the same."""
        centre, relative, grown, first = self.centre.copy(), self.relative.copy(), self.by_motion.copy(), 0
        for name, place in self.laws:
            n = len(EFFECTS[name].parameters)
            if (name, place) == (law.name, law.location):
                turned = np.sign(law.coordinates) != np.sign(centre[first : first + n])
                centre[first : first + n] *= np.where(turned, -1.0, 1.0)
                relative[1 + first : 1 + first + n][turned] *= -1.0
                grown[first : first + n][turned] *= -1.0
            first += n
        return replace(self, centre=centre, relative=relative, by_motion=grown)

    @property
    def slopes_by_size(self) -> ComplexArray:
        """Of the correction, shape (p, classes, n_bins, c, c)."""
        return _around(self.base, self.by_motion)

    def spread(self, offsets: ComplexArray) -> ComplexArray:
        """Offsets smoothed as the correction is, shape (..., classes, n_bins, c, c)."""
        inverse = np.linalg.inv(self.base)
        return _around(self.base, _smooth(_around(inverse, offsets), self.observed.band.hz))


def _scaled(effect: Effect, growth: Array) -> Array:
    """By how much a law's sizes seem changed where its story's drift has grown, shape (classes, p)."""
    if not effect.amplitude_powers:
        return np.ones((len(growth), len(effect.parameters)))
    return np.asarray(growth[:, [effect.index]] ** np.array(effect.amplitude_powers))


def _around(root: NDArray[Any], inner: NDArray[Any]) -> ComplexArray:
    return np.asarray(root @ inner @ root.conj().swapaxes(-1, -2))


def _smooth(relative: ComplexArray, hz: Array) -> ComplexArray:
    near = np.exp(-0.5 * ((hz[:, None] - hz) / np.maximum(_SMOOTHING_WIDTH * hz[:, None], 1e-9)) ** 2)
    near /= near.sum(axis=1, keepdims=True)
    return np.asarray(np.moveaxis(np.tensordot(near, relative, axes=(1, -3)), 0, -3))


def _bounded(relative: ComplexArray) -> ComplexArray:
    """Corrections that leave some of every spectrum."""
    deep = ~definite(relative - _MIN_CORRECTION * np.eye(relative.shape[-1])) & np.isfinite(relative).all(axis=(-2, -1))
    values, vectors = np.linalg.eigh(relative[deep])
    out = relative.copy()
    out[deep] = (vectors * np.maximum(values, _MIN_CORRECTION)[:, None, :]) @ vectors.conj().swapaxes(-1, -2)
    return out


def relative_to(spectra: ComplexArray, offset: ComplexArray, hz: Array) -> ComplexArray:
    """A simulated offset with less chance in it: smooth and relative to the spectra, shape (classes, n_bins, c, c)."""
    inverse = np.linalg.inv(np.linalg.cholesky(spectra))
    return _bounded(_smooth(_around(inverse, offset), hz))


def correct_posterior(
    posterior: Posterior, x: Array, effects: tuple[Effect, ...], offset: ComplexArray, slopes: ComplexArray
) -> CorrectedPosterior:
    """The posterior with a correction that was simulated at given parameters, smoothed relative to the spectra.

    Parameters
    ----------
    offset : ndarray, shape (classes, n_bins, c, c)
    slopes : ndarray, shape (p, classes, n_bins, c, c) or (0, ...)
        By the coordinates of the nonlinear effects; none where they are not known.
    """
    plain = {f.name: getattr(posterior, f.name) for f in fields(Posterior)}
    linear, hz = posterior.of_model_alone(), posterior.observed.band.hz
    acting = [e for e in effects if e.nonlinear]  # beside those that stand
    centre = np.concatenate([[], *[e.coordinates for e in acting]])

    def relative_at(sizes: Array, offset: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        parts = iter(np.split(sizes, np.cumsum([len(e.parameters) for e in acting])))
        moved = [e.at(next(parts)) if e.nonlinear else e for e in effects]
        base = np.asarray(np.linalg.cholesky(Posterior.scatter(linear, x, moved)), dtype=np.complex128)
        return base, _smooth(_around(np.linalg.inv(base), offset), hz)

    base, here = relative_at(centre, offset)
    known = np.zeros((centre.size, *offset.shape), dtype=complex)
    known[: len(slopes)] = slopes
    by_size = []
    for i, step in enumerate(np.diag(_CORRECTION_DIFFERENCE * np.abs(centre))):
        by_size.append((relative_at(centre + step, offset + known[i] * step[i])[1] - here) / step[i])
    return CorrectedPosterior(
        **plain | {"offset": offset},
        laws=tuple((e.name, e.location) for e in acting),
        centre=centre,
        base=base,
        relative=np.array([here, *by_size]),
        by_motion=_smooth(_around(np.linalg.inv(base), known), hz),
        drift=forced_drift(linear, x, effects),
        ln_mass=float(x[posterior.layout.masses].mean()),
    )
