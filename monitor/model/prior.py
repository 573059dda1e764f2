"""What is known of the structure before a recording is seen: from its drawing, or from its healthy baseline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise

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
    """What the model gets wrong from the start and no known effect explains: where its spectra are ``L L^H``, healthy ones are
    ``L (1 + E) L^H``.
    """

    hz: Array
    """Middles of narrow bands, evenly spaced, shape (m,); outside E is nothing."""
    relative: ComplexArray
    """E, shape (m, c, c)."""
    variance: Array
    """Of E, relative to one, shape (m,); nothing where E is."""

    @property
    def step_hz(self) -> float:
        """Width of the bands."""
        return float(self.hz[1] - self.hz[0])

    def at(self, hz: Array) -> tuple[NDArray[np.bool_], NDArray[np.intp]]:
        """Which frequencies lie within the bands, and the bands of these."""
        band = np.floor((hz - self.hz[0]) / self.step_hz + 0.5).astype(int)
        inside = (band >= 0) & (band < self.hz.size)
        return inside, band[inside]

    def doubtful_hz(self) -> list[list[float]]:
        """Lowest and highest frequencies where E is something, with neighbours joined."""
        out: list[list[float]] = []
        for f in self.hz[self.variance > 0.0].tolist():
            low, high = f - 0.5 * self.step_hz, f + 0.5 * self.step_hz
            if out and low < out[-1][1] + 0.01 * self.step_hz:
                out[-1][1] = high
            else:
                out.append([low, high])
        return out


@dataclass(frozen=True, eq=False, slots=True)
class StructuralPrior:
    """What is known of the structure before the recording is seen."""

    model: Model
    mean: Array
    """Of ln stiffness, ln mass, ln damping ratio of every mode, ln noise of every channel over their mean, standing stiffness
    correction in the modes' coordinates; then the standing effects' coordinates."""
    precision: Array
    """Shape (p, p)."""
    basis: Array
    """Stiffness corrections that the standing misfit may be made of, shape (e, n, n), N/m; e = 0 for none."""
    reference_degc: float | None = None
    known_lines_hz: tuple[float, ...] = ()
    """Lines of machines that are known: what a recording has about them tells of those, not of the structure."""
    error: ModelDiscrepancy | None = None
    """Of healthy data that contradict the model."""

    @property
    def sizes(self) -> tuple[int, int, int, int, int]:
        """Lengths of the parts of `mean` before the standing effects'."""
        s = self.model.structure
        n = s.n_dofs
        corrections = self.basis.shape[0]
        channels = self.mean.size - s.stiffness_n_per_m.size - 2 * n - corrections - self.n_standing
        return s.stiffness_n_per_m.size, n, n, channels, corrections

    @property
    def n_standing(self) -> int:
        """Coordinates of the standing effects."""
        return sum(len(e.parameters) for e in self.model.effects)

    def standing(self, x: Array) -> list[Array]:
        """Every standing effect's coordinates of a vector of structural nuisances, shape (p,) each."""
        last, out = self.parts(x)[5], []
        for e in self.model.effects:
            out.append(last[: len(e.parameters)])
            last = last[len(e.parameters) :]
        return out

    @property
    def units(self) -> Array:
        """Sizes by which the coordinates are small or large: one, and of the standing effects' that of their own."""
        return np.concatenate([np.ones(self.mean.size - self.n_standing), *[e.units for e in self.model.effects]])

    @property
    def covariance(self) -> Array:
        """Of the coordinates; those without any precision have none."""
        return inverse(self.precision)

    @property
    def standing_std(self) -> list[Array]:
        """Standard deviations of every standing effect's coordinates, shape (p,) each."""
        return self.standing(np.sqrt(np.diag(self.covariance)))

    @property
    def channel_noises(self) -> slice:
        """Where the channels' noise lies among the coordinates."""
        k, m, d, c, _ = self.sizes
        return slice(k + m + d, k + m + d + c)

    def parts(self, x: Array) -> list[Array]:
        """Cut a vector of structural nuisances into its six parts."""
        ends = [0, *accumulate(self.sizes), self.mean.size]
        return [x[first:last] for first, last in pairwise(ends)]

    def effects(self, x: Array) -> tuple[Effect, ...]:
        """The standing effects at a vector of nuisances."""
        return tuple(e.at(own) for e, own in zip(self.model.effects, self.standing(x), strict=True))

    def with_unseen_scale(self, std: float) -> StructuralPrior:
        """Where all masses and stiffnesses together may be larger or smaller by so much, which no output shows."""
        k, m, *_ = self.sizes
        return self._wider(slice(k + m), std)

    def with_looser_damping(self, ln_std: Array) -> StructuralPrior:
        """Where the damping of every mode may differ by so much more, shape (n,)."""
        k, m, *_ = self.sizes
        return self._looser(k + m, ln_std)

    def with_looser_noise(self, ln_std: Array) -> StructuralPrior:
        """Where the noise density of every channel, over their mean, may differ by so much more, shape (c,)."""
        k, m, d, *_ = self.sizes
        return self._looser(k + m + d, ln_std)

    def with_daily_standing(self) -> StructuralPrior:
        """Where standing effects may be of another size on another day, or as the form of their law leaves open."""
        std = np.concatenate([[], *[np.hypot(e.units * (e.daily or 0.0), e.form_std) for e in self.effects(self.mean)]])
        return self._looser(self.mean.size - self.n_standing, std) if std.any() else self

    def with_known_lines(self) -> StructuralPrior:
        """Where machines among the standing effects may run a little faster or slower, and unsteadily."""
        lines = tuple(line.frequency_hz for e in self.effects(self.mean) for line in e.lines())
        return replace(self, known_lines_hz=lines)

    def with_any_noise(self) -> StructuralPrior:
        """Where the channels, all alike, may be more or less noisy than the sensor of the ground."""
        return self._wider(self.channel_noises, _UNKNOWN_NOISE_STD)

    def _wider(self, these: slice, std: float) -> StructuralPrior:
        """Where coordinates may all together be larger or smaller by so much more."""
        along = np.zeros(self.mean.size)
        along[these] = std
        held = self.precision @ along  # Sherman and Morrison: what is not known at all has no covariance
        return replace(self, precision=self.precision - np.outer(held, held) / (1.0 + along @ held))

    def _looser(self, first: int, std: Array) -> StructuralPrior:
        """Where coordinates from `first` on may differ by so much more."""
        covariance = self.covariance
        these = np.arange(first, first + std.size)
        covariance[these, these] += std**2
        precision = inverse(covariance)
        return replace(self, precision=0.5 * (precision + precision.T))


def correction_basis(model: Model, n_modes: int) -> Array:
    """Symmetric corrections of the stiffness within the lowest modes, each of relative size one, shape (e, n, n)."""
    modes = model.modes()
    carried = model.mass_matrix() @ modes.shapes[:, :n_modes] * np.sqrt(np.maximum(modes.eigenvalues[:n_modes], 0.0))
    pairs = [(a, b) for a in range(n_modes) for b in range(a, n_modes)]
    outer = [np.outer(carried[:, a], carried[:, b]) for a, b in pairs]
    n = carried.shape[0]
    return np.array([0.5 * (o + o.T) for o in outer]).reshape(-1, n, n)


def prior_from_drawing(
    model: Model, prior_std: Array, n_channels: int, n_modes: int = 0, correction_std: float = 0.1
) -> StructuralPrior:
    """What the structure file alone says.

    Parameters
    ----------
    prior_std : ndarray, shape (n_stiffness + n,)
        Relative standard deviations of stiffness and masses.
    """
    s = model.structure
    n = s.mass_matrix().shape[0]
    mean = np.concatenate(
        [
            np.log(s.stiffness_n_per_m),
            np.log(np.diag(s.mass_matrix())),
            np.log(model.damping_ratios()),
            np.zeros(n_channels + n_modes * (n_modes + 1) // 2),
            *[e.coordinates for e in model.effects],
        ]
    )
    std = np.concatenate(
        [prior_std, np.full(n, 0.7), np.full(n_channels, 0.1), np.full(n_modes * (n_modes + 1) // 2, correction_std)]
    )
    basis = correction_basis(model, n_modes)
    precision = np.diag(np.concatenate([std**-2.0, as_stated(model.effects)]))
    return StructuralPrior(model, mean, precision, basis).with_known_lines()


def as_stated(effects: Sequence[Effect]) -> Array:
    """Precision of coordinates that are taken as stated."""
    return np.concatenate([[], *[(_STATED_STD * e.units) ** -2.0 for e in effects]])


def inverse(normal: Array) -> Array:
    """Inverse of a normal matrix whose parameters have different units; directions without information get none."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    return np.asarray(scale[:, None] * np.linalg.pinv(normal * scale[:, None] * scale, hermitian=True) * scale)
