"""Where a recording and a fitted model differ, in bands, over the whole recording and between its halves."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from monitor.diagnosis_settings import DiagnosisSettings
from monitor.fitting import Fit
from monitor.likelihood import Problem
from monitor.results import Array, ComplexArray

_NONE = -100.0
"""Logarithm of a force's or of noise's density that is none."""
_APART = 1e-6
"""How different what forces make must be for each to have a level of its own."""
_LEVELLINGS = 4
"""Fisher scoring's steps to a level; from nearby it converges in two."""


@dataclass(frozen=True, slots=True)
class Misfit:
    """Where measured and modelled spectra differ."""

    where: str
    size: float
    """Standard deviations."""
    says: str


def drift_bands(problem: Problem, fitted: Fit, width_hz: float = 1.0) -> Array:
    """What the later half of a recording shows more than the earlier one, as `residual_bands`.

    Each half is compared with the model's spectra of its own classes, each at its own level of every force, so that a change of
    level or weather is no drift, nor is wind that comes and goes floor by floor.
    """
    e = problem.evidence
    mean = problem.mean(fitted.x, fitted.effects)
    x = e.segments.values if mean is None else e.segments.values - mean
    predicted = problem.scatter(fitted.x, fitted.effects)
    parts = _by_force(problem, fitted)
    signal = parts.sum(axis=0)
    late = e.t_s > np.median(e.t_s)
    z = []
    for half in (late, ~late):
        model, data, counts = predicted.copy(), predicted.copy(), np.zeros(problem.n_classes)
        for k, members in enumerate(e.members):
            own = x[members[half[members]]]
            counts[k] = len(own)
            if len(own):
                data[k] = np.einsum("sfa,sfb->fab", own, own.conj()) / len(own)
                model[k] = _levelled(parts[:, k], predicted[k] - signal[k], data[k])
        halved = replace(problem, evidence=replace(e, counts=counts))
        z.append(_banded(halved.whitened(model, model[None], data)[1], problem.n_classes, problem, width_hz)[0])
    return np.asarray((z[0] - z[1]) / np.sqrt(2.0))


def _by_force(problem: Problem, fitted: Fit) -> ComplexArray:
    """What each force makes of the spectra without noise, shape (n, classes, n_bins, c, c); what none makes alone is shared."""
    p, n = problem.reference.mean.size, problem.context.structure.n_dofs
    still = fitted.x.copy()
    still[problem.n_nuisance - 1] = _NONE
    signal, linear = problem.scatter(still, fitted.effects), replace(problem, offset=None)
    forces = still[p : p + n].copy()
    still[p : p + n] = _NONE
    alone = []
    for j in range(n):
        one = still.copy()
        one[p + j] = forces[j]
        alone.append(linear.scatter(one, fitted.effects) - linear.scatter(still, fitted.effects))
    parts = np.stack(alone)
    return np.asarray(parts + (signal - parts.sum(axis=0)) / n)


def _levelled(parts: ComplexArray, noise: ComplexArray, data: ComplexArray) -> ComplexArray:
    """The model of spectra, shape (n_bins, c, c), at the levels of its parts that fit them best; the noise has its own."""
    level = np.ones(len(parts))
    for _ in range(_LEVELLINGS):
        signal = np.tensordot(level, parts, axes=1)
        slopes = np.linalg.inv(signal + noise) @ parts
        rise = np.einsum("jfab,fba->j", slopes @ np.linalg.inv(signal + noise), data - signal - noise).real
        step = np.linalg.lstsq(np.einsum("ifab,jfba->ij", slopes, slopes).real, rise, rcond=_APART)[0]
        level = np.maximum(level + step, 0.1 * level)
    return np.asarray(np.tensordot(level, parts, axes=1) + noise)


def residual_bands(problem: Problem, fitted: Fit, width_hz: float = 1.0) -> tuple[Array, Array]:
    """Misfit in bands as standard deviations, shape (bands, c, c), and the bands' middles in Hz.

    The diagonal is too much (positive) or too little power in the whitened channels, below it the real and above it the
    imaginary part of their coherence.
    """
    return _banded(fitted.residual, problem.n_classes, problem, width_hz)


def _banded(residual: Array, n_classes: int, problem: Problem, width_hz: float) -> tuple[Array, Array]:
    """Whitened rows summed in bands."""
    c = problem.evidence.spectra.shape[-1]
    bins = problem.evidence.band.n_bins
    rows = residual.reshape(n_classes, bins, c * c)
    per = max(1, round(width_hz / problem.evidence.band.bin_hz))
    n = bins // per
    z = rows[:, : n * per].reshape(n_classes, n, per, c * c).sum(axis=(0, 2)) / np.sqrt(n_classes * per)
    matrix = np.zeros((n, c, c))
    at = 0
    for i in range(c):
        for j in range(i):
            matrix[:, i, j], matrix[:, j, i] = z[:, at], z[:, at + 1]
            at += 2
        matrix[:, i, i] = z[:, at]
        at += 1
    return matrix, problem.evidence.band.hz[: n * per].reshape(n, per).mean(axis=1)


def misfits(problem: Problem, fitted: Fit, settings: DiagnosisSettings) -> tuple[Misfit, ...]:
    """Bands in which the model is wrong, worst first."""
    z, hz = residual_bands(problem, fitted)
    if problem.offset is not None:
        z = z / np.sqrt(2.0)  # the simulation has as much chance in it as the recording
    late = _listed(drift_bands(problem, fitted), hz, problem, settings, ", more so late in the recording than early")
    return tuple(sorted(_listed(z, hz, problem, settings, "") + late, key=lambda m: -m.size))


def _listed(z: Array, hz: Array, problem: Problem, settings: DiagnosisSettings, when: str) -> tuple[Misfit, ...]:
    names = [*problem.context.channels, "ground"]
    out = []
    for band, i, j in np.argwhere(np.abs(z) > settings.misfit):
        size = float(z[band, i, j])
        where = f"f = {hz[band] - 0.5:.1f}-{hz[band] + 0.5:.1f} Hz, "
        if i == j:
            says = f"{'more' if size > 0 else 'less'} power than the model has, given the channels before it"
            where += f"channel {names[i]}"
        else:
            says = f"the {'real' if i > j else 'imaginary'} part of their coherence is not the model's"
            where += f"channels {names[i]} and {names[j]}"
        out.append(Misfit(where, abs(size), says + when))
    return tuple(out)
