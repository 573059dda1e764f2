"""What a measured ground tells of a frame in plain terms: its modes' ratios, and how its first mode follows the level."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from monitor.core import Array, ComplexArray
from monitor.diagnosis.lack_of_fit import LackOfFit
from monitor.inference import MapEstimate, Posterior, with_coordinates

_FIRST_MODE_BAND = 0.6, 1.6
"""Band in which the first mode's equation of motion is fitted, over the first frequency. [ratio; judgement]"""
_MAX_LEFT_POWER = 0.1
"""Largest share of a segment's power near the mode that its equation of motion may leave unexplained. [ratio;
judgement]"""
_MIN_SEGMENTS = 6
"""Fewest segments from which a dependence on amplitude is stated. [segments; judgement]"""
_MEDIAN_STD_FACTOR = 1.4826 * 1.2533
"""Standard deviation of a normal sample's median times the root of the sample's size, over the median absolute
deviation. [1; definition: normal distribution]"""
_MIN_RELATIVE_CHANGE = 0.004
"""Smallest relative change of a frequency or damping ratio that is reported. [ratio; judgement]"""
_MIN_CHANGE_STDS = 6.0
"""Smallest such change in standard deviations. [standard deviations; judgement]"""


@dataclass(frozen=True, eq=False, slots=True)
class Backbone:
    """The first frequency of every segment that shows it clearly, by the level of its motion."""

    amplitude_m: Array
    """Peak displacement of the top floor in the first mode relative to the ground, sqrt(2) x RMS, shape (n,), ascending."""
    hz: Array
    """Measured, shape (n,)."""
    model_hz: Array
    """The same of the model's response, shape (n,)."""


def backbone(posterior: Posterior, fit: MapEstimate) -> Backbone | None:
    """Frequency of the first mode in every segment; None where too few show it, or no ground was measured.

    In each, ``y + 2 zeta w y' + w^2 y = -gamma g`` is solved by least squares in the frequency domain for the floors' motion
    relative to the ground in the first mode.
    """
    e, mean = posterior.observed, posterior.mean(fit.x, fit.effects)
    if e.drive is None or mean is None:
        return None
    effects = (*posterior.prior.effects(fit.x), *fit.effects)
    mass, shape = posterior.system(fit.x, effects).mass, posterior.model(fit.x, effects).modes().shapes[:, 0].real
    first = float(posterior.model(fit.x, effects).modes().frequencies_hz[0])
    sensors = posterior.context.sensors
    # Channels to the first mode's coordinate, which is the top floor's motion in it.
    to_mode = np.linalg.pinv(sensors).T @ mass @ shape * shape[0]
    near = (e.band.hz > _FIRST_MODE_BAND[0] * first) & (e.band.hz < _FIRST_MODE_BAND[1] * first)
    ground, w = e.drive.ground(e.band)[:, near], 2.0 * np.pi * e.band.hz[near]
    steady = to_mode @ sensors.sum(axis=1)
    rows = []
    for measured, predicted, g in zip(e.segments.values[:, near], mean[:, near], ground, strict=True):
        hz, amplitude, left = _fit_oscillator(measured @ to_mode - steady * g, g, w)
        model_hz, _, model_left = _fit_oscillator(predicted @ to_mode - steady * g, g, w)
        if max(left, model_left) < _MAX_LEFT_POWER:
            rows.append((amplitude * np.sqrt(2.0 * e.band.bin_hz), hz, model_hz))
    if len(rows) < _MIN_SEGMENTS:
        return None
    columns = np.array(sorted(rows)).T
    return Backbone(*columns)


def _fit_oscillator(y: ComplexArray, ground: ComplexArray, w: Array) -> tuple[float, float, float]:
    """Frequency, root of the summed power of the displacement, and the share of power left over."""
    a = np.column_stack([y / -(w**2), y / (1j * w), ground])
    split, target = np.concatenate([a.real, a.imag]), -np.concatenate([y.real, y.imag])
    x, *_ = np.linalg.lstsq(split, target, rcond=None)
    omega = float(np.sqrt(max(x[0], 0.0)))
    left = float(((split @ x - target) ** 2).sum() / (target**2).sum())
    size = float(np.sqrt(2.0 * (np.abs(y / w**2) ** 2).sum()))
    return omega / (2.0 * np.pi), size, left


def find_level_dependence(found: Backbone | None) -> LackOfFit | None:
    """How the first mode follows the level; None where it does no more than the model's."""
    if found is None:
        return None
    third = max(2, found.hz.size // 3)
    low, high = slice(0, third), slice(-third, None)
    apart = found.hz - found.model_hz
    change = float(np.median(apart[high]) - np.median(apart[low]))
    # Medians and their scatter: a segment in which a strong motion begins or ends tells its frequency badly.
    std = float(
        np.hypot(*[_MEDIAN_STD_FACTOR * np.median(np.abs(x - np.median(x))) for x in (apart[low], apart[high])])
    )
    std = std / np.sqrt(third) + 1e-9
    if abs(change) < _MIN_RELATIVE_CHANGE * found.hz.mean() or abs(change) < _MIN_CHANGE_STDS * std:
        return None
    ends = [[float(np.median(x[s])) for x in (found.amplitude_m, found.hz, found.model_hz)] for s in (low, high)]
    (a, f, m), (b, g, n) = ends
    says = (
        f"the first mode {'falls' if g < f else 'rises'} with the level, from {f:.2f} Hz at {1e3 * a:.2g} mm of the top "
        f"floor to {g:.2f} Hz at {1e3 * b:.2g} mm; in the model from {m:.2f} to {n:.2f} Hz"
    )
    return LackOfFit(f"f = {min(found.hz):.1f}-{max(found.hz):.1f} Hz, first mode", abs(change) / std, says)


def find_ratio_change(posterior: Posterior, fit: MapEstimate) -> LackOfFit | None:
    """Frequency ratios that the drawing does not have; None where the fitted model keeps them, or no ground was measured."""
    if posterior.observed.drive is None or not fit.effects:
        return None
    drawn = posterior.prior.model.modes().frequencies_hz
    found = posterior.model(fit.x, (*posterior.prior.effects(fit.x), *fit.effects)).modes().frequencies_hz[: drawn.size]
    had, has = drawn[1:] / drawn[0], found[1:] / found[0]
    apart = has / had - 1.0
    std = np.sqrt(np.maximum(_ratio_variance(posterior, fit, has), 1e-18)) / had
    if np.max(np.abs(apart) / std) < _MIN_CHANGE_STDS or np.abs(apart).max() < 5.0 * _MIN_RELATIVE_CHANGE:
        return None
    told = [" and ".join(f"f{i}/f1 {r:.2f}" for i, r in enumerate(x, start=2)) for x in (has, had)]
    where = f"f = {found[0]:.1f}-{found[-1]:.1f} Hz, all modes"
    return LackOfFit(
        where,
        float(np.max(np.abs(apart) / std)),
        f"frequency ratios: {told[0]} explain the response, the drawing has {told[1]}",
    )


def _ratio_variance(posterior: Posterior, fit: MapEstimate, here: Array) -> Array:
    """Variance of the frequency ratios, by their slopes."""
    slopes = np.zeros((here.size, fit.x.size))
    for i in range(fit.x.size):
        moved, h = fit.x.copy(), 1e-5 * max(1.0, abs(fit.x[i]))
        moved[i] += h
        effects = (*posterior.prior.effects(moved), *with_coordinates(fit.effects, moved[posterior.layout.effects]))
        f = posterior.model(moved, effects).modes().frequencies_hz[: here.size + 1]
        slopes[:, i] = (f[1:] / f[0] - here) / h
    return np.asarray(np.einsum("ij,jk,ik->i", slopes, fit.covariance, slopes))
