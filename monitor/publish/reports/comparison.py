"""Measured against modelled, as the report and the viewer show it: spectra, where they differ, what depends on the level."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, ComplexArray, parallel_map
from monitor.diagnosis import Diagnosis, residual_bands
from monitor.inference import Posterior, Segments, class_temperature, maximize_posterior

_RATIO_HZ = 0.25
_FREE, _FIXED = 0.1, 1e-6
"""Standard deviations of what a class alone may move."""


@dataclass(frozen=True, eq=False, slots=True)
class Comparison:
    """Power spectra of all channels, the measured ground's last where there is one, and the misfit in bands."""

    channels: tuple[str, ...]
    hz: Array
    """Shape (n_bins,)."""
    measured: Array
    """Shape (c, n_bins), one-sided, (m/s^2)^2/Hz, mean over the segments."""
    before: Array
    """The old model form, refitted."""
    after: Array
    """With the causes."""
    ratio_hz: Array
    """Middles of the bands over which ratios are averaged, shape (b,)."""
    ratio_before: Array
    """Measured over modelled, shape (c, b)."""
    ratio_after: Array
    chance: float
    """Two relative standard deviations that chance gives a ratio."""
    band_hz: Array
    """Middles of the misfit's bands, shape (n_bands,)."""
    z_before: Array
    """Standard deviations, shape (n_bands, c, c), see `residual_bands`."""
    z_after: Array
    limit: float
    """Standard deviations from which a band counts as misfit."""
    doubtful_hz: list[list[float]]
    """Where the model contradicted healthy data, so that what is seen counts less."""
    extended: bool
    """Whether there is a cause, so that before and after differ."""

    @property
    def width_hz(self) -> float:
        """Of the misfit's bands."""
        return float(np.diff(self.band_hz).mean()) if self.band_hz.size > 1 else float(np.ptp(self.hz))

    def rows(self) -> list[tuple[str, int, int]]:
        """Name and place of every entry of the misfit matrices that is shown, channel by channel."""
        out = []
        for i, name in enumerate(self.channels):
            out.append((f"{name} power", i, i))
            for j in range(i):
                out.append((f"{name}, {self.channels[j]} in phase", i, j))
                out.append((f"{name}, {self.channels[j]} out of phase", j, i))
        return out


@dataclass(frozen=True, eq=False, slots=True)
class LevelDependence:
    """Modes by class of vibration level or temperature: measured one class at a time, and as the causes predict."""

    axis: str
    """What the classes differ in."""
    at: Array
    """Shape (k,)."""
    frequency_hz: Array
    """Shape (k, n)."""
    frequency_std: Array
    damping: Array
    """Shape (k, n)."""
    damping_std: Array
    model_frequency_hz: Array
    model_damping: Array


def compare(diagnosis: Diagnosis, segments: Segments) -> Comparison:
    """The diagnosis's spectra and misfit; `segments` are what it judged."""
    problem, e = diagnosis.posterior, diagnosis.posterior.observed
    share = e.counts / e.counts.sum()

    def power(spectra: ComplexArray) -> Array:
        return np.asarray(2.0 * np.einsum("k,kfaa->af", share, spectra).real)

    measured = power(e.spectra)
    before = power(replace(problem, offset=None).spectra(diagnosis.null_fit.x, diagnosis.null_fit.effects))
    after = power(problem.spectra(diagnosis.final_fit.x, diagnosis.final_fit.effects))
    per = max(1, round(_RATIO_HZ / e.band.bin_hz))
    n = e.band.n_bins // per * per

    def averaged(values: Array) -> Array:
        return np.asarray(values[..., :n].reshape(*values.shape[:-1], -1, per).mean(axis=-1))

    level = np.einsum("sfa,af->s", np.abs(segments.values) ** 2, 1.0 / measured[: segments.values.shape[2]])
    alike = level.sum() ** 2 / (level @ level)  # segments of one level that would scatter as these do
    z_before, band_hz = residual_bands(problem, diagnosis.null_fit)
    chance = 1.0 if problem.offset is None else np.sqrt(0.5)  # a simulation has as much chance in it as the recording
    return Comparison(
        channels=problem.context.channels,
        hz=e.band.hz,
        measured=measured,
        before=before,
        after=after,
        ratio_hz=averaged(e.band.hz),
        ratio_before=averaged(measured / before),
        ratio_after=averaged(measured / after),
        chance=float(2.0 / np.sqrt(alike * per * e.weight) / chance),
        band_hz=band_hz,
        z_before=chance * z_before,
        z_after=chance * residual_bands(problem, diagnosis.final_fit)[0],
        limit=diagnosis.settings.misfit,
        doubtful_hz=[] if problem.error is None else problem.error.doubtful_hz(),
        extended=bool(diagnosis.final_fit.effects),
    )


def level_dependence(diagnosis: Diagnosis) -> LevelDependence | None:
    """How the modes move with the level (the temperature); None where no cause of the structure makes them.

    Every class is fitted alone, its stiffness and damping free; so are the spectra that the model predicts for it.
    """
    problem, final = diagnosis.posterior, diagnosis.final_fit
    moving = [e for e in final.effects if e.conditional and e.family == "structure"]
    if not moving or problem.n_classes < 2:
        return None
    lags = [e.temperature_lag_s for e in moving if e.temperature_lag_s is not None]
    degc = [class_temperature(problem.observed, k, lags[0] if lags else 0.0) for k in range(problem.n_classes)]
    by_temperature = bool(lags) and None not in degc
    rms = np.sqrt((problem.observed.rms**2).mean(axis=1))
    at = np.array(degc, dtype=float) if by_temperature else rms
    order = np.argsort(at)
    spectra = problem.spectra(final.x, final.effects)
    f, f_std, d, d_std = _equivalents(problem, problem.observed.spectra, diagnosis.null_fit.x, order)
    model_f, _, model_d, _ = _equivalents(problem, spectra, diagnosis.null_fit.x, order)
    axis = "temperature of the class, °C" if by_temperature else "vibration level of the class: RMS acceleration, m/s²"
    return LevelDependence(axis, at[order], f, f_std, d, d_std, model_f, model_d)


def _equivalents(problem: Posterior, spectra: ComplexArray, x: Array, classes: NDArray[np.intp]) -> list[Array]:
    """As `_equivalent`, of several classes: shape (classes, n) each."""
    fitted = parallel_map(lambda k: _equivalent(problem, spectra[k], x, k), classes)
    return [np.array(column) for column in zip(*fitted, strict=True)]


def _equivalent(problem: Posterior, spectra: ComplexArray, x: Array, k: int) -> tuple[Array, Array, Array, Array]:
    """Frequencies, their standard deviations, damping ratios and theirs: the old model form fitted to class k's spectra."""
    e, reference = problem.observed, problem.prior
    alone = replace(
        e,
        spectra=spectra[None],
        counts=e.counts[k : k + 1],
        rms=e.rms[k : k + 1],
        members=e.members[k : k + 1],
    )
    layout = problem.layout
    std = np.full(reference.mean.size, _FIXED)
    std[layout.stiffness] = _FREE
    std[layout.damping] = std[layout.channel_noise] = 1.0
    one = replace(
        problem,
        observed=alone,
        prior=replace(reference, mean=x[layout.structure], precision=np.diag(std**-2.0)),
        conditions=problem.conditions[k : k + 1],
        offset=None,
    )
    force = x[layout.forces] + x[layout.levels][k]
    fitted = maximize_posterior(one, np.concatenate([x[layout.structure], force, [0.0, x[layout.noise]]]))

    def frequencies(x: Array) -> Array:
        return one.model(x, reference.effects(x)).modes().frequencies_hz

    f = frequencies(fitted.x)
    steps = 1e-5 * np.eye(fitted.x.size)[layout.stiffness]
    slopes = np.array([(frequencies(fitted.x + h) - f) / 1e-5 for h in steps])
    f_std = np.sqrt(np.einsum("in,ij,jn->n", slopes, fitted.covariance[layout.stiffness, layout.stiffness], slopes))
    d = np.exp(fitted.x[layout.damping])
    return f, f_std, d, d * np.sqrt(np.diag(fitted.covariance)[layout.damping])
