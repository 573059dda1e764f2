"""The one score for all causes: debiased Whittle likelihood of a recording's cross-spectra under a model.

Nuisances (stiffness and mass within what is known of them, damping, excitation, noise) compete with every effect.  What is
known of the structure, from its drawing or from its baseline, is a normal prior on the structural nuisances.

References
----------
P. Whittle, Arkiv foer Matematik 2 (1953) 423-434; A. M. Sykulski et al., The debiased Whittle likelihood, Biometrika 106
(2019) 251-266.  Statistical linearization: J. B. Roberts, P. D. Spanos, Random Vibration and Statistical Linearization (1990).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from monitor.core import Array, ComplexArray
from monitor.inference.forward_model import ForwardModel, Prediction
from monitor.inference.observed_spectra import ObservedSpectra
from monitor.inference.wishart import log_det_and_trace, whiten
from monitor.model import Effect

FORCE_STD = 1.0
"""Prior standard deviation of the logarithm of a floor's force about the floors' mean. [1; judgement: a factor of e]"""
LEVEL_STD = 5.0
"""Prior standard deviation of the logarithm of a class's level of excitation. [1; judgement: a factor of 150]"""
_NOISE_STD = 3.0
"""Prior standard deviation of the logarithm of the noise density that the channels share. [1; judgement: a factor
of 20]"""
MAX_EXCITATION_STEP = 2.0
"""Longest step of a fit in the logarithm of a force, a level or the noise. [1; judgement: a factor of 7]"""
NUDGE = 1e-5
"""Finite difference of a nuisance parameter, most of which are logarithms. [1; rounding]"""


@dataclass(frozen=True, eq=False, slots=True)
class Posterior(ForwardModel):
    """Score parameters: the likelihood of a recording's observed spectra, and what is known of the parameters before it."""

    def part(self, evidence: ObservedSpectra, classes: NDArray[np.intp]) -> Self:
        """The same for other segments, whose classes are like those of these numbers here."""
        return replace(self, observed=evidence, conditions=tuple(self.conditions[k] for k in classes))

    def beyond(self, x: Array, effects: Sequence[Effect]) -> ComplexArray | None:
        """What simulation adds to the linearized spectra at a point, relative to them, shape (classes, n_bins, c, c).

        None where none was made, or one of other laws.
        """
        return None

    def normal_prior(self, x: Array, effects: Sequence[Effect]) -> tuple[Array, Array]:
        """Mean and precision of the nuisances, given the forces' mean level, and of the effects' coordinates."""
        middle = self.conditions[self.n_classes // 2]
        known = [e.known(self.context, middle) for e in effects]
        forces, force_precision = self.force_prior(x)
        precision = block_diag(
            self.prior.precision,
            force_precision,
            np.eye(self.n_classes) / LEVEL_STD**2,
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

    @abstractmethod
    def force_prior(self, x: Array) -> tuple[Array, Array]:
        """Return mean and precision of the logarithms of the floors' forces, shapes (n,) and (n, n)."""

    def with_exact_slopes(self, x: Array, effects: tuple[Effect, ...]) -> Self:
        """Return the posterior with slopes of the exact laws near a fit; itself where no ground was measured."""
        return self

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

    @abstractmethod
    def slopes(self, x: Array, effects: tuple[Effect, ...], spectra: ComplexArray) -> ComplexArray:
        """Differentiate the (smoothed) spectra by all parameters, shape (p, classes, bins, c, c).

        Parameters
        ----------
        spectra : ndarray, shape (classes, bins, c, c)
            The prediction at `x`.
        """

    def slope(self, x: Array, i: int, effects: tuple[Effect, ...], spectra: ComplexArray) -> ComplexArray:
        """As `slopes`, by nuisance i alone: taken at the middle class and scaled by level, as it only weighs the residual, but
        for what standing effects do to every class in its own way."""
        if i in self._by_class:
            return self.slope_by_class(x, i, effects, spectra)
        middle, scale = self.n_classes // 2, self.relative_levels(x)
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

    @property
    def _by_class(self) -> list[int]:
        """Coordinates of standing effects that depend on the condition, or do not follow the level."""
        first = self.layout.persistent.start
        conditional = [e.conditional or bool(e.lines()) for e in self.prior.model.effects for _ in e.parameters]
        return [first + j for j, by_class in enumerate(conditional) if by_class]

    def mean_rows(self, here: Prediction, slopes: ComplexArray) -> tuple[Array, Array]:
        """Whiten changes of the segments' means as `whitened` does those of the spectra; no rows without a measured ground."""
        return np.zeros((0, len(slopes))), np.zeros(0)

    def jacobian(
        self, x: Array, effects: tuple[Effect, ...], here: Prediction, first: int = 0
    ) -> tuple[Array, Array, Array]:
        """Whitened slopes by the coordinates from `first` on, and the residuals of the spectra's and of the means' rows."""
        slopes = (self.effect_slopes if first else self.slopes)(x, effects, here.spectra)
        rows, residual = self.whitened(here.spectra, slopes, here.data)
        return np.ascontiguousarray(rows), residual, np.zeros(0)

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
            h = NUDGE * self.prior.units[i]
        else:
            h = NUDGE
        moved = x.copy()
        moved[i] += h
        return h, moved


def difference_operator(n: int) -> Array:
    """Precision of the logarithms of forces on n floors that are about as strong, at a level that is hardly known."""
    one = np.full((n, n), 1.0 / n)
    return np.asarray((np.eye(n) - one) / FORCE_STD**2 + one / LEVEL_STD**2)


def with_coordinates(effects: Sequence[Effect], coordinates: Array) -> tuple[Effect, ...]:
    """Effects at a joint vector of coordinates."""
    out = []
    for e in effects:
        out.append(e.at(coordinates[: len(e.parameters)]))
        coordinates = coordinates[len(e.parameters) :]
    return tuple(out)
