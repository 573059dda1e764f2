"""Forward model: prediction of the segments' spectra, and of their response to a measured ground motion, from parameters."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array
from monitor.inference.arrays import Spectra, Transforms
from monitor.inference.cross_spectra import Excitation, cross_spectra, extended, modally_damped, noise_density
from monitor.inference.observed_spectra import ObservedSpectra
from monitor.inference.parameter_layout import ParameterLayout
from monitor.inference.wishart import grown_by
from monitor.model import Condition, Context, Effect, Model, StructuralPrior, System

_LINE_BINS = 3.0
"""Half-width of the band around a known machine's line that is not compared. [bins; the taper's main lobe]"""
_LINE_SHARE = 0.01
"""The same as a share of the line's frequency. [ratio; judgement: motors slip]"""


Laws = Literal["exact", "coarse", "linearized"]
"""How nonlinear laws act on a response: integrated in time, integrated in longer steps, or linearized."""


@dataclass(frozen=True, eq=False, slots=True)
class Prediction:
    """Prediction of the segments' spectra, with the measured spectra to compare.

    Without a measured ground motion the segments are random with zero mean.  With one, the segments' means are the response to
    it.  `spectra` and `data` are then those of the residuals, so that `data` depend on the parameters.
    """

    spectra: Spectra
    data: Spectra
    """Measured spectra."""
    left: Transforms | None = None
    """Residuals, segments less their means; None without a measured ground motion."""


@dataclass(frozen=True, eq=False, slots=True)
class ForwardModel(ABC):
    """Model that predicts the spectra of a recording's segments from parameters and effects.

    The excitation is defined by the two kinds of posterior: forces only (`AmbientPosterior`), or forces and a measured ground
    motion (`DrivenPosterior`).
    """

    observed: ObservedSpectra
    prior: StructuralPrior
    context: Context
    conditions: tuple[Condition, ...]
    """Condition of every class."""
    offset: Spectra | None = None
    """Simulated correction of the linearized spectra; None for no correction."""
    damped_as_built: bool = False
    """Whether the damping matrix is that of the structure without the extra effects; else the modal ratios do not change."""
    left_out: Annotated[NDArray[np.bool_], "bins"] | None = None
    """Mask of the bins that are not compared."""

    @property
    def n_classes(self) -> int:
        """Number of classes of level and temperature."""
        return int(self.observed.counts.size)

    @property
    def layout(self) -> ParameterLayout:
        """Layout of the groups of parameters in `x`."""
        return ParameterLayout.of(self.prior, self.n_classes)

    def of_model_alone(self) -> Self:
        """Return the forward model without the simulated correction, the known model error and the sensors' drift."""
        return replace(self.without_drift(), offset=None, prior=replace(self.prior, error=None))

    def without_drift(self) -> Self:
        """Return the forward model without the drift of the sensors."""
        return self if self.observed.drift is None else replace(self, observed=replace(self.observed, drift=None))

    def widths(self) -> Annotated[Array, "bins"]:
        """Compute the number of independent bins in each bin.

        The number is zero about known machines' lines, where a sensor's fault rules the spectrum, and in bins left out.  It is
        smaller where the model error is known.
        """
        band = self.observed.band
        out = np.ones(band.n_bins)
        for line in self.prior.known_lines_hz:
            out[np.abs(band.hz - line) <= max(_LINE_BINS * band.bin_hz, _LINE_SHARE * line)] = 0.0
        for low, high in (ends for item in self.observed.segments.left_out for ends in item.hz):
            out[(band.hz > low - 0.5 * band.bin_hz) & (band.hz < high + 0.5 * band.bin_hz)] = 0.0
        if self.left_out is not None:
            out[self.left_out] = 0.0
        error = self.prior.error
        if error is not None:
            inside, at = error.at(band.hz)
            # A model error that is common to all segments and bins of a narrow band does not average out.
            out[inside] /= 1.0 + error.variance[at] * self.observed.pieces(error.step_hz / band.bin_hz)
        return out

    def predict(self, x: Array, effects: Sequence[Effect]) -> Prediction:
        """Predict the spectra of the segments about their means."""
        return Prediction(self.scatter(x, effects), self.observed.spectra)

    def mean(self, x: Array, effects: Sequence[Effect], *, laws: Laws = "exact") -> Transforms:
        """Predict the segments' means, the response to measured inputs; zero without any.

        Nonlinear laws are integrated in time ("exact"); in longer steps, for differences of two means ("coarse"); or replaced by
        their linearization, which is faster.
        """
        return np.zeros_like(self.observed.segments.values)

    def spectra(self, x: Array, effects: Sequence[Effect]) -> Spectra:
        """Predict the cross-spectra of the classes."""
        return self.scatter(x, effects)

    def scatter(self, x: Array, effects: Sequence[Effect], *, classes: Sequence[int] | None = None) -> Spectra:
        """Predict the cross-spectra of the wanted classes' segments about their means, of all classes by default."""
        wanted = range(self.n_classes) if classes is None else classes
        return self.complete(self.linear_spectra(x, self.effects(x, effects), wanted), x, effects, wanted)

    def complete(self, linear: Spectra, x: Array, effects: Sequence[Effect], classes: Sequence[int]) -> Spectra:
        """Add the simulated correction, the known model error and the sensors' drift to the wanted classes' linear spectra."""
        spectra = linear if self.offset is None else linear + self.offset[list(classes)]
        return self.add_drift(self._with_model_error(spectra, effects, classes))

    def add_drift(self, spectra: Spectra) -> Spectra:
        """Add the power of the sensors' drift to spectra."""
        if self.observed.drift is None:
            return spectra
        out, channel = spectra.copy(), np.arange(self.observed.drift.shape[1])
        out[:, :, channel, channel] += self.observed.drift
        return out

    def linear_spectra(self, x: Array, effects: Sequence[Effect], classes: Sequence[int]) -> Spectra:
        """Predict the linearized laws' spectra of the wanted classes; `effects` are all effects of the model."""
        base, context, band, forces = self.system(x, effects), self.context_at(x), self.observed.band, self.forces(x)
        noise, ground_noise, out = self.noise(x), self.ground_noise(x), []
        for condition, force in ((self.conditions[k], forces[k]) for k in classes):
            system = extended(base, effects, context, condition)
            excitation = Excitation(force, noise, ground_noise)
            out.append(cross_spectra(system, effects, excitation, band, context, condition))
        return np.stack(out)

    @abstractmethod
    def forces(self, x: Array) -> Annotated[Array, "classes n"]:
        """Return the density of the forces on the floors in every class, N^2/Hz."""

    def ground_noise(self, x: Array) -> float:
        """Return the noise density of a measured ground motion, which acts as motion, (m/s^2)^2/Hz."""
        return 0.0

    @abstractmethod
    def relative_levels(self, x: Array) -> Annotated[Array, "classes"]:
        """Return the factors from a slope of the middle class to that of every class."""

    def _with_model_error(self, spectra: Spectra, effects: Sequence[Effect], classes: Sequence[int]) -> Spectra:
        """Apply the known model error to spectra, but for the noise that extra effects add.

        The error is that of the healthy structure's spectra, of which this noise is no part.
        """
        error = self.prior.error
        if error is None:
            return spectra
        inside, at = error.at(self.observed.band.hz)
        relative = np.zeros_like(spectra)
        relative[:, inside] = error.relative[at]
        density = np.array([noise_density(effects, self.context, self.conditions[k]) for k in classes])
        added = (density[:, None] * self.observed.band.gain[:, None])[..., None] * np.eye(spectra.shape[-1])
        return np.asarray(grown_by(spectra - added, relative) + added)

    def effects(self, x: Array, effects: Sequence[Effect]) -> tuple[Effect, ...]:
        """Return the persistent effects at a vector of parameters, and the extra ones."""
        return (*self.prior.effects(x), *effects)

    def system(self, x: Array, effects: Sequence[Effect]) -> System:
        """Make the linear system at a vector of parameters, before effects that depend on the level are added."""
        ratios, (mass, stiffness) = np.exp(x[self.layout.damping]), self.model(x, effects).structural_matrices()
        if not self.damped_as_built:
            return replace(modally_damped(mass, stiffness, ratios), ground=self.context.structure.rides)
        built = self.model(x, self.prior.effects(x)).structural_matrices()
        damping = modally_damped(*built, ratios).damping
        return System(mass, damping, stiffness, ground=self.context.structure.rides)

    def is_stable(self, x: Array, effects: Sequence[Effect]) -> bool:
        """Decide if the modes that are coupled to the structure leave it stable; their spectra alone would not tell.

        Raises LinAlgError if there is no structure at these parameters.
        """
        everything, condition = self.effects(x, effects), self.conditions[self.n_classes // 2]
        if not any(e.repeatable for e in everything):  # as in most fits: only modes that the model lacks are coupled
            return True
        system = extended(self.system(x, everything), everything, self.context_at(x), condition)
        return not system.coupled or float(np.linalg.eigvalsh(system.stiffness)[0]) > 0.0

    def context_at(self, x: Array) -> Context:
        """Make the context of effects with the structure at a vector of parameters, to which relative sizes refer."""
        layout, drawn = self.layout, self.prior.model.structure
        structure = drawn.with_stiffness(np.exp(x[layout.stiffness])).with_masses(np.exp(x[layout.masses]))
        return replace(self.context, structure=structure)

    def model(self, x: Array, effects: Sequence[Effect]) -> Model:
        """Make the model at a vector of parameters; `effects` are all of its effects."""
        layout, base, structure = self.layout, self.prior.model, self.context_at(x).structure
        correction = x[layout.correction]
        # The common scale of all masses and stiffnesses is not observable; the correction scales with them.
        scale = np.exp((x[layout.masses] - self.prior.mean[layout.masses]).mean())
        change = scale * np.tensordot(correction, self.prior.basis, axes=1) if correction.size else None
        if base.correction is not None:
            change = base.correction if change is None else base.correction + change
        return replace(
            base,
            structure=structure,
            effects=tuple(effects),
            correction=change,
            modal_damping=np.exp(x[layout.damping]),
        )

    def noise(self, x: Array) -> Annotated[Array, "c"]:
        """Return the noise density of every channel, (m/s^2)^2/Hz."""
        layout = self.layout
        return np.asarray(np.exp(x[layout.noise] + x[layout.channel_noise]))
