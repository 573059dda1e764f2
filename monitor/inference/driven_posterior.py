"""Posterior of a recording with measured ground motion: input and output are known.

The means of the segments are the response to the ground motion.  The scatter about these means is due to forces on the floors,
to noise and to the model's own error.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Self, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from typing_extensions import override

from monitor.core import Array, ComplexArray, parallel_map
from monitor.inference import input_response
from monitor.inference.arrays import Spectra, Transforms, TransformSlopes
from monitor.inference.cross_spectra import extended
from monitor.inference.excitation_scoring import fit_by_scoring
from monitor.inference.forward_model import Laws, Prediction
from monitor.inference.input_response import Between
from monitor.inference.observed_spectra import ObservedSpectra, classify, nearest_classes
from monitor.inference.posterior import LEVEL_STD, Posterior, difference_operator, with_coordinates
from monitor.model import Effect

_FORCED = 1e-3
"""Share of the power beside a measured ground that forces cause, at the start. [ratio; judgement]"""
_INITIAL_MODEL_ERROR = 0.5
"""Error of the model as a share of the amplitude at the start of a fit to driven motion. [ratio; judgement]"""
_NO_LIKELIHOOD = 1e30
"""Stands for a likelihood of zero. [nats; definition]"""
_QUIET_SHARE = 1.0 / 3.0
"""Share of the driven segments, the quietest, that tell the forces. [ratio; judgement]"""
_WIND_STD = 0.15
"""Prior standard deviation of the logarithm of a floor's force that the recording's quiet segments tell. [1;
judgement]"""


@dataclass(frozen=True, eq=False, slots=True)
class ExactSlopes:
    """Difference of the slopes of the exact response from those of the linearized response, near one fit."""

    laws: frozenset[tuple[str, str]]
    """Names and places of the effects."""
    slopes: TransformSlopes
    """Differences of the slopes by the nuisances."""


@dataclass(frozen=True, eq=False, slots=True)
class DrivenPosterior(Posterior):
    """Posterior of a recording with measured ground motion.

    The level of a class is that of the model's own error, a share of the measured power that is independent between channels.
    The forces on the floors are the same in all classes, since wind does not follow the ground motion.
    """

    exact_slopes: ExactSlopes | None = None
    """Correction of the linearized slopes of the response; None where the linearized slopes are used."""
    wind: Annotated[Array, "n"] | None = None
    """Logarithms of the forces as estimated from the recording's quiet segments; None while they are not known."""

    @override
    def part(self, observed: ObservedSpectra, classes: NDArray[np.intp]) -> Self:
        part = replace(Posterior.part(self, observed, classes), exact_slopes=None)
        return part.between_samples(self.observed.drive.between)

    @override
    def other_interpolations(self) -> tuple[Self, ...]:
        return tuple(self.between_samples(b) for b in get_args(Between) if b != self.observed.drive.between)

    @override
    def unmeasured_share(self, effects: Sequence[Effect]) -> float:
        return 0.0

    @override
    def force_precision(self) -> Array:
        """No class's level is that of the forces."""
        return difference_operator(self.context.structure.n_dofs)

    @override
    def first_levels(self, ratio: Array) -> tuple[float, Array]:
        """The forces are small, and the levels are those of the model's error as a share of the power."""
        power = np.einsum("kfaa->kfa", self.observed.spectra).real
        own = np.log(power / self.observed.power).mean(axis=(1, 2)) + 2.0 * np.log(_INITIAL_MODEL_ERROR)
        return float(np.log(ratio.mean()) + np.log(_FORCED)), np.asarray(own)

    @override
    def levels_of_equal_forces(self, ratio: Array) -> tuple[float, float | Array]:
        """One level of all forces is guessed, and the model's own error is taken as the whole power."""
        return float(np.log(ratio).mean() + np.log(_FORCED)), 0.0

    @override
    def fit_levels(self, x: Array) -> Array:
        """Fit one level of all forces, the model's own error in every class, and the noise of the ground and of the channels.

        The forces explain residuals at the resonances, the error explains residuals at all frequencies.
        """
        layout, k = self.layout, self.n_classes
        moving = np.zeros((k + 3, x.size))
        moving[0, layout.forces] = 1.0
        moving[1:-2, layout.levels] = np.eye(k)
        moving[-2, layout.noise] = 1.0
        moving[-1, layout.channel_noise] = 1.0
        data = self.predict(x, ()).data  # levels do not change the means

        def cost(by: Array) -> float:
            value = -self.log_likelihood(self.scatter(x + by @ moving, ()), data)
            return min(value + 0.5 * float(by @ by) / LEVEL_STD**2, _NO_LIKELIHOOD)

        return np.asarray(x + minimize(cost, np.zeros(k + 3), method="Powell", options={"xtol": 1e-3}).x @ moving)

    @override
    def with_quiet_forces(self, x: Array, effects: tuple[Effect, ...]) -> tuple[Self, Array]:
        """Wind acts in quiet segments too, while the error of the model's response grows with the ground's motion."""
        e, layout = self.observed, self.layout
        moved = (np.abs(self.mean(x, effects)) ** 2 / e.power).mean(axis=(1, 2))
        quiet = classify(replace(e.segments, drive=e.drive).part(moved <= np.quantile(moved, _QUIET_SHARE)))
        nearest = nearest_classes(self.n_classes, quiet.counts.size)
        known = np.concatenate([x[: layout.levels.start], x[layout.levels][nearest], x[layout.levels.stop :]])
        out = x.copy()
        out[layout.forces] = fit_by_scoring(self.part(quiet, nearest), known, effects)[layout.forces]
        return replace(self, wind=out[layout.forces]), out

    @override
    def linearizes(self, effects: Sequence[Effect]) -> bool:
        return False

    @override
    def excess(self, x: Array, effects: Sequence[Effect], spectra: Spectra) -> Spectra:
        """None: what is beyond is the model's own error about the response, and no motion by chance."""
        return np.zeros_like(spectra)

    def between_samples(self, between: Between) -> Self:
        """Return the posterior with another assumption on the ground's motion between its samples."""
        return replace(self, observed=replace(self.observed, drive=replace(self.observed.drive, between=between)))

    @override
    def predict(self, x: Array, effects: Sequence[Effect]) -> Prediction:
        left = self.observed.segments.values - self.mean(x, effects)
        return Prediction(self.scatter(x, effects), input_response.products(left, self.observed.members), left)

    @override
    def spectra(self, x: Array, effects: Sequence[Effect]) -> ComplexArray:
        mean = self.mean(x, effects)
        return np.asarray(self.scatter(x, effects) + input_response.products(mean, self.observed.members))

    @override
    def mean(self, x: Array, effects: Sequence[Effect], *, laws: Laws = "exact") -> ComplexArray:
        drive, band = self.observed.drive, self.observed.band
        effects = self.effects(x, effects)
        base, context = self.system(x, effects), self.context_at(x)
        nonlinear = [effect for effect in effects if effect.nonlinear and effect.family == "structure"]
        if nonlinear and laws != "linearized":
            system = extended(base, [f for f in effects if f not in nonlinear], context, self.conditions[0])
            return input_response.exact_response(
                drive, system, effects, band, context, self.conditions[0], coarse=laws == "coarse"
            )
        out = np.zeros_like(self.observed.segments.values)
        if not any(effect.conditional for effect in effects):
            system = extended(base, effects, context, self.conditions[0])
            out[:] = input_response.response(drive, system, effects, band, context, self.conditions[0])
            return out
        for members, condition in zip(self.observed.members, self.conditions, strict=True):
            system = extended(base, effects, context, condition)
            out[members] = input_response.response(drive.part(members), system, effects, band, context, condition)
        return out

    def linear_spectra(self, x: Array, effects: Sequence[Effect], classes: Sequence[int]) -> ComplexArray:
        """The model's own error is added."""
        level = np.exp(x[self.layout.levels])[list(classes), None, None, None]
        return Posterior.linear_spectra(self, x, effects, classes) + level * _diagonal(self.observed.power)

    def ground_noise(self, x: Array) -> float:
        """The noise that all channels share is also that of a ground's sensor."""
        return float(np.exp(x[self.layout.noise])) if self.observed.drive.rides.any() else 0.0

    def forces(self, x: Array) -> Array:
        """The densities of `x` apply to the prior mean of the masses.

        All masses and forces grow together, since no output shows the common scale of masses and stiffnesses.
        """
        layout = self.layout
        heavier = (x[layout.masses] - self.prior.mean[layout.masses]).mean()
        return np.tile(np.exp(x[layout.forces]) * np.exp(2.0 * heavier), (self.n_classes, 1))

    def relative_levels(self, x: Array) -> Array:
        """The forces are the same in all classes."""
        return np.ones(self.n_classes)

    @override
    def force_prior(self, x: Array) -> tuple[Array, Array]:
        own = x[self.layout.forces]
        if self.wind is not None:
            return self.wind, np.eye(own.size) / _WIND_STD**2
        return own, difference_operator(own.size)

    @override
    def slopes(self, x: Array, effects: tuple[Effect, ...], spectra: ComplexArray, first: int = 0) -> ComplexArray:
        layout = self.layout
        out = np.zeros((x.size, *spectra.shape), dtype=complex)
        # The forces are fixed until quiet segments give an estimate, since free forces would hide a wrong response at its peaks.
        n_free = layout.forces.start if self.wind is None else layout.forces.stop
        for i in range(first, x.size):
            if i > layout.noise:
                out[i] = self.slope_by_class(x, i, effects, spectra)
            elif i < n_free or i == layout.noise:
                out[i] = self._slope(x, i, effects, spectra)
        for k, by_level in enumerate(out[layout.levels]):
            by_level[k] = np.exp(x[layout.levels][k]) * _diagonal(self.observed.power)
        return out[first:]

    def _slope(self, x: Array, i: int, effects: tuple[Effect, ...], spectra: Spectra) -> Spectra:
        """Differentiate the spectra by nuisance i in the middle class, since the slope only weights the residual.

        Slopes by persistent effects that act differently in each class are computed in every class.
        """
        if i in self.persistent_by_class():
            return self.slope_by_class(x, i, effects, spectra)
        middle = self.n_classes // 2
        h, moved = self.nudged(x, i, effects)
        change = self.scatter(moved, effects, classes=[middle])[0] - spectra[middle]
        return np.broadcast_to(change / h, spectra.shape)

    def mean_slopes(
        self, x: Array, effects: tuple[Effect, ...], mean: Transforms, wanted: Iterable[int]
    ) -> TransformSlopes:
        """Differentiate the segments' means by the coordinates with the wanted indices; `mean` is the response at `x`.

        The slopes by an effect's own coordinates are those of the exact laws.  The slopes by nuisances are those of the
        linearized laws, which are faster, corrected by `exact_slopes` where known.
        """
        wanted, linear = tuple(wanted), self._mean_by("linearized", x, effects, mean)
        has_own = any(i > self.layout.noise for i in wanted)
        coarse = self._mean_by("coarse", x, effects, mean) if has_own else mean
        known = self.exact_slopes
        exact = known if known is not None and known.laws == _laws(effects) else None
        out = []
        for i in wanted:
            h, moved = self.nudged(x, i, effects)
            if i > self.layout.noise:
                changed = self.mean(moved, with_coordinates(effects, moved[self.layout.effects]), laws="coarse")
                out.append((changed - coarse) / h)
            elif i in self._moving:
                changed = self.mean(moved, effects, laws="linearized")
                out.append((changed - linear) / h + (0.0 if exact is None else exact.slopes[i]))
            else:
                out.append(np.zeros_like(mean))
        return np.array(out, dtype=complex).reshape(-1, *mean.shape)

    @override
    def with_exact_slopes(self, x: Array, effects: tuple[Effect, ...]) -> Self:
        if not _laws(effects):
            return self

        def added(x: Array) -> ComplexArray:
            mean = self.mean(x, effects, laws="coarse")
            return np.asarray(mean - self._mean_by("linearized", x, effects, mean))

        at_fit = added(x)

        def slope(i: int) -> ComplexArray:
            h, moved = self.nudged(x, i, effects)
            return np.asarray((added(moved) - at_fit) / h)

        slopes = np.zeros((self.layout.n_nuisance, *at_fit.shape), dtype=complex)
        slopes[self._moving] = parallel_map(slope, self._moving)
        return replace(self, exact_slopes=ExactSlopes(_laws(effects), slopes))

    def _mean_by(self, laws: Laws, x: Array, effects: tuple[Effect, ...], mean: ComplexArray) -> ComplexArray:
        """Compute the response with nonlinear laws that act in another way, given that by the exact laws, `mean`."""
        return self.mean(x, effects, laws=laws) if any(e.nonlinear for e in self.effects(x, effects)) else mean

    @property
    def _moving(self) -> list[int]:
        """Indices of the nuisances that change the response: neither noise nor forces."""
        noise = self.layout.channel_noise
        return [*range(noise.start), *range(noise.stop, self.layout.structure.stop)]

    @override
    def mean_rows(self, prediction: Prediction, slopes: ComplexArray) -> tuple[Array, Array]:
        assert prediction.left is not None
        e = self.observed
        weight = (e.weight * e.counts / [m.size for m in e.members])[:, None] * self.widths()
        rows = input_response.mean_rows(
            prediction.spectra, np.concatenate([slopes, prediction.left[None]]), e.members, weight
        )
        return rows[:, :-1], rows[:, -1]

    @override
    def slope_rows(
        self, x: Array, effects: tuple[Effect, ...], prediction: Prediction, first: int = 0
    ) -> tuple[Array, Array, Array]:
        assert prediction.left is not None
        rows, residual, _ = Posterior.slope_rows(self, x, effects, prediction, first)
        mean_slopes = self.mean_slopes(
            x, effects, self.observed.segments.values - prediction.left, range(first, x.size)
        )
        mean_rows, mean_residual = self.mean_rows(prediction, mean_slopes)
        return np.concatenate([rows, mean_rows]), residual, mean_residual


def _laws(effects: Sequence[Effect]) -> frozenset[tuple[str, str]]:
    return frozenset((e.name, e.location) for e in effects if e.nonlinear)


def _diagonal(power: Annotated[Array, "bins c"]) -> Annotated[Array, "bins c c"]:
    """Put the channels' power on the diagonals of matrices."""
    return power[:, :, None] * np.eye(power.shape[1])
