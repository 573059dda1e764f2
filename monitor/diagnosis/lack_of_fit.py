"""Where a recording and a fitted model differ, in bands, over the whole recording and between its halves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array
from monitor.diagnosis.settings import DiagnosisSettings
from monitor.inference import Band, MapEstimate, Posterior, fit_levels, spectra_by_force
from monitor.model import ModelDiscrepancy

_TEST_BAND_HZ = 1.0
"""Width of the frequency bands in which lack of fit is tested. [Hz; judgement]"""
_CORRECTION_BAND_HZ = 0.25
"""Width of the bands in which the model's error is kept. [Hz; judgement]"""
_DAILY_SHARE = 0.1
"""Share of the model's initial error that may differ from day to day. [ratio; judgement]"""
_MAX_CORRECTION = 3.0
"""Ratio of the observed to the predicted spectrum beyond which the model is not corrected but not trusted. [ratio;
judgement]"""
_LENIENT_SHARE = 0.5
"""Where one band shows lack of fit: share of the threshold from which other bands count as doubtful too. [ratio;
judgement]"""


@dataclass(frozen=True, slots=True)
class LackOfFit:
    """Where measured and modelled spectra differ."""

    where: str
    size: float
    """Standard deviations."""
    says: str


def drift_bands(posterior: Posterior, fitted: MapEstimate) -> Array:
    """What the later half of a recording shows more than the earlier one, as `residual_bands`.

    Each half is compared with the model's spectra of its own classes, each at its own level of every force, so that a change of
    level or weather is no drift, nor is wind that comes and goes floor by floor.
    """
    e = posterior.observed
    mean = posterior.mean(fitted.x, fitted.effects)
    x = e.segments.values if mean is None else e.segments.values - mean
    predicted = posterior.scatter(fitted.x, fitted.effects)
    parts = spectra_by_force(posterior, fitted.x, fitted.effects)
    signal = parts.sum(axis=0)
    late = e.t_s > np.median(e.t_s)
    z = []
    for half in (late, ~late):
        model, data, counts = predicted.copy(), predicted.copy(), np.zeros(posterior.n_classes)
        for k, members in enumerate(e.members):
            own = x[members[half[members]]]
            counts[k] = len(own)
            if len(own):
                data[k] = np.einsum("sfa,sfb->fab", own, own.conj()) / len(own)
                noise = predicted[k] - signal[k]
                model[k] = np.tensordot(fit_levels(parts[:, k], noise, data[k]), parts[:, k], axes=1) + noise
        halved = replace(posterior, observed=replace(e, counts=counts))
        z.append(_sum_in_bands(halved.whitened(model, model[None], data)[1], posterior.n_classes, posterior)[0])
    return np.asarray((z[0] - z[1]) / np.sqrt(2.0))


def residual_bands(posterior: Posterior, fitted: MapEstimate) -> tuple[Array, Array]:
    """Misfit in bands as standard deviations, shape (bands, c, c), and the bands' middles in Hz.

    The diagonal is too much (positive) or too little power in the whitened channels, below it the real and above it the
    imaginary part of their coherence.
    """
    return _sum_in_bands(fitted.residual, posterior.n_classes, posterior)


def _sum_in_bands(residual: Array, n_classes: int, posterior: Posterior) -> tuple[Array, Array]:
    """Whitened rows summed in bands."""
    c = posterior.observed.spectra.shape[-1]
    bins = posterior.observed.band.n_bins
    rows = residual.reshape(n_classes, bins, c * c)
    per = _bins_per_band(posterior.observed.band)
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
    return matrix, posterior.observed.band.hz[: n * per].reshape(n, per).mean(axis=1)


def _bins_per_band(band: Band) -> int:
    """Bins that are summed up in a band."""
    return max(1, round(_TEST_BAND_HZ / band.bin_hz))


def _deviations(posterior: Posterior, fitted: MapEstimate) -> tuple[Array, Array, Array]:
    """As `residual_bands`, over the chance in what is compared (a simulation has as much in it as the recording), `drift_bands`,
    and the bands' middles."""
    z, hz = residual_bands(posterior, fitted)
    return z if posterior.offset is None else z / np.sqrt(2.0), drift_bands(posterior, fitted), hz


def find_lack_of_fit(posterior: Posterior, fitted: MapEstimate, settings: DiagnosisSettings) -> tuple[LackOfFit, ...]:
    """Bands in which the model is wrong, worst first."""
    z, drift, hz = _deviations(posterior, fitted)
    late = _list_deviations(drift, hz, posterior, settings, ", more so late in the recording than early")
    return tuple(sorted(_list_deviations(z, hz, posterior, settings, "") + late, key=lambda m: -m.size))


def wrong_bins(posterior: Posterior, fitted: MapEstimate, settings: DiagnosisSettings) -> NDArray[np.bool_]:
    """Which frequencies lie in bands where the model is wrong, shape (n_bins,)."""
    z, drift, _ = _deviations(posterior, fitted)
    wrong = (np.maximum(np.abs(z), np.abs(drift)) > settings.misfit).any(axis=(1, 2))
    bins = np.repeat(wrong, _bins_per_band(posterior.observed.band))
    return np.pad(bins, (0, posterior.observed.band.n_bins - bins.size))


def lack_of_fit_cost(posterior: Posterior, misfit: Sequence[LackOfFit]) -> float:
    """What misfits cost, nats: half the squares of small deviations; of large ones, as of power that is many times the model's,
    the likelihood counts the first power.
    """
    many = np.sqrt(posterior.observed.pieces(_bins_per_band(posterior.observed.band)))
    return float(sum(0.5 * m.size**2 / (1.0 + m.size / many) for m in misfit))


def estimate_model_discrepancy(
    posterior: Posterior, fitted: MapEstimate, settings: DiagnosisSettings
) -> ModelDiscrepancy | None:
    """What healthy data show that the model, with all that is known to be wrong with it, does not explain.

    None where it explains them, and where the ground was measured: there the model's own error is among what is fitted.
    """
    e = posterior.observed
    if e.drive is not None:
        return None
    z, drifts, hz = _deviations(posterior, fitted)
    late = np.abs(drifts).max(axis=(1, 2), initial=0.0)
    size = np.maximum(np.abs(z).max(axis=(1, 2), initial=0.0), late)
    if size.max(initial=0.0) <= settings.misfit:
        return None
    per, bins = _bins_per_band(e.band), max(1, round(_CORRECTION_BAND_HZ / e.band.bin_hz))
    n = hz.size * per // bins
    inverse = np.linalg.inv(np.linalg.cholesky(posterior.scatter(fitted.x, fitted.effects)))
    seen = np.tensordot(e.counts / e.counts.sum(), inverse @ posterior.data() @ inverse.conj().swapaxes(-1, -2), axes=1)
    mean = seen[: n * bins].reshape(n, bins, *seen.shape[1:]).mean(axis=1)
    band = np.arange(n) * bins // per
    doubtful = size[band] > _LENIENT_SHARE * settings.misfit
    drift = np.where(late > settings.misfit, late, 0.0)[band] ** 2
    ratios, vectors = np.linalg.eigh(mean)
    bounded = np.clip(ratios, 1.0 / _MAX_CORRECTION, _MAX_CORRECTION)
    relative = (vectors * (bounded - 1.0)[:, None, :]) @ vectors.conj().swapaxes(-1, -2)
    unsure = (_DAILY_SHARE * np.abs(bounded - 1.0) + np.abs(ratios - bounded)).max(axis=1)
    return ModelDiscrepancy(
        hz=e.band.hz[: n * bins].reshape(n, bins).mean(axis=1),
        relative=relative * doubtful[:, None, None],
        variance=((1.0 + drift) / e.pieces(bins) + unsure**2) * doubtful,
    )


def unexplained_share(
    posterior: Posterior,
    at: MapEstimate,
    null_fit: MapEstimate,
    misfit: Sequence[LackOfFit],
    left_over: Sequence[LackOfFit],
) -> float:
    """What is left over, as a share of what the model without causes got wrong, by squared deviations.

    With the ground measured by their sizes, and all of it told by the final model's error: the one that the model without causes
    has learnt to expect hides most of what it gets wrong.
    """
    if posterior.observed.drive is None:
        return sum(m.size**2 for m in left_over) / max(sum(m.size**2 for m in misfit), 1.0)
    here, there = posterior.predict(at.x, at.effects), posterior.predict(null_fit.x, null_fit.effects)
    residual = posterior.whitened(here.spectra, here.spectra[None][:0], there.data)[1]
    wrong = float(np.abs(_sum_in_bands(residual, posterior.n_classes, posterior)[0]).sum())
    return sum(m.size for m in left_over) / max(wrong, 1.0)


def find_changed_effects(
    posterior: Posterior, fitted: MapEstimate, settings: DiagnosisSettings
) -> tuple[LackOfFit, ...]:
    """Effects that stood at calibration and are of another size now, which a fit's nuisances take up without a word."""
    known, out = posterior.prior, []
    away = known.standing(np.abs(fitted.x[posterior.layout.structure] - known.mean))
    for effect, far, std in zip(known.effects(fitted.x), away, known.standing_std, strict=True):
        own = far / std
        if own.max(initial=0.0) > settings.misfit:
            now = ", ".join(f"{name} {value:.4g}" for name, value in effect.values().items())
            where = f"{effect.name.replace('_', ' ')} of {effect.location}"
            out.append(LackOfFit(where, float(own.max()), f"what stood at calibration is of another size now: {now}"))
    return tuple(out)


def _list_deviations(
    z: Array, hz: Array, posterior: Posterior, settings: DiagnosisSettings, when: str
) -> tuple[LackOfFit, ...]:
    names = [*posterior.context.channels, "ground"]
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
        out.append(LackOfFit(where, abs(size), says + when))
    return tuple(out)
