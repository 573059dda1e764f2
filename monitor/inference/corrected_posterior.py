"""Posterior whose linearized spectra are corrected by simulation of the exact laws, at the simulated sizes and near them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from monitor.core import Array, ComplexArray
from monitor.inference.ambient_posterior import AmbientPosterior
from monitor.inference.arrays import Spectra, SpectraSlopes
from monitor.inference.linearization import forced_motion
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
    """Posterior with a correction that is linear in the laws' coordinates about their centre, where it is `offset`."""

    laws: tuple[tuple[str, str], ...] = ()
    """Names and places of the simulated effects, without the persistent ones."""
    centre: Annotated[Array, "p"] = field(default_factory=lambda: np.zeros(0))
    """Coordinates of these effects at the simulation."""
    base: Spectra = field(default_factory=lambda: np.zeros(0, dtype=complex))
    """Lower Cholesky factors of the linearized spectra at the centre."""
    relative: Annotated[ComplexArray, "1+p classes bins c c"] = field(
        default_factory=lambda: np.zeros(0, dtype=complex)
    )
    """Correction and its slopes by the coordinates, relative to the linearized spectra."""
    by_motion: SpectraSlopes = field(default_factory=lambda: np.zeros(0, dtype=complex))
    """Slopes of the correction for a change of the motion instead of the law."""
    spurious_information: Annotated[Array, "p p"] = field(default_factory=lambda: np.zeros((0, 0)))
    """Spurious information on the coordinates from the random error of their slopes."""
    simulations: int = 0
    """Number of simulations of which the slopes are the mean."""
    lost: float = 0.0
    """Loss of log likelihood by the random error of the simulations, nats."""
    simulation_std: Array = field(default_factory=lambda: np.zeros(0))
    """Standard deviation of all effects' coordinates beyond that of their fit; empty where a single simulation was made."""
    motion: Annotated[Array, "classes laws"] = field(default_factory=lambda: np.zeros((0, 0)))
    """RMS motion of the linearized model at the centre along each law whose action depends on its size, m."""
    ln_mass: float = 0.0
    """Mean logarithm of the masses at the centre."""

    def part(self, evidence: ObservedSpectra, classes: NDArray[np.intp]) -> CorrectedPosterior:
        """Return the posterior for other segments; the correction depends on the law, not on the measured data."""
        return replace(
            Posterior.part(self, evidence, classes),
            offset=None if self.offset is None else self.offset[classes],
            base=self.base[classes],
            relative=self.relative[:, classes],
            by_motion=self.by_motion[:, classes],
            motion=self.motion[classes],
        )

    def complete(
        self, linear: ComplexArray, x: Array, effects: Sequence[Effect], classes: Sequence[int]
    ) -> ComplexArray:
        """Add the correction, relative to the spectra, so that it follows peaks that move or grow.

        Where the motion grows, a law acts as one of another size.  Where all masses and stiffnesses grow, it acts as one that is
        smaller in proportion.
        """
        plain, relative = self._with_model_error(linear, effects, classes), self.beyond(x, effects)
        # Too long a step gives NaN, since spectra that are not positive definite have no likelihood.
        return self.add_drift(plain if relative is None else grown_by(plain, relative[list(classes)]))

    @override
    def beyond(self, x: Array, effects: Sequence[Effect]) -> ComplexArray | None:
        if not self._applies_to(effects):
            return None
        corrected = [e for e in effects if (e.name, e.location) in self.laws]
        heavier = np.exp(x[self.layout.masses].mean() - self.ln_mass)  # in proportion to masses and stiffnesses
        scale = np.array([heavier if p.weighty else 1.0 for e in corrected for p in e.parameters])
        sizes = np.concatenate([[], *[e.coordinates for e in corrected]]) / scale
        relative = np.tensordot(np.append(1.0, sizes - self.centre), self.relative, axes=1)
        moving = _dependent_on_motion(corrected)
        if moving:
            centre = iter(np.split(self.centre * scale, np.cumsum([len(e.parameters) for e in corrected])))
            centred = [e.at(next(centre)) if e in corrected else e for e in effects]
            # The change of the motion that the size itself causes is part of the slope by the size.
            growth = iter((forced_motion(replace(self, offset=None), x, centred, moving) / self.motion).T)
            still = np.ones(self.n_classes)
            factors = [
                (next(growth) if e in moving else still)[:, None]
                ** np.array(e.amplitude_powers or (0.0,) * len(e.parameters))
                for e in corrected
            ]
            grown = sizes * (np.hstack(factors) - 1.0)
            relative = relative + np.einsum("kp,pkfab->kfab", grown, self.by_motion)
        return bound_corrections(relative)

    def _different_in_classes(self, x: Array, effects: tuple[Effect, ...]) -> list[int]:
        """List all coordinates: a strongly nonlinear law has peaks at other frequencies in each class."""
        by_class = AmbientPosterior._different_in_classes(self, x, effects)
        if not self._applies_to(effects):
            return by_class
        layout = self.layout
        owners, everything = self.owners(effects), self.effects(x, effects)
        fixed = {*range(x.size)[layout.channel_noise], *range(x.size)[layout.levels], layout.noise}
        modes = {i for i, owner in owners.items() if everything[owner].extra_modes(self.context)}
        return sorted({*by_class, *(i for i in range(x.size) if i not in fixed | modes)})

    def _applies_to(self, effects: Sequence[Effect]) -> bool:
        """Check that the correction is that of these effects."""
        return self.offset is not None and set(self.laws) <= {(e.name, e.location) for e in effects}

    def mirrored(self, law: Effect) -> CorrectedPosterior:
        """Return the posterior for a law with left and right exchanged (its new signs in `law`), whose spectra are the same."""
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
    def slopes_by_size(self) -> SpectraSlopes:
        """Slopes of the correction by the coordinates."""
        return _congruence(self.base, self.by_motion)

    def spread(self, offsets: ComplexArray) -> ComplexArray:
        """Smooth offsets of the spectra over frequency as the correction is, shape (..., classes, n_bins, c, c)."""
        inverse = np.linalg.inv(self.base)
        return _congruence(self.base, _smooth_over_frequency(_congruence(inverse, offsets), self.observed.band.hz))


def _dependent_on_motion(laws: Sequence[Effect]) -> list[Effect]:
    """Select the laws that act as ones of another size where the motion grows."""
    return [e for e in laws if e.amplitude_powers]


def _congruence(root: NDArray[Any], inner: NDArray[Any]) -> ComplexArray:
    """Compute ``R A R^H`` for stacks of matrices, shape (..., c, c)."""
    return np.asarray(root @ inner @ root.conj().swapaxes(-1, -2))


def _smooth_over_frequency(relative: ComplexArray, hz: Array) -> ComplexArray:
    """Smooth relative corrections over frequency with a normal kernel of relative width, shape (..., n_bins, c, c)."""
    near = np.exp(-0.5 * ((hz[:, None] - hz) / np.maximum(_SMOOTHING_WIDTH * hz[:, None], 1e-9)) ** 2)
    near /= near.sum(axis=1, keepdims=True)
    return np.asarray(np.moveaxis(np.tensordot(near, relative, axes=(1, -3)), 0, -3))


def bound_corrections(relative: Spectra) -> Spectra:
    """Bound relative corrections so that the corrected spectra stay positive definite."""
    deep = ~definite(relative - _MIN_CORRECTION * np.eye(relative.shape[-1])) & np.isfinite(relative).all(axis=(-2, -1))
    values, vectors = np.linalg.eigh(relative[deep])
    out = relative.copy()
    out[deep] = (vectors * np.maximum(values, _MIN_CORRECTION)[:, None, :]) @ vectors.conj().swapaxes(-1, -2)
    return out


def relative_to(spectra: Spectra, offset: Spectra, hz: Array) -> Spectra:
    """Compute ``L^-1 offset L^-H`` with ``S = L L^H``, smoothed over frequency, which reduces its random error, and bounded."""
    inverse = np.linalg.inv(np.linalg.cholesky(spectra))
    return bound_corrections(_smooth_over_frequency(_congruence(inverse, offset), hz))


def correct_posterior(
    posterior: Posterior, x: Array, effects: tuple[Effect, ...], offset: Spectra, slopes: SpectraSlopes
) -> CorrectedPosterior:
    """Correct a posterior by an offset that was simulated at given parameters and effects, smoothed relative to the spectra.

    The offset is the exact less the linearized spectra.  Its slopes are by the coordinates of the nonlinear effects; none where
    they are not known.
    """
    plain = {f.name: getattr(posterior, f.name) for f in fields(Posterior)}
    linear, hz = posterior.of_model_alone(), posterior.observed.band.hz
    acting = [e for e in effects if e.nonlinear]  # without the persistent effects
    centre, moving = np.concatenate([[], *[e.coordinates for e in acting]]), _dependent_on_motion(acting)

    def relative_at(sizes: Array, offset: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        parts = iter(np.split(sizes, np.cumsum([len(e.parameters) for e in acting])))
        moved = [e.at(next(parts)) if e.nonlinear else e for e in effects]
        base = np.asarray(np.linalg.cholesky(Posterior.scatter(linear, x, moved)), dtype=np.complex128)
        return base, _smooth_over_frequency(_congruence(np.linalg.inv(base), offset), hz)

    base, at_centre = relative_at(centre, offset)
    known = np.zeros((centre.size, *offset.shape), dtype=complex)
    known[: len(slopes)] = slopes
    by_size = []
    for i, step in enumerate(np.diag(_CORRECTION_DIFFERENCE * np.abs(centre))):
        by_size.append((relative_at(centre + step, offset + known[i] * step[i])[1] - at_centre) / step[i])
    return CorrectedPosterior(
        **plain | {"offset": offset},
        laws=tuple((e.name, e.location) for e in acting),
        centre=centre,
        base=base,
        relative=np.array([at_centre, *by_size]),
        by_motion=_smooth_over_frequency(_congruence(np.linalg.inv(base), known), hz),
        motion=forced_motion(linear, x, effects, moving) if moving else np.zeros((linear.n_classes, 0)),
        ln_mass=float(x[posterior.layout.masses].mean()),
    )
