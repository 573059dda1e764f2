"""Plain findings from a response to measured inputs: frequency ratios, and the first mode's dependence on amplitude."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from monitor.core import Array, ComplexArray
from monitor.diagnosis.lack_of_fit import LackOfFit
from monitor.diagnosis.plan import plan_of
from monitor.inference import MapEstimate, Posterior, with_coordinates
from monitor.signals import NORMAL_MAD

_FIRST_MODE_BAND = 0.6, 1.6
"""Band in which the first mode's equation of motion is fitted, over the first frequency. [ratio; judgement]"""
_MAX_LEFT_POWER = 0.1
"""Largest share of a segment's power near the mode that its equation of motion may leave unexplained. [ratio;
judgement]"""
_MIN_SEGMENTS = 6
"""Fewest segments from which a dependence on amplitude is stated. [segments; judgement]"""
_MIN_RELATIVE_CHANGE = 0.004
"""Smallest relative change of a frequency or damping ratio that is reported. [ratio; judgement]"""
_MIN_CHANGE_STDS = 6.0
"""Smallest such change in standard deviations. [standard deviations; judgement]"""


def _backbone(posterior: Posterior, fit: MapEstimate) -> list[tuple[float, float, float]]:
    """Estimate the first mode's frequency in every segment that shows it clearly, by ascending amplitude.

    In each segment ``y'' + 2 zeta w y' + w^2 y = gamma u`` is solved by least squares in the frequency domain.  Here y is the
    floors' motion relative to the ground in the first mode, and u is the force of all inputs on that mode.  A row has the peak
    displacement of the top floor in the first mode, m, sqrt(2) x RMS, and the first frequencies of the measured motion and of
    the model's response, Hz.
    """
    e, drive, mean = posterior.observed, posterior.observed.drive, posterior.mean(fit.x, fit.effects)
    effects = posterior.effects(fit.x, fit.effects)
    system, modes = posterior.system(fit.x, effects), posterior.model(fit.x, effects).modes()
    first, shape, sensors = float(modes.frequencies_hz[0]), modes.shapes[:, 0].real, posterior.context.sensors
    # Maps the channels to the first mode's coordinate, which is the top floor's motion in that mode.
    to_mode = np.linalg.pinv(sensors).T @ system.mass @ shape * shape[0]
    in_band = (e.band.hz > _FIRST_MODE_BAND[0] * first) & (e.band.hz < _FIRST_MODE_BAND[1] * first)
    w = 2.0 * np.pi * e.band.hz[in_band]
    inputs = drive.measured(e.band)[:, in_band]
    rigid = to_mode @ sensors @ posterior.context.structure.rides * (inputs @ drive.rides)
    forced = inputs @ (shape @ drive.forces(system)[: shape.size])
    rows = []
    for s in drive.located:
        measured, predicted = (x[s, in_band] @ to_mode - rigid[s] for x in (e.segments.values, mean))
        hz, amplitude, unexplained = _fit_oscillator(measured, forced[s], w)
        model_hz, _, model_unexplained = _fit_oscillator(predicted, forced[s], w)
        if max(unexplained, model_unexplained) < _MAX_LEFT_POWER:
            rows.append((amplitude * np.sqrt(2.0 * e.band.bin_hz), hz, model_hz))
    return sorted(rows)


def _fit_oscillator(
    y: Annotated[ComplexArray, "bins"], force: Annotated[ComplexArray, "bins"], w: Annotated[Array, "bins"]
) -> tuple[float, float, float]:
    """Fit an oscillator's equation of motion to a mode's acceleration relative to the ground, `y`, under a force of any unit.

    Return the frequency in Hz, the root of the summed power of the displacement, and the share of the power left unexplained.
    """
    a = np.column_stack([y / -(w**2), y / (1j * w), force])
    parts, target = np.concatenate([a.real, a.imag]), -np.concatenate([y.real, y.imag])
    x, *_ = np.linalg.lstsq(parts, target, rcond=None)
    omega = float(np.sqrt(max(x[0], 0.0)))
    unexplained = float(((parts @ x - target) ** 2).sum() / (target**2).sum())
    size = float(np.sqrt(2.0 * (np.abs(y / w**2) ** 2).sum()))
    return omega / (2.0 * np.pi), size, unexplained


def median_with_std(values: Annotated[Array, "n"]) -> tuple[float, float]:
    """Compute the median of values, and its standard deviation from their scatter."""
    middle = float(np.median(values))
    # That of a normal sample's median is sqrt(pi / 2) times that of its mean.
    return middle, NORMAL_MAD * 1.2533 * float(np.median(np.abs(values - middle))) / np.sqrt(values.size)


def find_level_dependence(posterior: Posterior, fit: MapEstimate) -> LackOfFit | None:
    """Test if the first frequency depends on the amplitude more than the model's does; return None where it does not.

    The medians of the third of the segments with the smallest amplitudes and of the third with the largest are compared.  None
    too where too few segments show the mode, or where no input was measured.
    """
    rows = _backbone(posterior, fit)
    if len(rows) < _MIN_SEGMENTS:
        return None
    columns = _, hz, model_hz = np.array(rows).T
    third = max(2, hz.size // 3)
    low, high = slice(0, third), slice(-third, None)
    difference = hz - model_hz
    # Medians and their scatter, since the frequency is uncertain in a segment in which a strong motion begins or ends.
    (quiet, quiet_std), (loud, loud_std) = (median_with_std(difference[part]) for part in (low, high))
    change, std = loud - quiet, float(np.hypot(quiet_std, loud_std)) + 1e-9
    if abs(change) < _MIN_RELATIVE_CHANGE * hz.mean() or abs(change) < _MIN_CHANGE_STDS * std:
        return None
    ends = [[float(np.median(x[s])) for x in columns] for s in (low, high)]
    (a, f, m), (b, g, n) = ends
    text = (
        f"the first mode {'falls' if g < f else 'rises'} with the level, from {f:.2f} Hz at {1e3 * a:.2g} mm of the top "
        f"floor to {g:.2f} Hz at {1e3 * b:.2g} mm; in the model from {m:.2f} to {n:.2f} Hz"
    )
    return LackOfFit(f"f = {min(hz):.1f}-{max(hz):.1f} Hz, first mode", abs(change) / std, text)


def find_ratio_change(posterior: Posterior, fit: MapEstimate) -> LackOfFit | None:
    """Test if the frequency ratios differ from those of the drawing, or of the baseline where there is one.

    None where the fitted model keeps the ratios, has one mode or no extra effects, or no input was measured.
    """
    if not plan_of(posterior).knows_input or not fit.effects or posterior.context.structure.n_dofs < 2:
        return None
    known = posterior.prior
    at_reference = posterior.layout.with_structure(fit.x, known.mean)
    drawn = posterior.model(at_reference, known.effects(known.mean)).modes().frequencies_hz
    found = posterior.model(fit.x, posterior.effects(fit.x, fit.effects)).modes().frequencies_hz[: drawn.size]
    drawn_ratios, ratios = drawn[1:] / drawn[0], found[1:] / found[0]
    change = ratios / drawn_ratios - 1.0
    std = np.sqrt(np.maximum(_ratio_variance(posterior, fit, ratios), 1e-18)) / drawn_ratios
    if np.max(np.abs(change) / std) < _MIN_CHANGE_STDS or np.abs(change).max() < 5.0 * _MIN_RELATIVE_CHANGE:
        return None
    texts = [" and ".join(f"f{i}/f1 {r:.2f}" for i, r in enumerate(x, start=2)) for x in (ratios, drawn_ratios)]
    where = f"f = {found[0]:.1f}-{found[-1]:.1f} Hz, all modes"
    reference = "baseline" if known.is_baseline else "drawing"
    return LackOfFit(
        where,
        float(np.max(np.abs(change) / std)),
        f"frequency ratios: {texts[0]} explain the response, the {reference} has {texts[1]}",
    )


def _ratio_variance(posterior: Posterior, fit: MapEstimate, ratios: Annotated[Array, "r"]) -> Annotated[Array, "r"]:
    """Compute the variance of the ratios of frequencies, from the second on, to the first, by their slopes."""
    slopes = np.zeros((ratios.size, fit.x.size))
    for i in range(fit.x.size):
        moved, h = fit.x.copy(), 1e-5 * max(1.0, abs(fit.x[i]))
        moved[i] += h
        effects = posterior.effects(moved, with_coordinates(fit.effects, moved[posterior.layout.effects]))
        f = posterior.model(moved, effects).modes().frequencies_hz[: ratios.size + 1]
        slopes[:, i] = (f[1:] / f[0] - ratios) / h
    return np.asarray(np.einsum("ij,jk,ik->i", slopes, fit.covariance, slopes))
