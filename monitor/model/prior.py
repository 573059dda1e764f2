"""Prior of the structure's parameters before a recording: from its drawing, or from its healthy baseline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate, pairwise
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, ComplexArray
from monitor.model.effects import Effect
from monitor.model.model import Model

_STATED_STD = 1e-6
"""Relative standard deviation of what the structure file states of effects. [ratio; rounding]"""
_UNKNOWN_NOISE_STD = 3.0
"""Standard deviation of the logarithm of a noise density that is not known. [1; judgement: a factor of 20]"""


@dataclass(frozen=True, eq=False, slots=True)
class ModelDiscrepancy:
    """Model error of the healthy structure that no known effect explains, as a relative error E of the spectra.

    Where the model's spectra are ``L L^H``, those of the healthy structure are ``L (1 + E) L^H``.
    """

    hz: Annotated[Array, "m"]
    """Middles of narrow bands, evenly spaced, Hz; E is zero outside the bands."""
    relative: Annotated[ComplexArray, "m c c"]
    """E."""
    variance: Annotated[Array, "m"]
    """Variance of E, relative to one; zero where E is."""

    @property
    def step_hz(self) -> float:
        """Width of the bands, Hz."""
        return float(self.hz[1] - self.hz[0])

    def at(self, hz: Array) -> tuple[Annotated[NDArray[np.bool_], "hz"], Annotated[NDArray[np.intp], "inside"]]:
        """Find which frequencies (Hz) lie within the bands, and the index of the band of each of these."""
        band = np.floor((hz - self.hz[0]) / self.step_hz + 0.5).astype(int)
        inside = (band >= 0) & (band < self.hz.size)
        return inside, band[inside]

    def doubtful_hz(self) -> list[list[float]]:
        """Return the lowest and highest frequencies of the ranges where E is not zero, neighbouring bands joined, Hz."""
        out: list[list[float]] = []
        for f in self.hz[self.variance > 0.0].tolist():
            low, high = f - 0.5 * self.step_hz, f + 0.5 * self.step_hz
            if out and low < out[-1][1] + 0.01 * self.step_hz:
                out[-1][1] = high
            else:
                out.append([low, high])
        return out


@dataclass(frozen=True, eq=False)
class StructuralPrior:
    """Normal prior of the structural nuisance parameters before a recording."""

    model: Model
    mean: Annotated[Array, "p"]
    """Mean of: ln stiffness, ln mass, ln damping ratio of every mode, ln noise of every channel over their mean, persistent
    stiffness correction in the modes' coordinates; then the coordinates of the persistent effects."""
    precision: Annotated[Array, "p p"]
    """Inverse of the covariance."""
    basis: Annotated[Array, "e n n"]
    """Stiffness corrections that the persistent misfit is a sum of, N/m; e = 0 for none."""
    reference_degc: float | None = None
    known_lines_hz: tuple[float, ...] = ()
    """Line frequencies of known machines.  Bins near them inform about the machines, not about the structure."""
    error: ModelDiscrepancy | None = None
    """Model error that healthy data show; None where nothing is known of it."""
    judged_hz: tuple[float, float] | None = None
    """Band that the healthy recording could judge, where that was not its whole band: nothing is known of the model outside."""
    ln_forces: Annotated[Array, "n"] | None = None
    """Logarithms of the densities of the floors' forces at calibration, about their mean; None where not known."""

    @cached_property
    def sizes(self) -> tuple[int, int, int, int, int]:
        """Lengths of the parts of `mean` before the coordinates of the persistent effects."""
        s = self.model.structure
        known = s.n_stories, s.n_masses, s.n_dofs
        corrections = self.basis.shape[0]
        channels = self.mean.size - sum(known) - corrections - self.n_persistent
        return *known, channels, corrections

    def log_density(self, x: Array) -> float:
        """Compute the log density of coordinates, relative to that of the mean, nats."""
        far = x - self.mean
        return -0.5 * float(far @ self.precision @ far)

    @property
    def is_baseline(self) -> bool:
        """Whether the prior was learned from a healthy recording: a structure file's alone has no stiffness corrections."""
        return self.basis.size > 0

    @cached_property
    def n_persistent(self) -> int:
        """Number of coordinates of the persistent effects."""
        return sum(len(e.parameters) for e in self.model.effects)

    def persistent_parts(self, x: Array) -> list[Array]:
        """Split off the coordinates of every persistent effect from a vector of structural nuisances."""
        last, out = self.parts(x)[5], []
        for e in self.model.effects:
            out.append(last[: len(e.parameters)])
            last = last[len(e.parameters) :]
        return out

    @cached_property
    def start(self) -> Array:
        """Coordinates at which a fit starts: the mean, with the persistent effects at their stated sizes."""
        stated = [e.coordinates for e in self.model.effects]
        return np.concatenate([self.mean[: self.mean.size - self.n_persistent], *stated])

    @cached_property
    def units(self) -> Array:
        """Units of the coordinates: one, and for a persistent effect's coordinates their own magnitude."""
        return np.concatenate([np.ones(self.mean.size - self.n_persistent), *[e.units for e in self.model.effects]])

    @property
    def covariance(self) -> Array:
        """Covariance of the coordinates; zero for coordinates without any precision."""
        return inverse(self.precision)

    @property
    def standing_std(self) -> list[Array]:
        """Standard deviations of every persistent effect's coordinates."""
        return self.persistent_parts(np.sqrt(np.diag(self.covariance)))

    @property
    def channel_noises(self) -> slice:
        """Slice of the channels' noise among the coordinates."""
        k, m, d, c, _ = self.sizes
        return slice(k + m + d, k + m + d + c)

    def parts(self, x: Array) -> list[Array]:
        """Cut a vector of structural nuisances into its six parts."""
        ends = [0, *accumulate(self.sizes), self.mean.size]
        return [x[first:last] for first, last in pairwise(ends)]

    def effects(self, x: Array) -> tuple[Effect, ...]:
        """Return the persistent effects at a vector of structural nuisances."""
        return tuple(e.at(own) for e, own in zip(self.model.effects, self.persistent_parts(x), strict=True))

    def without_nonlinear(self) -> StructuralPrior:
        """Leave out the persistent effects that depend on the motion."""
        effects = tuple(e for e in self.model.effects if not e.nonlinear)
        kept, model = np.flatnonzero(self._is_linear), replace(self.model, effects=effects)
        return replace(self, model=model, mean=self.mean[kept], precision=self.precision[np.ix_(kept, kept)])

    def with_linear(self, x: Array) -> Array:
        """Set the coordinates of `without_nonlinear` in the prior's start."""
        out = self.start.copy()
        out[self._is_linear] = x
        return out

    @property
    def _is_linear(self) -> NDArray[np.bool_]:
        """Tell the coordinates of `without_nonlinear`."""
        of_effects = [not e.nonlinear for e in self.model.effects for _ in e.parameters]
        return np.array([True] * (self.mean.size - self.n_persistent) + of_effects)

    def with_unseen_scale(self, std: float) -> StructuralPrior:
        """Add uncertainty, of the logarithm, of the common scale of all masses and stiffnesses, which no output shows."""
        k, m, *_ = self.sizes
        return self._loosen_jointly(slice(k + m), std)

    def with_looser_damping(self, ln_std: Array) -> StructuralPrior:
        """Add uncertainty of the logarithm of every mode's damping ratio."""
        k, m, *_ = self.sizes
        return self._loosen(k + m, ln_std)

    def with_looser_noise(self, ln_std: Array) -> StructuralPrior:
        """Add uncertainty of the logarithm of every channel's noise density over their mean."""
        k, m, d, *_ = self.sizes
        return self._loosen(k + m + d, ln_std)

    def with_daily_persistent(self) -> StructuralPrior:
        """Add uncertainty of the persistent effects' sizes: their change from day to day, and the form of their laws."""
        std = np.concatenate([[], *[np.hypot(e.units * (e.daily or 0.0), e.form_std) for e in self.effects(self.mean)]])
        return self._loosen(self.mean.size - self.n_persistent, std) if std.any() else self

    def with_known_lines(self) -> StructuralPrior:
        """Note the line frequencies of the machines among the persistent effects.

        The machines may run a little faster or slower, and unsteadily.
        """
        lines = tuple(line.frequency_hz for e in self.effects(self.mean) for line in e.lines())
        return replace(self, known_lines_hz=lines)

    def with_any_noise(self) -> StructuralPrior:
        """Add uncertainty of the noise that all channels share, relative to the noise of the ground's sensor."""
        return self._loosen_jointly(self.channel_noises, _UNKNOWN_NOISE_STD)

    def _loosen_jointly(self, these: slice, std: float) -> StructuralPrior:
        """Add uncertainty of a change that the given coordinates have in common."""
        along = np.zeros(self.mean.size)
        along[these] = std
        # Sherman and Morrison's formula, since a coordinate that is not known at all has no finite covariance.
        weighted = self.precision @ along
        return replace(self, precision=self.precision - np.outer(weighted, weighted) / (1.0 + along @ weighted))

    def _loosen(self, first: int, std: Array) -> StructuralPrior:
        """Add independent uncertainty to the coordinates from `first` on."""
        covariance = self.covariance
        these = np.arange(first, first + std.size)
        covariance[these, these] += std**2
        precision = inverse(covariance)
        return replace(self, precision=0.5 * (precision + precision.T))


def correction_basis(model: Model, n_modes: int) -> Annotated[Array, "b n n"]:
    """Build the symmetric stiffness corrections (N/m) within the lowest modes, each of relative size one."""
    modes = model.modes()
    scaled = model.mass_matrix() @ modes.shapes[:, :n_modes] * np.sqrt(np.maximum(modes.eigenvalues[:n_modes], 0.0))
    pairs = [(a, b) for a in range(n_modes) for b in range(a, n_modes)]
    outer = [np.outer(scaled[:, a], scaled[:, b]) for a, b in pairs]
    n = scaled.shape[0]
    return np.array([0.5 * (o + o.T) for o in outer]).reshape(-1, n, n)


def prior_from_drawing(
    model: Model, prior_std: Array, n_channels: int, n_modes: int = 0, correction_std: float = 0.1
) -> StructuralPrior:
    """Make the prior that follows from the structure file alone.

    `prior_std` are relative standard deviations of stiffnesses, then masses.  Within the lowest `n_modes` modes the stiffness may
    be corrected, with the relative standard deviation `correction_std`.
    """
    s, n_corrections = model.structure, n_modes * (n_modes + 1) // 2
    sizes = [np.log(of) for of in (s.stiffness_n_per_m, s.masses_kg, model.damping_ratios())]
    mean = np.concatenate([*sizes, np.zeros(n_channels + n_corrections), *[e.coordinates for e in model.effects]])
    beside = np.repeat([0.7, 0.1, correction_std], [s.n_dofs, n_channels, n_corrections])
    std = np.concatenate([prior_std, beside])
    basis = correction_basis(model, n_modes)
    precision = np.diag(np.concatenate([std**-2.0, as_stated(model.effects)]))
    return StructuralPrior(model, mean, precision, basis).with_known_lines()


def as_stated(effects: Sequence[Effect]) -> Array:
    """Return the precisions of effects' coordinates that are taken as the structure file states them."""
    return np.concatenate([[], *[(_STATED_STD * e.units) ** -2.0 for e in effects]])


def inverse(normal: Annotated[Array, "p p"]) -> Annotated[Array, "p p"]:
    """Invert a symmetric, positive semidefinite normal matrix whose parameters have different units.

    Directions without information have zeros in the inverse.

    Examples
    --------
    >>> import numpy as np
    >>> from monitor.model import inverse
    >>> inverse(np.diag([4.0, 0.0])).tolist()
    [[0.25, 0.0], [0.0, 0.0]]
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    return np.asarray(scale[:, None] * np.linalg.pinv(normal * scale[:, None] * scale, hermitian=True) * scale)
