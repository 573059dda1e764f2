"""Story forces straight from the data, where the inputs are known: the law of each story, whatever effect describes it.

The force of a story is what moves the floors above it: their masses times their measured accelerations, less the measured
forces on them.  Its drift is the difference of two floors' accelerations, integrated twice in the band that is judged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, ComplexArray
from monitor.diagnosis.parameter_uncertainty import DIFFERS_STDS
from monitor.diagnosis.verdict import Diagnosis
from monitor.inference import MapEstimate, Posterior
from monitor.model import Condition, Context, Effect
from monitor.signals import taper

_LEAST_SEGMENTS = 6
"""Fewest segments whose thirds are compared. [segments; definition: two in each third]"""
_FINER = 8
"""Points of a loop for a sample. [ratio; to draw smooth curves]"""


@dataclass(frozen=True, eq=False, slots=True)
class Loop:
    """Force of a story against its drift in the middle of a segment."""

    drift_m: Annotated[Array, "n"]
    force_n: Annotated[Array, "n"]


@dataclass(frozen=True, eq=False, slots=True)
class StoryLaw:
    """Law of one story as the data show it, beside those of the model before and after the causes.

    Arrays of two hold the third of the segments with the smallest drifts, then that with the largest.
    """

    story: int
    """From 1."""
    drift_m: Annotated[Array, "2"]
    """RMS drift."""
    stiffness_n_per_m: Annotated[Array, "2"]
    """Secant stiffness."""
    stiffness_std: Annotated[Array, "2"]
    loss: Annotated[Array, "2"]
    """Loss factor: dissipated energy in a cycle over 2 pi times the largest elastic energy."""
    loss_std: Annotated[Array, "2"]
    model_stiffness_n_per_m: Annotated[Array, "2"]
    """That of the model with its causes, as `model_loss`."""
    model_loss: Annotated[Array, "2"]
    measured: Loop
    """Loop in the segment with the largest drift."""
    before: Loop
    """Loop of the model without causes."""
    after: Loop
    """Loop of the model with the causes."""

    @property
    def says(self) -> str:
        """State in words, without a full stop, how the story's law changes with the level beyond what the model says."""
        (k, stiffer), (model_k, model_stiffer) = self.stiffness_n_per_m, self.model_stiffness_n_per_m
        (eta, lossier), (model_eta, model_lossier) = self.loss, self.model_loss
        found = []
        beyond, visible = (stiffer - k) - (model_stiffer - model_k), DIFFERS_STDS * float(np.hypot(*self.stiffness_std))
        if abs(beyond) > visible:
            trend = "hardens" if beyond > 0.0 else "softens"
            found.append(f"{trend} by {100.0 * abs(beyond) / k:.1f} % more than the model")
        gained = (lossier - eta) - (model_lossier - model_eta)
        if abs(gained) > DIFFERS_STDS * float(np.hypot(*self.loss_std)):
            more = "more" if gained > 0.0 else "less"
            found.append(f"its loss factor grows by {100.0 * abs(gained):.1f} % {more} than the model's")
        low, high = 1e3 * self.drift_m
        span = f"from {low:.2g} to {high:.2g} mm of RMS drift story {self.story}"
        alike = f"changes with the level as the model does, to within {100.0 * visible / k:.2g} % of its stiffness"
        return f"{span} {' and '.join(found) or alike}"


def story_laws(diagnosis: Diagnosis) -> tuple[StoryLaw, ...]:
    """Compare the law of every story with the model's before and after the causes.

    Empty where no input was measured, a floor has no sensor, or the stories are no single springs.

    References
    ----------
    S. Masri, T. Caughey, A nonparametric identification technique for nonlinear dynamic problems, Journal of Applied Mechanics 46
    (1979) 433 (restoring forces from measured accelerations).
    """
    posterior, fit = diagnosis.posterior, diagnosis.final_fit
    context = posterior.context
    drifts, n = context.structure.drift_matrix(), context.structure.n_dofs
    whole = drifts.shape == (n, n) == context.sensors.shape
    if not whole or posterior.observed.drive.located.size < _LEAST_SEGMENTS:
        return ()
    measured = _forces_and_drifts(posterior, fit, posterior.observed.segments.values)
    null = diagnosis.null_fit
    before = _forces_and_drifts(posterior, null, posterior.mean(null.x, null.effects))
    after = _forces_and_drifts(posterior, fit, posterior.mean(fit.x, fit.effects))
    return tuple(_law(j, posterior, measured, before, after) for j in range(n))


Channels = Annotated[ComplexArray, "segments bins c"]
_Series = tuple[ComplexArray, ComplexArray]
"""Transforms of the stories' forces, N/sqrt(Hz), and of their drifts, m/sqrt(Hz), shape (n_segments, n_bins, n) each."""


def _forces_and_drifts(posterior: Posterior, fit: MapEstimate, channels: Channels) -> _Series:
    """Compute forces and drifts from the channels' transforms with the masses of a fit."""
    e, context, drive = posterior.observed, posterior.context_at(fit.x), posterior.observed.drive
    effects = posterior.effects(fit.x, fit.effects)
    n, hz = context.structure.n_dofs, e.band.hz
    true = true_motion(channels, effects, hz, context, posterior.conditions[0])
    floors = true @ np.linalg.inv(context.sensors).T
    inputs = drive.measured(e.band)
    system = posterior.system(fit.x, effects)
    mass, pushed = system.mass[:n, :n], drive.forces(system)[:n] * (1.0 - drive.rides)
    drifts = context.structure.drift_matrix()
    acting = inputs @ pushed.T - floors @ mass.T
    relative = floors - (inputs @ drive.rides)[..., None] * context.structure.rides
    displaced = relative / -((2.0 * np.pi * hz[:, None]) ** 2)
    return np.asarray(acting @ np.linalg.inv(drifts)), np.asarray(displaced @ drifts.T)


def true_motion(
    channels: Channels, effects: Sequence[Effect], hz: Array, context: Context, condition: Condition
) -> Channels:
    """Take what effects of the sensors do to the channels' transforms out of them."""
    true = np.asarray(channels, dtype=np.complex128)
    for effect in reversed(effects):
        response = effect.response(hz, context, condition)
        if response is not None:
            true = np.asarray(np.linalg.solve(response, true[..., None])[..., 0], dtype=np.complex128)
    return true


def _law(j: int, posterior: Posterior, measured: _Series, before: _Series, after: _Series) -> StoryLaw:
    power = (np.abs(measured[1][:, :, j]) ** 2).sum(axis=1)
    order, third = np.argsort(power), max(2, power.size // 3)
    groups = order[:third], order[-third:]
    k, k_std, eta, eta_std = np.array([_secant(measured, after[1], j, group) for group in groups]).T
    model_k, _, model_eta, _ = np.array([_secant(after, after[1], j, group) for group in groups]).T
    bin_hz, largest = posterior.observed.band.bin_hz, int(order[-1])
    return StoryLaw(
        story=j + 1,
        drift_m=np.sqrt([2.0 * bin_hz * float(power[group].mean()) for group in groups]),
        stiffness_n_per_m=k,
        stiffness_std=k_std,
        loss=eta,
        loss_std=eta_std,
        model_stiffness_n_per_m=model_k,
        model_loss=model_eta,
        measured=_loop(posterior, measured, largest, j),
        before=_loop(posterior, before, largest, j),
        after=_loop(posterior, after, largest, j),
    )


def _secant(
    series: _Series, instrument: Annotated[ComplexArray, "segments bins n"], j: int, group: NDArray[np.intp]
) -> tuple[float, float, float, float]:
    """Regress the force of story j on its drift over a group of segments.

    The noise of the sensors, integrated twice, would make every story seem softer the less it moves.  So the regression is by an
    instrumental variable: the drift that the model predicts, which has no noise.  The standard deviations are by the jackknife
    over the segments.  Return the stiffness in N/m, the loss factor, and after each its standard deviation.
    """
    force, drift = (part[group, :, j] for part in series)
    known = instrument[group, :, j].conj()
    products = np.stack([(force * known).sum(axis=1), (drift * known).sum(axis=1)])
    others = products.sum(axis=1, keepdims=True) - products
    left_out, whole = others[0] / others[1], complex(np.divide(*products.sum(axis=1)))
    spread = np.sqrt(group.size - 1.0)
    loss = left_out.imag / left_out.real
    return whole.real, spread * float(left_out.real.std()), whole.imag / whole.real, spread * float(loss.std())


def _loop(posterior: Posterior, series: _Series, segment: int, j: int) -> Loop:
    """Transform force and drift of story j back to time, in the middle half of a segment."""
    e, design = posterior.observed, posterior.observed.drive.design
    n = design.n
    middle = slice(_FINER * n // 4, 3 * _FINER * n // 4)
    window = np.interp(np.arange(_FINER * n) / _FINER, np.arange(n), taper(n))[middle]
    out = []
    for part in series:
        spectrum = np.zeros(_FINER * n // 2 + 1, dtype=complex)
        spectrum[e.band.first : e.band.first + e.band.n_bins] = part[segment, :, j] * np.sqrt(design.rate_hz)
        out.append(np.fft.irfft(spectrum)[middle] * _FINER / window)
    return Loop(out[1], out[0])
