"""Posterior by which all causes are scored: the debiased Whittle likelihood of a recording's cross-spectra and a prior.

Nuisance parameters (stiffness and mass within their prior, damping, excitation, noise) are fitted together with every effect, and
may explain what the effect explains.  The prior of the structural nuisances is normal; it is from the drawing or the baseline.

References
----------
P. Whittle, Arkiv foer Matematik 2 (1953) 423-434; A. M. Sykulski et al., The debiased Whittle likelihood, Biometrika 106
(2019) 251-266.  Statistical linearization: J. B. Roberts, P. D. Spanos, Random Vibration and Statistical Linearization (1990).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from monitor.core import Array
from monitor.inference.arrays import Spectra, SpectraSlopes, TransformSlopes
from monitor.inference.forward_model import ForwardModel, Prediction
from monitor.inference.observed_spectra import ObservedSpectra
from monitor.inference.spectral_slopes import RowSlopes, Slopes
from monitor.inference.trial import tried
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
    """Posterior of parameters: the likelihood of a recording's observed spectra, and the prior of the parameters."""

    def part(self, evidence: ObservedSpectra, classes: NDArray[np.intp]) -> Self:
        """Return the posterior for other segments of the recording.

        `classes` gives for each of their classes the index of the class prediction that has the same condition.
        """
        return replace(self, observed=evidence, conditions=tuple(self.conditions[k] for k in classes))

    def beyond(self, x: Array, effects: Sequence[Effect]) -> Spectra | None:
        """Return the simulated correction relative to the linearized spectra at a point.

        The result is None where no correction was simulated, or one of other laws.
        """
        return None

    def normal_prior(self, x: Array, effects: Sequence[Effect]) -> tuple[Array, Annotated[Array, "p p"]]:
        """Return mean and precision of the prior of all parameters at a point.

        The prior of the forces is about their mean level at `x`, and that of the noise about its value at `x`.
        """
        middle = self.conditions[self.n_classes // 2]
        known = [e.known(self.context, middle) for e in effects]
        forces, force_precision = self.force_prior(x)
        levels, noise = np.eye(self.n_classes) / LEVEL_STD**2, np.eye(1) / _NOISE_STD**2
        own = [np.diag(precision) for _, precision in known]
        excitation = [forces, np.zeros(self.n_classes), [x[self.layout.noise]]]
        mean = np.concatenate([self.prior.mean, *excitation, *[m for m, _ in known]])
        return mean, block_diag(self.prior.precision, force_precision, levels, noise, *own)

    @abstractmethod
    def force_prior(self, x: Array) -> tuple[Annotated[Array, "n"], Annotated[Array, "n n"]]:
        """Return mean and precision of the logarithms of the floors' forces."""

    @abstractmethod
    def force_precision(self) -> Annotated[Array, "n n"]:
        """Return the precision of the logarithms of the floors' forces while the excitation alone is fitted."""

    @abstractmethod
    def first_levels(self, ratio: Annotated[Array, "classes"]) -> tuple[float, Annotated[Array, "classes"]]:
        """Guess the logarithms of the floors' forces and of the levels, from the power over that at zero; see `guess_levels`."""

    @abstractmethod
    def levels_of_equal_forces(
        self, ratio: Annotated[Array, "classes"]
    ) -> tuple[float, float | Annotated[Array, "classes"]]:
        """Guess as `first_levels` with the least said of the forces: one level, or one a class."""

    @abstractmethod
    def fit_levels(self, x: Array) -> Array:
        """Fit forces, levels of the classes and noise without extra effects; the rest of `x` does not change.

        The force on each floor is a property of the recording, as its level is.  With equal forces on all floors, a wrong
        structure that compensates for their differences would have the best score.
        """

    def with_quiet_forces(self, x: Array, effects: tuple[Effect, ...]) -> tuple[Self, Array]:
        """Know the forces beside measured inputs from the quietest segments: return the posterior and `x` with them.

        Without measured inputs itself, and `x` as it is.
        """
        return self, x

    def linearizes(self, effects: Sequence[Effect]) -> bool:
        """Decide if a law of some effects is linearized, which simulation corrects; a known motion is integrated exactly."""
        return any(e.nonlinear for e in effects)

    def excess(self, x: Array, effects: Sequence[Effect], spectra: Spectra) -> Spectra:
        """Compute the spectra beyond those expected, which tell how the motion differs from the expected one by chance."""
        return np.asarray(spectra - self.scatter(x, effects))

    def unmeasured_share(self, effects: Sequence[Effect]) -> float:
        """Compute the share of the motion that a ground motion causes which was not measured."""
        return sum(e.ground_share for e in effects)

    def other_interpolations(self) -> tuple[Self, ...]:
        """Return the posteriors with the other assumptions on the ground's motion between its samples."""
        return ()

    def with_exact_slopes(self, x: Array, effects: tuple[Effect, ...]) -> Self:
        """Return the posterior with slopes of the exact laws near a fit; itself without such laws or a measured ground."""
        return self

    def log_likelihood(self, spectra: Spectra, data: Spectra | None = None, *, levelled: bool = False) -> float:
        """Compute the tempered Whittle log likelihood, nats; -inf where a spectrum is not positive definite.

        The data are the observed spectra by default.  Levelled, each class's spectra are first multiplied by the factor
        with which they fit the data best.
        """
        log_det, trace = log_det_and_trace(spectra, self.observed.spectra if data is None else data)
        if not np.isfinite(log_det).all():
            return -np.inf
        if levelled:
            c, widths = spectra.shape[-1], self.widths()
            level = (trace @ widths)[:, None] / (c * widths.sum())
            log_det, trace = log_det + c * np.log(level), trace / level
        total = ((-log_det - trace) * self.widths()).sum(axis=1) @ self.observed.counts * self.observed.weight
        return float(total) if np.isfinite(total) else -np.inf

    def score(self, x: Array, effects: tuple[Effect, ...]) -> tuple[float, float]:
        """Compute the log likelihood, -inf where there is no structure, and the log prior at a point, nats."""

        def at_point() -> tuple[float, float]:
            prediction = self.predict(x, effects)
            return self.log_likelihood(prediction.spectra, prediction.data), self.log_prior(x, effects)

        return tried(at_point, (-np.inf, 0.0))

    def log_prior(self, x: Array, effects: Sequence[Effect]) -> float:
        """Compute the log prior at a point up to a constant, nats."""
        mean, precision = self.normal_prior(x, effects)
        return -0.5 * float((x - mean) @ precision @ (x - mean))

    @abstractmethod
    def slopes(self, x: Array, effects: tuple[Effect, ...], spectra: Spectra, first: int = 0) -> SpectraSlopes:
        """Differentiate the spectra, whose prediction at `x` is given, by the parameters from `first` on."""

    def slope_by_class(self, x: Array, i: int, effects: tuple[Effect, ...], spectra: Spectra) -> Spectra:
        """Differentiate the spectra by coordinate i in every class."""
        h, moved = self.nudged(x, i, effects)
        after = with_coordinates(effects, moved[self.layout.effects])
        return np.asarray((self.scatter(moved, after) - spectra) / h)

    def persistent_by_class(self) -> list[int]:
        """List the coordinates of the persistent effects that act differently in each class."""
        first, owners = self.layout.persistent.start, of_coordinates(self.prior.model.effects)
        return [first + j for j, e in enumerate(owners) if e.conditional or e.lines()]

    def owners(self, effects: Sequence[Effect]) -> dict[int, int]:
        """Map every coordinate of an effect to the effect's index in `Posterior.effects`."""
        before, first = self.prior.model.effects, self.layout.persistent.start
        owners = [i for i, e in enumerate((*before, *effects)) for _ in e.parameters]
        n_persistent = sum(len(e.parameters) for e in before)
        extra = range(self.layout.n_nuisance, self.layout.n_nuisance + len(owners) - n_persistent)
        return dict(zip((*range(first, first + n_persistent), *extra), owners, strict=True))

    def mean_rows(self, prediction: Prediction, slopes: TransformSlopes) -> tuple[Annotated[Array, "rows p"], Array]:
        """Whiten changes of the segments' means, and their residual, as `whitened` does those of the spectra.

        There are no rows without a measured ground.
        """
        return np.zeros((0, len(slopes))), np.zeros(0)

    def linearized(self, x: Array, effects: tuple[Effect, ...], prediction: Prediction) -> tuple[Slopes, Array, Array]:
        """Compute the whitened slopes, of the spectra and then of the segments' means, and the residuals of both."""
        rows, residual, mean_residual = self.slope_rows(x, effects, prediction)
        return RowSlopes(rows), residual, mean_residual

    def slope_rows(
        self, x: Array, effects: tuple[Effect, ...], prediction: Prediction, first: int = 0
    ) -> tuple[Annotated[Array, "rows wanted"], Annotated[Array, "rows"], Array]:
        """Compute as `linearized`, but for the slopes by the coordinates from `first` on as rows."""
        rows, residual = self.whitened(
            prediction.spectra, self.slopes(x, effects, prediction.spectra, first), prediction.data
        )
        return rows, residual, np.zeros(0)

    def whitened(
        self, spectra: Spectra, slopes: SpectraSlopes, data: Spectra | None = None
    ) -> tuple[Annotated[Array, "rows p"], Annotated[Array, "rows"]]:
        """Whiten slopes and residual into real rows of unit information, classes * bins * c * c of them."""
        data = self.observed.spectra if data is None else data
        root = self.root_information()
        return whiten(spectra, slopes, root), whiten(spectra, (data - spectra)[None], root)[:, 0]

    def whitened_change(self, reference: Prediction, changed: Prediction) -> Annotated[Array, "rows"]:
        """Compute the change from one prediction to another, whitened by the spectra of the first."""
        change, _ = self.whitened(reference.spectra, (changed.spectra - reference.spectra)[None], reference.data)
        if reference.left is None or changed.left is None:
            return change[:, 0]
        mean, _ = self.mean_rows(reference, (reference.left - changed.left)[None])
        return np.concatenate([change, mean])[:, 0]

    def root_information(self) -> Annotated[Array, "classes bins"]:
        """Compute the root of the information in each class and bin."""
        return np.sqrt(self.observed.weight * self.observed.counts[:, None] * self.widths())

    def nudged(self, x: Array, i: int, effects: Sequence[Effect]) -> tuple[float, Array]:
        """Return the finite difference for coordinate i, and the parameter vector changed by it."""
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


def difference_operator(n: int) -> Annotated[Array, "n n"]:
    """Build the prior precision of the logarithms of the forces on n floors.

    The forces differ little between floors, while their common level is nearly unknown.
    """
    one = np.full((n, n), 1.0 / n)
    return np.asarray((np.eye(n) - one) / FORCE_STD**2 + one / LEVEL_STD**2)


def of_coordinates(effects: Sequence[Effect]) -> list[Effect]:
    """Return the effect of every coordinate of effects."""
    return [e for e in effects for _ in e.parameters]


def with_coordinates(effects: Sequence[Effect], coordinates: Array) -> tuple[Effect, ...]:
    """Return the effects at a joint vector of their coordinates."""
    out = []
    for e in effects:
        out.append(e.at(coordinates[: len(e.parameters)]))
        coordinates = coordinates[len(e.parameters) :]
    return tuple(out)


def join_coordinates(nuisances: Array, effects: Sequence[Effect]) -> Array:
    """Join nuisances and the effects' coordinates to the parameter vector of a fit."""
    return np.concatenate([nuisances, *[e.coordinates for e in effects]])
