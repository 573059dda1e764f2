"""Posterior of an output-only recording: the forces on the floors are unknown in every class."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from monitor.core import Array, ComplexArray
from monitor.inference.cross_spectra import (
    Excitation,
    cross_spectra,
    extended,
    extra_mode_spectra,
    line_spectra,
    random_spectra,
)
from monitor.inference.posterior import Posterior, difference_operator, with_coordinates
from monitor.model import Effect


@dataclass(frozen=True, eq=False, slots=True)
class AmbientPosterior(Posterior):
    """Posterior of an output-only recording.  The level of a class multiplies the forces on all floors."""

    def linear_spectra(self, x: Array, effects: Sequence[Effect], classes: Sequence[int]) -> ComplexArray:
        """See `ForwardModel.linear_spectra`.

        Where no effect depends on the class, the spectra of one class are computed and scaled to the others.
        """
        base, context, layout = self.system(x, effects), self.context_at(x), self.layout
        noise, band = self.noise(x), self.observed.band
        if any(e.conditional for e in effects):
            forces, out = self.forces(x), []
            for k in classes:
                system, condition = extended(base, effects, context, self.conditions[k]), self.conditions[k]
                out.append(cross_spectra(system, effects, Excitation(forces[k], noise), band, context, condition))
            return np.stack(out)
        condition = self.conditions[classes[0]]
        system, unforced = extended(base, effects, context, condition), np.zeros(noise.size)
        unit = random_spectra(system, effects, Excitation(np.exp(x[layout.forces]), unforced), band, context, condition)
        lines, level = line_spectra(system, effects, band, context, condition), np.exp(x[layout.levels])
        return np.stack([self._scale_to_level(unit, level[k], noise, effects) + lines for k in classes])

    def _scale_to_level(
        self, unit: ComplexArray, level: float, noise: Array, effects: Sequence[Effect]
    ) -> ComplexArray:
        """Scale spectra to a class of another level; the noise does not scale with the level.

        Parameters
        ----------
        unit : ndarray, shape (n_bins, c, c)
            Spectra at level one, without the channels' noise.
        noise : ndarray, shape (c,), (m/s^2)^2/Hz
        """
        extra = sum((e.noise_variance(self.context, self.conditions[0]) for e in effects), np.zeros(noise.size))
        extra = np.asarray(extra) / self.context.rate_hz
        diagonal = np.arange(noise.size)
        gain = self.observed.band.gain[:, None]
        out = unit.copy()
        out[:, diagonal, diagonal] -= extra * gain
        out *= level
        out[:, diagonal, diagonal] += (noise + extra) * gain
        return out

    def forces(self, x: Array) -> Array:
        """See `ForwardModel.forces`."""
        layout = self.layout
        return np.asarray(np.exp(x[layout.levels])[:, None] * np.exp(x[layout.forces]))

    def relative_levels(self, x: Array) -> Array:
        """See `ForwardModel.relative_levels`."""
        levels = x[self.layout.levels]
        return np.asarray(np.exp(levels - levels[self.n_classes // 2]))

    def force_prior(self, x: Array) -> tuple[Array, Array]:
        """See `Posterior.force_prior`.  The prior mean of every floor's force is the mean over floors."""
        own = x[self.layout.forces]
        return np.full(own.size, own.mean()), difference_operator(own.size)

    def slopes_by_mode(
        self, x: Array, effects: tuple[Effect, ...], spectra: ComplexArray, wanted: Iterable[int]
    ) -> dict[int, ComplexArray]:
        """See `Posterior.slopes_by_mode`.  The slope is that of the middle class, as of any nuisance."""
        owners, everything = self.owners(effects), self.effects(x, effects)
        at_modes = [i for i in wanted if everything[owners[i]].extra_modes(self.context)]
        if not at_modes:
            return {}
        context, band = self.context_at(x), self.observed.band
        middle, scale = self.n_classes // 2, self.relative_levels(x)[:, None, None, None]
        force = float(self.forces(x)[middle].mean())
        linear = self.linear_spectra(x, everything, [middle])

        def part(effect: Effect) -> ComplexArray:
            modes = effect.extra_modes(context)
            return extra_mode_spectra(modes, everything, force, band, context, self.conditions[middle])

        out = {}
        for i in at_modes:
            h, moved = self.nudged(x, i, effects)
            after = self.effects(moved, with_coordinates(effects, moved[self.layout.n_nuisance :]))
            change = part(after[owners[i]]) - part(everything[owners[i]])
            whole = self.smooth(self.complete(linear + change, x, effects, [middle]))[0]
            out[i] = np.asarray((whole - spectra[middle]) / h * scale)
        return out

    def slopes(self, x: Array, effects: tuple[Effect, ...], spectra: ComplexArray, first: int = 0) -> ComplexArray:
        """See `Posterior.slopes`."""
        layout, noise = self.layout, self.noise(x)
        diagonal = np.arange(noise.size)
        out = np.zeros((x.size, *spectra.shape), dtype=complex)
        out[layout.effects] = self.effect_slopes(x, effects, spectra)
        by_noise = np.zeros((noise.size, *spectra.shape), dtype=complex)
        by_noise[diagonal, :, :, diagonal, diagonal] = noise[:, None, None]
        out[layout.channel_noise], out[layout.noise] = by_noise, by_noise.sum(axis=0)
        others = (*range(layout.channel_noise.start), *range(layout.channel_noise.stop, layout.levels.start))
        wanted = [i for i in others if i >= min(first, layout.forces.start)]  # the levels' slopes are the forces' sum
        persistent = range(layout.persistent.start, layout.persistent.stop)
        by_mode = self.slopes_by_mode(x, effects, spectra, [i for i in wanted if i in persistent])
        for i in wanted:
            out[i] = by_mode[i] if i in by_mode else self.slope(x, i, effects, spectra)
        for k, by_level in enumerate(out[layout.levels]):
            by_level[k] = out[layout.forces, k].sum(axis=0)  # all forces at once, but neither lines nor noise
        return out[first:]
