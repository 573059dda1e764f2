"""Fit of the excitation alone, by Fisher scoring with Levenberg-Marquardt steps: the most probable forces, levels and noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Self

import numpy as np

from monitor.core import Array, ComplexArray, levenberg_marquardt
from monitor.inference.posterior import LEVEL_STD, MAX_EXCITATION_STEP, NUDGE, Posterior
from monitor.model import Effect

_MIN_GAIN_NATS = 0.01
"""Expected gain of the next step at which the fit ends. [nats; judgement]"""
_FIXED_SLOPES_NATS = 10.0
"""Gain of a step below which the slopes are not computed again. [nats; judgement]"""


def fit_by_scoring(posterior: Posterior, x: Array, effects: tuple[Effect, ...] = ()) -> Array:
    """Fit forces, levels of the classes and noise; the rest of `x`, to the extra effects' coordinates, does not change."""
    fit = _ExcitationFit.at(posterior, x, effects)
    return levenberg_marquardt(
        fit.evaluate(x),
        fit.linearize,
        lambda at, step: fit.evaluate(
            fit.with_excitation(at.x[fit.free] + np.clip(step, -MAX_EXCITATION_STEP, MAX_EXCITATION_STEP))
        ),
        iterations=40,
        tolerance=_MIN_GAIN_NATS,
        fixed_slopes_gain=_FIXED_SLOPES_NATS,
    ).point.x


@dataclass(frozen=True, eq=False, slots=True)
class _Point:
    """The log posterior of an excitation."""

    x: Array
    spectra: ComplexArray
    value: float


@dataclass(frozen=True, eq=False, slots=True)
class _Slopes:
    """The log posterior near an excitation to second order."""

    spectra: Annotated[ComplexArray, "n+classes+1 classes bins c c"]
    """Slopes of the spectra by forces, levels and noise."""
    normal: Array
    gradient: Array


@dataclass(frozen=True, eq=False, slots=True)
class _ExcitationFit:
    """The log posterior of the excitation alone, all else kept."""

    posterior: Posterior
    x: Array
    """The parameters that are kept, and the excitation about which the prior lies."""
    effects: tuple[Effect, ...]
    data: ComplexArray
    """Measured spectra about the predicted mean, which no level moves."""
    precision: Annotated[Array, "n+classes+1 n+classes+1"]
    """Of the excitation's prior."""

    @classmethod
    def at(cls, posterior: Posterior, x: Array, effects: tuple[Effect, ...]) -> Self:
        """Start at `x`."""
        n, k = posterior.context.structure.n_dofs, posterior.n_classes
        precision = np.diag(np.full(n + k + 1, LEVEL_STD) ** -2.0)
        precision[:n, :n] = posterior.force_precision()
        return cls(posterior, x.copy(), effects, posterior.predict(x, effects).data, precision)

    @property
    def free(self) -> slice:
        """Where forces, levels and noise stand in `x`."""
        return self.posterior.layout.excitation

    def with_excitation(self, excitation: Array) -> Array:
        """Return the parameters with another excitation."""
        out = self.x.copy()
        out[self.free] = excitation
        return out

    def evaluate(self, x: Array) -> _Point:
        """Evaluate the log posterior, nats."""
        spectra, far = self.posterior.scatter(x, self.effects), x[self.free] - self.x[self.free]
        value = self.posterior.log_likelihood(spectra, self.data) - 0.5 * float(far @ self.precision @ far)
        return _Point(x, spectra, value)

    def linearize(self, at: _Point, last: _Slopes | None) -> _Slopes:
        """Linearize the spectra, by the slopes of `last` where there are any."""
        slopes = self._slopes(at) if last is None else last.spectra
        rows, residual = self.posterior.whitened(at.spectra, slopes, self.data)
        gradient = rows.T @ residual - self.precision @ (at.x - self.x)[self.free]
        return _Slopes(slopes, rows.T @ rows + self.precision, gradient)

    def _slopes(self, at: _Point) -> ComplexArray:
        n, k = self.posterior.context.structure.n_dofs, self.posterior.n_classes
        out = np.zeros((n + k + 1, *at.spectra.shape), dtype=complex)

        def slope(direction: Array) -> ComplexArray:
            moved = self.with_excitation(at.x[self.free] + NUDGE * direction)
            return np.asarray((self.posterior.scatter(moved, self.effects) - at.spectra) / NUDGE)

        for i in (*range(n), n + k):
            out[i] = slope(np.eye(n + k + 1)[i])
        # A class's level moves its spectra alone, so that one difference serves all classes.
        out[n + np.arange(k), np.arange(k)] = slope(np.r_[np.zeros(n), np.ones(k), 0.0])
        return out
