"""Posterior of an output-only recording: the forces on the floors are unknown in every class."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from monitor.core import Array, ComplexArray
from monitor.inference.arrays import PackedSlopes, Spectra
from monitor.inference.cross_spectra import (
    Excitation,
    extended,
    line_spectra,
    noise_density,
    random_spectra,
)
from monitor.inference.excitation_scoring import fit_by_scoring
from monitor.inference.forward_model import Prediction
from monitor.inference.posterior import FORCE_STD, Posterior, difference_operator, of_coordinates, with_coordinates
from monitor.inference.spectral_slopes import Slopes, SpectralSlopes
from monitor.inference.system_slopes import (
    Matrices,
    SystemChange,
    extra_mode_changes,
    force_matrix,
    modal_changes,
    packed,
    system_slopes,
    unpacked,
)
from monitor.model import Context, Effect, System

_LINEAR = 1e-9
"""Share of a change up to which it is the sum of its parts. [ratio; rounding]"""


@dataclass(frozen=True, eq=False, slots=True)
class AmbientPosterior(Posterior):
    """Posterior of an output-only recording.  The level of a class multiplies the forces on all floors."""

    def linear_spectra(self, x: Array, effects: Sequence[Effect], classes: Sequence[int]) -> ComplexArray:
        """Predict the linearized spectra; where no effect depends on the class, those of one class, scaled to the others."""
        if any(e.conditional for e in effects):
            return Posterior.linear_spectra(self, x, effects, classes)
        context, layout, noise, band = self.context_at(x), self.layout, self.noise(x), self.observed.band
        condition, unforced, diagonal = self.conditions[classes[0]], np.zeros(noise.size), np.arange(noise.size)
        system = extended(self.system(x, effects), effects, context, condition)
        unit = random_spectra(system, effects, Excitation(np.exp(x[layout.forces]), unforced), band, context, condition)
        lines, level = line_spectra(system, effects, band, context, condition), np.exp(x[layout.levels])
        extra, gain = noise_density(effects, self.context, self.conditions[0]), band.gain[:, None]
        # What effects add to the channels' noise does not scale with the level, nor does that noise itself.
        unit[:, diagonal, diagonal] -= extra * gain
        out = np.stack([unit * level[k] for k in classes])
        out[:, :, diagonal, diagonal] += (noise + extra) * gain
        return np.asarray(out + lines)

    @override
    def forces(self, x: Array) -> Array:
        layout = self.layout
        return np.asarray(np.exp(x[layout.levels])[:, None] * np.exp(x[layout.forces]))

    @override
    def relative_levels(self, x: Array) -> Array:
        levels = x[self.layout.levels]
        return np.asarray(np.exp(levels - levels[self.n_classes // 2]))

    @override
    def force_precision(self) -> Array:
        return np.diag(np.full(self.context.structure.n_dofs, FORCE_STD) ** -2.0)

    @override
    def first_levels(self, ratio: Array) -> tuple[float, Array]:
        return float(np.log(ratio.mean())), np.asarray(np.log(ratio / ratio.mean()))

    @override
    def levels_of_equal_forces(self, ratio: Array) -> tuple[float, float | Array]:
        return 0.0, np.asarray(np.log(ratio))

    @override
    def fit_levels(self, x: Array) -> Array:
        return fit_by_scoring(self, x)

    def force_prior(self, x: Array) -> tuple[Array, Array]:
        """The prior mean of every floor's force is the mean over floors."""
        own = x[self.layout.forces]
        return np.full(own.size, own.mean()), difference_operator(own.size)

    @override
    def linearized(self, x: Array, effects: tuple[Effect, ...], prediction: Prediction) -> tuple[Slopes, Array, Array]:
        shared, scale, own, order = self._slope_parts(x, effects, prediction.spectra, 0)
        slopes = SpectralSlopes.at(shared, scale, own, order, prediction.spectra, self.root_information())
        return slopes, self.whitened(prediction.spectra, prediction.spectra[None][:0], prediction.data)[1], np.zeros(0)

    @override
    def slopes(self, x: Array, effects: tuple[Effect, ...], spectra: ComplexArray, first: int = 0) -> ComplexArray:
        shared, scale, own, order = self._slope_parts(x, effects, spectra, first)
        of_class = np.concatenate([scale.T[:, :, None, None] * shared[:, None], own])
        return unpacked(of_class[order])

    def _slope_parts(
        self, x: Array, effects: tuple[Effect, ...], spectra: ComplexArray, first: int
    ) -> tuple[Array, Array, Array, NDArray[np.intp]]:
        """Differentiate the spectra by the coordinates from `first` on: the first parts of `SpectralSlopes`.

        Most slopes are computed in the middle class and scaled by level, since they only weight the residual.
        """
        layout, noise, shape = self.layout, self.noise(x), (self.context.sensors.shape[0] ** 2, spectra.shape[1])
        begin = first if first >= layout.n_nuisance else min(first, layout.forces.start)
        noises = [i for i in (*range(x.size)[layout.channel_noise], layout.noise) if i >= begin]
        levels = [i for i in range(x.size)[layout.levels] if i >= begin]
        apart = [i for i in self._different_in_classes(x, effects) if i >= begin]
        moving = [i for i in range(begin, x.size) if i not in {*noises, *levels, *apart}]
        level = self.relative_levels(x)
        shared = np.zeros((len(moving) + len(noises), *shape))
        if moving:
            shared[: len(moving)] = self._slopes_of_middle(x, effects, moving)
        for by_noise, i in zip(shared[len(moving) :], noises, strict=True):
            channels = np.arange(noise.size) if i == layout.noise else np.array([i - layout.channel_noise.start])
            by_noise[(channels + 1) ** 2 - 1] = noise[channels, None]
        scale = np.ones((self.n_classes, len(shared)))
        scale[:, : len(moving)] = level[:, None]
        own = np.zeros((len(apart) + len(levels), self.n_classes, *shape))
        for by_class, i in zip(own, apart, strict=False):
            by_class[:] = packed(self.slope_by_class(x, i, effects, spectra))
        forces = range(x.size)[layout.forces]
        # A level moves all forces of its class at once, but neither lines nor noise.
        of_forces = shared[[j for j, i in enumerate(moving) if i in forces]].sum(axis=0) * level[:, None, None]
        of_forces = of_forces + own[[j for j, i in enumerate(apart) if i in forces]].sum(axis=0)
        for k, by_level in enumerate(own[len(apart) :]):
            by_level[k] = of_forces[k]
        columns = np.array([*moving, *noises, *apart, *levels], dtype=int)
        order = np.argsort(columns)
        return shared, scale, own, order[columns[order] >= first]

    def _different_in_classes(self, x: Array, effects: tuple[Effect, ...]) -> list[int]:
        """List the coordinates whose slopes do not scale with the level, but are computed in every class.

        They are those of persistent effects that depend on the condition, and of all extra effects but for modes, and for those
        that act in proportion to the forces in a model that is alike in all classes.
        """
        alike = self.prior.error is None and self.offset is None
        alike = alike and not any(e.conditional or e.lines() for e in self.effects(x, effects))
        return self.persistent_by_class() + [
            self.layout.n_nuisance + j
            for j, e in enumerate(of_coordinates(effects))
            if not (e.repeatable or (alike and e.scales_with_level))
        ]

    def _slopes_of_middle(self, x: Array, effects: tuple[Effect, ...], wanted: Sequence[int]) -> PackedSlopes:
        middle = self.n_classes // 2
        systemic = self._systemic(x, effects, wanted)
        steps = np.array([self.nudged(x, i, effects)[0] for i in wanted])
        out = np.zeros((len(wanted), len(self.context.channels) ** 2, self.observed.band.n_bins))
        if systemic:
            out[[wanted.index(i) for i in systemic]] = self._slopes_by_system(x, effects, systemic)
        linear = self.linear_spectra(x, self.effects(x, effects), [middle])
        for j, i in enumerate(wanted):
            if i not in systemic:
                h, moved = self.nudged(x, i, effects)
                everything = self.effects(moved, with_coordinates(effects, moved[self.layout.effects]))
                out[j] = packed((self.linear_spectra(moved, everything, [middle])[0] - linear[0]) / h)
        if self.prior.error is not None or self.offset is not None:
            complete = partial(self.complete, x=x, effects=effects, classes=[middle])
            here = complete(linear)
            for d, h in zip(out, steps, strict=True):
                d[:] = packed(_slope(complete, here, linear, unpacked(d), h)[0])
        return out

    def _systemic(self, x: Array, effects: tuple[Effect, ...], wanted: Iterable[int]) -> list[int]:
        """List the wanted coordinates that change the linear system or its forces alone, and not what is recorded of them."""
        owners, everything = self.owners(effects), self.effects(x, effects)
        if any(e.ground_share for e in everything):  # it depends on the whole system, but not on extra modes
            return [i for i in wanted if i in owners and everything[owners[i]].extra_modes(self.context)]
        return [i for i in wanted if i not in owners or everything[owners[i]].acts_on_system_alone]

    def _slopes_by_system(self, x: Array, effects: tuple[Effect, ...], wanted: Sequence[int]) -> PackedSlopes:
        """Differentiate the linearized spectra of the middle class by coordinates that change the system, see `_systemic`."""
        band, middle, owners = self.observed.band, self.n_classes // 2, self.owners(effects)
        everything, condition = self.effects(x, effects), self.conditions[middle]
        has_lines = any(e.lines() for e in everything)
        context, bare = self.context_at(x), self.system(x, everything)
        modes = [mode for e in everything for mode in e.extra_modes(context)]

        def numbers(everything: Sequence[Effect]) -> Array:
            found = [mode for e in everything for mode in e.extra_modes(context)]
            return np.array([[m.frequency_hz, m.damping_ratio, *m.shape] for m in found])

        def at(
            x: Array, bare: System, context: Context, everything: Sequence[Effect]
        ) -> tuple[System, tuple[Array, ...]]:
            system = extended(bare, everything, context, condition)
            forces = force_matrix(system, everything, self.forces(x)[middle], len(modes))
            lines = packed(line_spectra(system, everything, band, context, condition)) if has_lines else np.zeros(())
            matrices = system.mass, system.damping, system.stiffness
            return system, (*matrices, system.sensors(context.sensors), forces, lines)

        system, here = at(x, bare, context, everything)
        exact: dict[int, Matrices] = {}
        basis = None
        if system is bare and not has_lines:
            basis, exact = self._exact_changes(x, everything, bare)
        unmoved, forces = [np.zeros_like(part) for part in here], range(x.size)[self.layout.forces]
        still = extra_mode_changes(modes, np.zeros((len(modes), 2 + len(context.channels))))

        def moved(i: int) -> tuple[Array, ...]:
            if i in exact:
                return (*exact[i], *unmoved[3:-1], still, unmoved[-1])
            h, moved_x = self.nudged(x, i, effects)
            with_one = list(everything)
            if i in owners:
                first = min(j for j, owner in owners.items() if owner == owners[i])
                one = everything[owners[i]]
                own = slice(first, first + len(one.parameters))
                with_one[owners[i]] = one.at(moved_x[own])
                if one.extra_modes(context):
                    back = list(everything)
                    back[owners[i]] = one.at((2.0 * x - moved_x)[own])
                    of_modes = extra_mode_changes(modes, (numbers(with_one) - numbers(back)) / (2.0 * h))
                    return (*unmoved[:-1], of_modes, unmoved[-1])
            if i in forces or (i in owners and everything[owners[i]].keeps_structure):
                _, there = at(moved_x, bare, context, with_one)
            else:
                _, there = at(moved_x, self.system(moved_x, with_one), self.context_at(moved_x), with_one)
            *parts, lines = ((after - before) / h for after, before in zip(there, here, strict=True))
            return (*parts, still, lines)

        changes = [moved(i) for i in wanted]
        of_system = [SystemChange(*change[:-1]) for change in changes]
        slopes = system_slopes(system, everything, self.forces(x)[middle], of_system, band, context, condition, basis)
        return slopes + np.array([change[-1] for change in changes]) if has_lines else slopes

    def _exact_changes(
        self, x: Array, everything: Sequence[Effect], bare: System
    ) -> tuple[Array | None, dict[int, Matrices]]:
        """Differentiate the system by the structure's own parameters, where it is linear in these; results as of `modal_changes`.

        `bare` is the system at `x`.  Nothing where an effect changes the structure, or a change of all stiffnesses is not the sum
        of the changes by each.
        """
        if self.damped_as_built or not all(e.keeps_structure for e in everything):
            return None, {}
        layout, at, structure = self.layout, range(x.size), self.context_at(x).structure
        k, m = structure.stiffness_n_per_m, structure.masses_kg
        by_k = k[:, None, None] * structure.stiffness_derivatives()
        doubled = structure.with_stiffness(2.0 * k).stiffness_matrix() - structure.stiffness_matrix()
        if not np.allclose(doubled, by_k.sum(axis=0), rtol=0.0, atol=_LINEAR * np.abs(doubled).max()):
            return None, {}
        basis = np.zeros((0, *doubled.shape))
        if x[layout.correction].size:
            basis = self.prior.basis * np.exp((x[layout.masses] - self.prior.mean[layout.masses]).mean())
        grown = np.tensordot(x[layout.correction], basis, axes=1) / m.size  # the correction scales with the masses
        by_mass, by_stiffness = np.zeros((2, k.size + m.size + len(basis), *doubled.shape))
        by_mass[k.size : k.size + m.size] = m[:, None, None] * structure.mass_derivatives()
        by_stiffness[:] = np.concatenate([by_k, np.broadcast_to(grown, (m.size, *doubled.shape)), basis])
        found = modal_changes(bare, np.exp(x[layout.damping]), by_mass, by_stiffness)
        if found is None:
            return None, {}
        those = (*at[layout.stiffness], *at[layout.masses], *at[layout.correction], *at[layout.damping])
        return found[0], dict(zip(those, found[1], strict=True))


def _slope(of: Callable[[Spectra], Spectra], here: Spectra, at: Spectra, along: ComplexArray, step: float) -> Spectra:
    """Differentiate a function of spectra, `here` at them, along a change of them.

    It is NaN where spectra are not positive definite, as a peak of light damping may be after a step that suits the other bins;
    a shorter step leaves them so.
    """
    slope = (of(at + step * along) - here) / step
    while not np.isfinite(slope).all() and np.isfinite(here).all() and np.isfinite(along).all():
        step *= 0.1
        slope = (of(at + step * along) - here) / step
    return slope
