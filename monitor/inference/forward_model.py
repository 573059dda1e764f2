"""What parameters predict of a recording's segments: their spectra, and their response where the ground was measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, ComplexArray
from monitor.inference import ground_response
from monitor.inference.cross_spectra import Excitation, cross_spectra, extended, modally_damped
from monitor.inference.observed_spectra import ObservedSpectra
from monitor.inference.parameter_layout import ParameterLayout
from monitor.inference.wishart import grown_by
from monitor.model import Condition, Context, Effect, Model, ModelDiscrepancy, StructuralPrior, System

_LINE_BINS, _LINE_SHARE = 3.0, 0.01
"""How far either side of a known machine's line spectra are not compared: in bins, and of its frequency (motors slip)."""


@dataclass(frozen=True, eq=False, slots=True)
class Prediction:
    """What parameters say of the segments, beside what was measured.

    Without a measured ground all is chance.  With one, the segments' means are its response, `spectra` are those of what
    is left, and so are `data`, which therefore depend on the parameters.
    """

    spectra: ComplexArray
    """Shape (classes, bins, c, c)."""
    data: ComplexArray
    left: ComplexArray | None = None
    """Segments less their means, shape (n_segments, n_bins, c)."""


@dataclass(frozen=True, eq=False, slots=True)
class ForwardModel:
    """From nuisances and effects to what the segments should be."""

    observed: ObservedSpectra
    prior: StructuralPrior
    context: Context
    conditions: tuple[Condition, ...]
    """One a class."""
    offset: ComplexArray | None = None
    """What simulation adds to the spectra of a linearized law, shape (classes, n_bins, c, c)."""
    damped_as_built: bool = False
    """Whether the damping matrix is that of the structure without the extra effects; else its modal ratios stay."""
    smoothing: Array | None = None
    """Averages bins into coarse ones, shape (n_coarse, n_bins), for a start from far away."""
    left_out: NDArray[np.bool_] | None = None
    """Bins that are not compared, shape (n_bins,)."""

    @property
    def n_classes(self) -> int:
        """Classes of level and temperature."""
        return int(self.observed.counts.size)

    @property
    def layout(self) -> ParameterLayout:
        """Where each group of parameters lies in `x`."""
        return ParameterLayout.of(self.prior, self.n_classes)

    @property
    def error(self) -> ModelDiscrepancy | None:
        """What the model gets wrong from the start.  Beside a measured ground the spectra about the response have another one."""
        return self.prior.error if self.observed.drive is None else None

    def of_model_alone(self) -> Self:
        """The same without what simulation adds, and without what the model gets wrong from the start."""
        return replace(self, offset=None, prior=replace(self.prior, error=None))

    def widths(self) -> Array:
        """Bins in each (coarse) bin; none about known machines' lines, and fewer where the model is known to err."""
        if self.smoothing is not None:
            return np.asarray(1.0 / (self.smoothing**2).sum(axis=1))
        band = self.observed.band
        out = np.ones(band.n_bins)
        for line in self.prior.known_lines_hz:
            out[np.abs(band.hz - line) <= max(_LINE_BINS * band.bin_hz, _LINE_SHARE * line)] = 0.0
        if self.left_out is not None:
            out[self.left_out] = 0.0
        error = self.error
        if error is not None:
            inside, at = error.at(band.hz)
            # An error that all segments and bins of a narrow band share does not average out.
            out[inside] /= 1.0 + error.variance[at] * self.observed.pieces(error.step_hz / band.bin_hz)
        return out

    def data(self) -> ComplexArray:
        """Measured cross-spectra, (classes, bins, c, c)."""
        return self.smooth(self.observed.spectra)

    def smooth(self, spectra: ComplexArray) -> ComplexArray:
        """Average bins, the third axis from the end."""
        if self.smoothing is None:
            return spectra
        return np.asarray(np.moveaxis(np.tensordot(self.smoothing, spectra, axes=(1, -3)), 0, -3))

    def predict(self, x: Array, effects: Sequence[Effect]) -> Prediction:
        """The segments' (smoothed) spectra about their means."""
        spectra, mean = self.smooth(self.scatter(x, effects)), self.mean(x, effects)
        if mean is None:
            return Prediction(spectra, self.data())
        left = self.observed.segments.values - mean
        return Prediction(spectra, self.smooth(ground_response.products(left, self.observed.members)), left)

    def mean(self, x: Array, effects: Sequence[Effect], *, exact: bool = True) -> ComplexArray | None:
        """The response of the segments to a measured ground, shape (n_segments, n_bins, c); None without one.

        That of the exact laws; or of the linearized ones, which is quicker and good enough for slopes.
        """
        e = self.observed
        if e.drive is None:
            return None
        effects = (*self.prior.effects(x), *effects)
        base, context = self.system(x, effects), self.context_at(x)
        bent = [effect for effect in effects if effect.nonlinear and effect.family == "structure"]
        if bent and exact:
            system = extended(base, [f for f in effects if f not in bent], context, self.conditions[0])
            return ground_response.exact_response(e.drive, system, effects, e.band, context, self.conditions[0])
        out = np.zeros_like(e.segments.values)
        if not any(effect.conditional for effect in effects):
            system = extended(base, effects, context, self.conditions[0])
            out[:] = ground_response.response(e.drive, system, effects, e.band, context, self.conditions[0])
        else:
            for members, condition in zip(e.members, self.conditions, strict=True):
                system = extended(base, effects, context, condition)
                out[members] = ground_response.response(
                    e.drive.part(members), system, effects, e.band, context, condition
                )
        return out

    def spectra(self, x: Array, effects: Sequence[Effect]) -> ComplexArray:
        """Predicted cross-spectra of the classes, shape (classes, n_bins, c, c)."""
        mean = self.mean(x, effects)
        scatter = self.scatter(x, effects)
        return scatter if mean is None else scatter + ground_response.products(mean, self.observed.members)

    def scatter(self, x: Array, effects: Sequence[Effect], *, classes: Sequence[int] | None = None) -> ComplexArray:
        """Predicted cross-spectra of the segments about their means, shape (classes, n_bins, c, c).

        Where the ground was measured, a class's level is that of the model's own error alone, a share of the measured power
        that is independent between channels: wind does not follow the ground.
        """
        effects = (*self.prior.effects(x), *effects)
        base, context = self.system(x, effects), self.context_at(x)
        layout = self.layout
        forces, level, noise = self.forces(x), np.exp(x[layout.levels]), self.noise(x)
        wanted = range(self.n_classes) if classes is None else classes
        ground = self.observed.power
        varied = ground is not None or any(e.conditional or e.lines() for e in effects)
        out = []
        shared: ComplexArray | None = None
        for k in wanted:
            if varied or shared is None:
                system = extended(base, effects, context, self.conditions[k])
                e = Excitation(
                    forces[k] if varied else np.exp(x[layout.forces]),
                    noise * (1.0 if varied else 0.0),
                    0.0 if ground is None else float(np.exp(x[layout.noise])),
                )
                shared = cross_spectra(system, effects, e, self.observed.band, context, self.conditions[k])
            if varied:
                out.append(shared if ground is None else shared + level[k] * diagonal_of(ground))
            else:
                out.append(self._scaled(shared, level[k], noise, effects))
        stacked = np.stack(out)
        return self._as_healthy(stacked if self.offset is None else stacked + self.offset[list(wanted)])

    def _as_healthy(self, spectra: ComplexArray) -> ComplexArray:
        """With what the model gets wrong from the start."""
        error = self.error
        if error is None:
            return spectra
        inside, at = error.at(self.observed.band.hz)
        relative = np.zeros_like(spectra)
        relative[:, inside] = error.relative[at]
        return grown_by(spectra, relative)

    def _scaled(self, unit: ComplexArray, level: float, noise: Array, effects: Sequence[Effect]) -> ComplexArray:
        """Another class's spectra where only the level differs: everything but the noise scales."""
        extra = sum((e.noise_variance(self.context, self.conditions[0]) for e in effects), np.zeros(noise.size))
        extra = np.asarray(extra) / self.context.rate_hz
        diagonal = np.arange(noise.size)
        gain = self.observed.band.gain[:, None]
        out = unit.copy()
        out[:, diagonal, diagonal] -= extra * gain
        out *= level
        out[:, diagonal, diagonal] += (noise + extra) * gain
        return out

    def system(self, x: Array, effects: Sequence[Effect]) -> System:
        """The system at a vector of nuisances, before what effects add at a level."""
        ratios, (mass, stiffness) = np.exp(x[self.layout.damping]), self.model(x, effects).structural_matrices()
        if not self.damped_as_built:
            return modally_damped(mass, stiffness, ratios)
        built = self.model(x, self.prior.effects(x)).structural_matrices()
        return System(mass, modally_damped(*built, ratios).damping, stiffness)

    def context_at(self, x: Array) -> Context:
        """Where effects act, with the structure at a vector of nuisances: relative sizes refer to it."""
        layout, drawn = self.layout, self.prior.model.structure
        structure = drawn.with_stiffness(np.exp(x[layout.stiffness])).with_masses(np.exp(x[layout.masses]))
        return replace(self.context, structure=structure)

    def model(self, x: Array, effects: Sequence[Effect]) -> Model:
        """The model at a vector of nuisances; `effects` are all of its effects."""
        layout, base, structure = self.layout, self.prior.model, self.context_at(x).structure
        correction = x[layout.correction]
        # The scale of all masses and stiffnesses cannot be seen; the correction shares it.
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

    def forces(self, x: Array) -> Array:
        """Density of the forces on the floors in every class, shape (classes, n), N^2/Hz.

        Beside a measured ground they are the same in all: wind does not follow the ground.  What is known of them there is told
        for the masses known before, and goes with all of them together.
        """
        layout = self.layout
        force, level = np.exp(x[layout.forces]), np.exp(x[layout.levels])
        if self.observed.power is None:
            return np.asarray(level[:, None] * force)
        heavier = (x[layout.masses] - self.prior.mean[layout.masses]).mean()
        return np.tile(force * np.exp(2.0 * heavier), (self.n_classes, 1))

    def noise(self, x: Array) -> Array:
        """Noise density of every channel."""
        layout = self.layout
        return np.asarray(np.exp(x[layout.noise] + x[layout.channel_noise]))


def diagonal_of(power: Array) -> Array:
    """Diagonal matrices, shape (n_bins, c, c)."""
    return power[:, :, None] * np.eye(power.shape[1])
