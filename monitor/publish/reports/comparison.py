"""Comparison of measured and modelled spectra for the report and the viewer, and of the modes at different vibration levels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, ComplexArray, parallel_map
from monitor.diagnosis import Diagnosis, residual_bands
from monitor.inference import Posterior, Segments, class_temperature, maximize_posterior

_RATIO_HZ = 0.25
"""Width of the bands over which ratios are averaged, Hz."""
_FREE, _FIXED = 0.1, 1e-6
"""Prior standard deviations of free stiffnesses and of fixed parameters, where one class is fitted alone."""


@dataclass(frozen=True, eq=False, slots=True)
class Comparison:
    """Power spectra of all channels before and after the causes, and the misfit in bands.

    The measured ground is the last channel where there is one.
    """

    channels: tuple[str, ...]
    hz: Annotated[Array, "bins"]
    measured: Annotated[Array, "c bins"]
    """One-sided, (m/s^2)^2/Hz, mean over the segments; so are all power spectra here."""
    whole_hz: Annotated[Array, "whole"]
    """Frequencies of the whole band, of which `hz` is the judged part."""
    whole_measured: Annotated[Array, "c whole"]
    """Measured spectra in the whole band."""
    before: Annotated[Array, "c bins"]
    """Power spectra of the old model form, refitted."""
    after: Annotated[Array, "c bins"]
    """Power spectra of the model with the causes."""
    ratio_hz: Annotated[Array, "ratios"]
    """Middles of the bands over which ratios are averaged."""
    ratio_before: Annotated[Array, "c ratios"]
    """Measured over modelled power."""
    ratio_after: Annotated[Array, "c ratios"]
    """The same with the causes."""
    chance: float
    """Two relative standard deviations of a ratio by random error."""
    band_hz: Annotated[Array, "bands"]
    """Middles of the misfit's bands."""
    z_before: Annotated[Array, "bands c c"]
    """Standard deviations, see `residual_bands`."""
    z_after: Annotated[Array, "bands c c"]
    """The same with the causes."""
    limit: float
    """Standard deviations from which a band counts as misfit."""
    doubtful_hz: list[list[float]]
    """Bands, by their ends, in which the model contradicted the healthy data, so that their misfit counts less."""
    extended: bool
    """Whether there is a cause, so that before and after differ."""

    @property
    def width_hz(self) -> float:
        """Width of the misfit's bands."""
        return float(np.diff(self.band_hz).mean()) if self.band_hz.size > 1 else float(np.ptp(self.hz))

    def rows(self) -> list[tuple[str, int, int]]:
        """List name and place of every entry of the misfit matrices that is shown, channel by channel."""
        out = []
        for i, name in enumerate(self.channels):
            out.append((f"{name} power", i, i))
            for j in range(i):
                out.append((f"{name}, {self.channels[j]} in phase", i, j))
                out.append((f"{name}, {self.channels[j]} out of phase", j, i))
        return out


@dataclass(frozen=True, eq=False, slots=True)
class LevelDependence:
    """Modes by class of vibration level or temperature: fitted to one class at a time, and as the causes predict."""

    axis: str
    """Quantity in which the classes differ, with its unit."""
    at: Annotated[Array, "k"]
    """Value of this quantity for each class, ascending."""
    frequency_hz: Annotated[Array, "k n"]
    """Measured, as are the damping ratios below."""
    frequency_std: Annotated[Array, "k n"]
    damping: Annotated[Array, "k n"]
    damping_std: Annotated[Array, "k n"]
    model_frequency_hz: Annotated[Array, "k n"]
    """What the model with the causes predicts."""
    model_damping: Annotated[Array, "k n"]


def compare(diagnosis: Diagnosis, segments: Segments) -> Comparison:
    """Compare the spectra of a diagnosis before and after its causes with the measured ones."""
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
    equal_level_segments = level.sum() ** 2 / (level @ level)  # number of segments of equal level with the same scatter
    z_before, band_hz = residual_bands(problem, diagnosis.null_fit)
    # A simulation has as much random error as the recording.
    random_error = 1.0 if problem.offset is None else np.sqrt(0.5)
    return Comparison(
        channels=problem.context.channels,
        hz=e.band.hz,
        measured=measured,
        whole_hz=segments.whole.hz,
        whole_measured=2.0 * segments.power.T,
        before=before,
        after=after,
        ratio_hz=averaged(e.band.hz),
        ratio_before=averaged(measured / before),
        ratio_after=averaged(measured / after),
        chance=float(2.0 / np.sqrt(equal_level_segments * per * e.weight) / random_error),
        band_hz=band_hz,
        z_before=random_error * z_before,
        z_after=random_error * residual_bands(problem, diagnosis.final_fit)[0],
        limit=diagnosis.settings.misfit,
        doubtful_hz=[] if problem.prior.error is None else problem.prior.error.doubtful_hz(),
        extended=bool(diagnosis.final_fit.effects),
    )


def level_dependence(diagnosis: Diagnosis) -> LevelDependence | None:
    """Compute how the modes move with the vibration level or the temperature.

    Every class is fitted alone, with free stiffness and damping.  The spectra that the model predicts for the class are fitted
    in the same way.  None where no cause of the structure makes the modes move, or where there is one class only.
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
    f, f_std, d, d_std = _fit_classes(problem, problem.observed.spectra, diagnosis.null_fit.x, order)
    model_f, _, model_d, _ = _fit_classes(problem, spectra, diagnosis.null_fit.x, order)
    axis = "temperature of the class, °C" if by_temperature else "vibration level of the class: RMS acceleration, m/s²"
    return LevelDependence(axis, at[order], f, f_std, d, d_std, model_f, model_d)


def _fit_classes(
    problem: Posterior, spectra: ComplexArray, x: Array, classes: NDArray[np.intp]
) -> list[Annotated[Array, "classes n"]]:
    """Fit the old model form to several classes; results as of `_fit_class`."""
    fitted = parallel_map(lambda k: _fit_class(problem, spectra[k], x, k), classes)
    return [np.array(column) for column in zip(*fitted, strict=True)]


def _fit_class(
    problem: Posterior, spectra: Annotated[ComplexArray, "bins c c"], x: Annotated[Array, "p"], k: int
) -> tuple[Annotated[Array, "n"], ...]:
    """Fit the old model form to class k from `x` on; return frequencies (Hz) and damping ratios, each with its deviations."""
    e, reference = problem.observed, problem.prior
    single_class = replace(
        e, spectra=spectra[None], counts=e.counts[k : k + 1], rms=e.rms[k : k + 1], members=e.members[k : k + 1]
    )
    layout = problem.layout
    std = np.full(reference.mean.size, _FIXED)
    std[layout.stiffness] = _FREE
    std[layout.damping] = std[layout.channel_noise] = 1.0
    one = replace(
        problem,
        observed=single_class,
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
