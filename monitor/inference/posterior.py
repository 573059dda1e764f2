"""The one score for all causes: debiased Whittle likelihood of a recording's cross-spectra under a model.

Nuisances (stiffness and mass within what is known of them, damping, excitation, noise) compete with every effect.  What is
known of the structure, from its drawing or from its baseline, is a normal prior on the structural nuisances.

References
----------
P. Whittle, Arkiv foer Matematik 2 (1953) 423-434; A. M. Sykulski et al., The debiased Whittle likelihood, Biometrika 106
(2019) 251-266.  Statistical linearization: J. B. Roberts, P. D. Spanos, Random Vibration and Statistical Linearization (1990).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from monitor.core import Array, ComplexArray, parallel_map
from monitor.inference import ground_response
from monitor.inference.forward_model import ForwardModel, Prediction, diagonal_of
from monitor.inference.observed_spectra import ObservedSpectra
from monitor.inference.wishart import log_det_and_trace, whiten
from monitor.model import Effect

_FORCE_STD, _LEVEL_STD, _NOISE_STD = 1.0, 5.0, 3.0
"""Prior of the logarithm of the floors' forces about their mean, of the classes' levels, of the common noise."""
_WIND_STD = 0.15
"""The same of forces that a measured ground's quiet tells, about what they are all the time."""
_NUDGE = 1e-5
"""Finite difference of a nuisance, most of which are logarithms."""


@dataclass(frozen=True, eq=False, slots=True)
class ExactSlopes:
    """What exact laws add, near one fit, to the slopes of their linearized response."""

    laws: frozenset[tuple[str, str]]
    """Names and places of the effects."""
    slopes: ComplexArray
    """By the nuisances, shape (n_nuisance, n_segments, n_bins, c)."""


@dataclass(frozen=True, eq=False, slots=True)
class Posterior(ForwardModel):
    """Evidence, what is known before it, and where effects act: how likely parameters are."""

    bent: ExactSlopes | None = None
    """What laws add to the linearized slopes of a response to a measured ground; None where those serve."""

    wind: Array | None = None
    """Logarithms of the forces beside a measured ground that its quiet tells, shape (n,); None while they are not known."""

    def part(self, evidence: ObservedSpectra, classes: NDArray[np.intp]) -> Self:
        """The same for other segments, whose classes are like those of these numbers here."""
        return replace(self, observed=evidence, conditions=tuple(self.conditions[k] for k in classes), bent=None)

    def beyond(self, x: Array, effects: Sequence[Effect]) -> ComplexArray | None:
        """What simulation adds to the linearized spectra at a point, relative to them, shape (classes, n_bins, c, c).

        None where none was made, or one of other laws.
        """
        return None

    def normal_prior(self, x: Array, effects: Sequence[Effect]) -> tuple[Array, Array]:
        """Mean and precision of the nuisances, given the forces' mean level, and of the effects' coordinates."""
        middle = self.conditions[self.n_classes // 2]
        known = [e.known(self.context, middle) for e in effects]
        forces, force_precision = self._known_forces(x)
        precision = block_diag(
            self.prior.precision,
            force_precision,
            np.eye(self.n_classes) / _LEVEL_STD**2,
            np.eye(1) / _NOISE_STD**2,
            *[np.diag(precision) for _, precision in known],
        )
        mean = np.concatenate(
            [
                self.prior.mean,
                forces,
                np.zeros(self.n_classes),
                [x[self.layout.noise]],
                *[m for m, _ in known],
            ]
        )
        return mean, precision

    def _known_forces(self, x: Array) -> tuple[Array, Array]:
        """Mean and precision of the logarithms of the floors' forces, shapes (n,) and (n, n)."""
        own = x[self.layout.forces]
        n = own.size
        if self.wind is not None:
            return self.wind, np.eye(n) / _WIND_STD**2
        return own if self.observed.power is not None else np.full(n, own.mean()), difference_operator(n)

    def log_likelihood(
        self, spectra: ComplexArray, data: ComplexArray | None = None, *, levelled: bool = False
    ) -> float:
        """Tempered Whittle log likelihood, nats; -inf where a spectrum is not positive definite.

        If `levelled`, of each class's spectra times the factor by which they fit the data best.
        """
        log_det, trace = log_det_and_trace(spectra, self.data() if data is None else data)
        if levelled:
            c, widths = spectra.shape[-1], self.widths()
            level = (trace @ widths)[:, None] / (c * widths.sum())
            log_det, trace = log_det + c * np.log(level), trace / level
        total = ((-log_det - trace) * self.widths()).sum(axis=1) @ self.observed.counts * self.observed.weight
        return float(total) if np.isfinite(total) else -np.inf

    def score(self, x: Array, effects: tuple[Effect, ...]) -> tuple[float, float]:
        """Log likelihood and log prior at a point."""
        here = self.predict(x, effects)
        ll = self.log_likelihood(here.spectra, here.data)
        mean, precision = self.normal_prior(x, effects)
        return ll, -0.5 * float((x - mean) @ precision @ (x - mean))

    def slopes(self, x: Array, effects: tuple[Effect, ...], spectra: ComplexArray) -> ComplexArray:
        """Derivatives of the (smoothed) spectra, shape (p, classes, bins, c, c), by finite differences."""
        layout, c = self.layout, len(self.context.channels)
        diagonal = np.arange(c)
        noise = self.noise(x)
        noise_slope = np.zeros((c, *spectra.shape[1:]), dtype=complex)
        noise_slope[diagonal, :, diagonal, diagonal] = noise[:, None]
        out = np.empty((x.size, *spectra.shape), dtype=complex)
        out[layout.effects] = self.effect_slopes(x, effects, spectra)
        alone = self.observed.power is None  # else the ground's noise moves the floors too
        for i in range(layout.n_nuisance):
            if alone and layout.channel_noise.start <= i < layout.channel_noise.stop:
                out[i] = noise_slope[i - layout.channel_noise.start]
            elif not alone and self.wind is None and layout.forces.start <= i < layout.forces.stop:
                # Forces beside a measured ground stay as small as they are until its quiet has told them: they would excuse
                # a wrong response at its peaks.
                out[i] = 0.0
            elif layout.levels.start <= i < layout.levels.stop:
                k = i - layout.levels.start
                out[i] = 0.0
                if self.observed.power is None:
                    out[i, k] = out[layout.forces, k].sum(axis=0)  # all forces at once, but neither lines nor noise
                else:
                    out[i, k] = self.smooth(np.exp(x[i]) * diagonal_of(self.observed.power))
            elif alone and i == layout.noise:
                out[i] = noise_slope.sum(axis=0)
            else:
                out[i] = self.slope(x, i, effects, spectra)
        return out

    def slope(self, x: Array, i: int, effects: tuple[Effect, ...], spectra: ComplexArray) -> ComplexArray:
        """As `slopes`, by nuisance i alone: taken at the middle class and scaled by level, as it only weighs the residual, but
        for what standing effects do to every class in its own way."""
        if i in self._by_class:
            return self.slope_by_class(x, i, effects, spectra)
        middle, scale = self.n_classes // 2, np.ones(self.n_classes)
        if self.observed.power is None:
            levels = x[self.layout.levels]
            scale = np.exp(levels - levels[middle])
        h, moved = self.nudged(x, i, effects)
        change = self.smooth(self.scatter(moved, effects, classes=[middle]))[0] - spectra[middle]
        return np.asarray(change / h * scale[:, None, None, None])

    def slope_by_class(self, x: Array, i: int, effects: tuple[Effect, ...], spectra: ComplexArray) -> ComplexArray:
        """As `slope`, of every class its own."""
        h, moved = self.nudged(x, i, effects)
        return np.asarray((self.smooth(self.scatter(moved, effects)) - spectra) / h)

    def effect_slopes(self, x: Array, effects: tuple[Effect, ...], spectra: ComplexArray) -> ComplexArray:
        """As `slopes`, by the extra effects' coordinates alone."""
        n = self.layout.n_nuisance
        out = np.empty((x.size - n, *spectra.shape), dtype=complex)
        for j in range(len(out)):
            h, moved = self.nudged(x, n + j, effects)
            out[j] = (self.smooth(self.scatter(moved, with_coordinates(effects, moved[n:]))) - spectra) / h
        return out

    def mean_slopes(
        self, x: Array, effects: tuple[Effect, ...], mean: ComplexArray, wanted: Iterable[int]
    ) -> ComplexArray:
        """Derivatives of the segments' means by the wanted coordinates, shape (n_wanted, n_segments, n_bins, c).

        The exact laws' by their own sizes; by the nuisances the linearized ones', which are quicker, with what is known of the
        difference.  `mean` is the response at `x`.
        """
        linear = self._linear_mean(x, effects, mean)
        own = self.bent if self.bent is not None and self.bent.laws == _laws(effects) else None
        out = []
        for i in wanted:
            h, moved = self.nudged(x, i, effects)
            if i > self.layout.noise:
                there = self.mean(moved, with_coordinates(effects, moved[self.layout.effects]))
                assert there is not None
                out.append((there - mean) / h)
            elif i in self._moving:
                there = self.mean(moved, effects, exact=False)
                assert there is not None
                out.append((there - linear) / h + (0.0 if own is None else own.slopes[i]))
            else:
                out.append(np.zeros_like(mean))
        return np.array(out, dtype=complex).reshape(-1, *mean.shape)

    def with_exact_slopes(self, x: Array, effects: tuple[Effect, ...]) -> Self:
        """The same with the slopes of a response to a measured ground, near a fit, as the exact laws have them."""

        def bent(x: Array) -> ComplexArray:
            mean = self.mean(x, effects)
            assert mean is not None
            return np.asarray(mean - self._linear_mean(x, effects, mean))

        here = bent(x)

        def added(i: int) -> ComplexArray:
            h, moved = self.nudged(x, i, effects)
            return np.asarray((bent(moved) - here) / h)

        slopes = np.zeros((self.layout.n_nuisance, *here.shape), dtype=complex)
        slopes[self._moving] = parallel_map(added, self._moving)
        return replace(self, bent=ExactSlopes(_laws(effects), slopes))

    def _linear_mean(self, x: Array, effects: tuple[Effect, ...], mean: ComplexArray) -> ComplexArray:
        """The linearized laws' response where the exact ones' is `mean`."""
        if not any(e.nonlinear for e in (*self.prior.effects(x), *effects)):
            return mean
        linear = self.mean(x, effects, exact=False)
        assert linear is not None
        return linear

    @property
    def _by_class(self) -> list[int]:
        """Coordinates of standing effects that depend on the condition, or do not follow the level."""
        first = self.layout.persistent.start
        conditional = [e.conditional or bool(e.lines()) for e in self.prior.model.effects for _ in e.parameters]
        return [first + j for j, by_class in enumerate(conditional) if by_class]

    @property
    def _moving(self) -> list[int]:
        """Nuisances that move the response: neither noise nor forces."""
        noise = self.layout.channel_noise
        return [*range(noise.start), *range(noise.stop, self.layout.structure.stop)]

    def mean_rows(self, here: Prediction, slopes: ComplexArray) -> tuple[Array, Array]:
        """As `whitened`, for the segments' means; no rows without a measured ground."""
        if here.left is None:
            return np.zeros((0, len(slopes))), np.zeros(0)
        e = self.observed
        weight = e.weight * e.counts / [m.size for m in e.members]
        rows = ground_response.mean_rows(here.spectra, np.concatenate([slopes, here.left[None]]), e.members, weight)
        return rows[:, :-1], rows[:, -1]

    def jacobian(
        self, x: Array, effects: tuple[Effect, ...], here: Prediction, first: int = 0
    ) -> tuple[Array, Array, Array]:
        """Whitened slopes by the coordinates from `first` on, and the residuals of the spectra's and of the means' rows."""
        slopes = (self.effect_slopes if first else self.slopes)(x, effects, here.spectra)
        rows, residual = self.whitened(here.spectra, slopes, here.data)
        mean_slopes = np.zeros((len(slopes), 0, 0, 0), dtype=complex)
        if here.left is not None:
            mean_slopes = self.mean_slopes(x, effects, self.observed.segments.values - here.left, range(first, x.size))
        mean_rows, mean_residual = self.mean_rows(here, mean_slopes)
        return np.concatenate([rows, mean_rows]), residual, mean_residual

    def whitened(
        self, spectra: ComplexArray, slopes: ComplexArray, data: ComplexArray | None = None
    ) -> tuple[Array, Array]:
        """Slopes and residual as real rows of unit information, shapes (rows, p) and (rows,)."""
        data = self.data() if data is None else data
        root = np.sqrt(self.observed.weight * self.observed.counts[:, None] * self.widths())
        stacked = np.concatenate([slopes, (data - spectra)[None]])
        rows = whiten(spectra, stacked, root)
        return rows[:, :-1], rows[:, -1]

    def nudged(self, x: Array, i: int, effects: Sequence[Effect]) -> tuple[float, Array]:
        """Finite difference for coordinate i, and x moved by it."""
        layout = self.layout
        if i >= layout.n_nuisance:
            least = [p.least for e in effects for p in e.parameters]
            h = 1e-4 * max(abs(x[i]), least[i - layout.n_nuisance])
        elif i < layout.structure.stop:
            h = _NUDGE * self.prior.units[i]
        else:
            h = _NUDGE
        moved = x.copy()
        moved[i] += h
        return h, moved


def _laws(effects: Sequence[Effect]) -> frozenset[tuple[str, str]]:
    return frozenset((e.name, e.location) for e in effects if e.nonlinear)


def difference_operator(n: int) -> Array:
    """Precision of the logarithms of forces on n floors that are about as strong, at a level that is hardly known."""
    one = np.full((n, n), 1.0 / n)
    return np.asarray((np.eye(n) - one) / _FORCE_STD**2 + one / _LEVEL_STD**2)


def with_coordinates(effects: Sequence[Effect], coordinates: Array) -> tuple[Effect, ...]:
    """Effects at a joint vector of coordinates."""
    out = []
    for e in effects:
        out.append(e.at(coordinates[: len(e.parameters)]))
        coordinates = coordinates[len(e.parameters) :]
    return tuple(out)
