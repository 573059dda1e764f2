"""Lack of fit of a model in frequency bands, over the whole recording and between its halves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array
from monitor.diagnosis.plan import plan_of
from monitor.diagnosis.settings import DiagnosisSettings
from monitor.inference import (
    FORCE_STD,
    Band,
    MapEstimate,
    Posterior,
    Prediction,
    fit_levels,
    spectra_by_force,
    unpacked,
)
from monitor.model import ModelDiscrepancy
from monitor.signals import overlap_correlation

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


Misfit = Annotated[Array, "bands c c"]
Bands = Annotated[Array, "bands"]


@dataclass(frozen=True, slots=True)
class LackOfFit:
    """Difference between measured and modelled spectra at one place."""

    where: str
    """Band and channels in words, or the effect that changed."""
    size: float
    """Standard deviations."""
    says: str
    changes: bool = False
    """Whether the difference changes within the recording."""
    is_explained: bool = False
    """Whether its cause is known, though no effect of the catalogue describes it."""
    hides_structure: bool = False
    """Whether nothing can be said of the structure beside it."""


def drift_bands(posterior: Posterior, fitted: MapEstimate) -> Misfit:
    """Compute how much more misfit the later half of a recording shows than the earlier half.

    Each half is compared with the model's spectra of its own classes, and every force has its own level in each half.  So a
    change of level or of the weather is no drift, nor is wind that comes and goes floor by floor.  Results as of
    `residual_bands`.
    """
    e = posterior.observed
    prediction = posterior.predict(fitted.x, fitted.effects)
    predicted, x = prediction.spectra, e.segments.values if prediction.left is None else prediction.left
    parts = spectra_by_force(posterior, fitted.x, fitted.effects)
    signal = parts.sum(axis=0)
    late = e.segments.t_s > np.median(e.segments.t_s)
    z = []
    for half in (late, ~late):
        model, data, counts = predicted.copy(), predicted.copy(), np.zeros(posterior.n_classes)
        for k, members in enumerate(e.members):
            own_segments = x[members[half[members]]]
            counts[k] = len(own_segments)
            if len(own_segments):
                data[k] = np.einsum("sfa,sfb->fab", own_segments, own_segments.conj()) / len(own_segments)
                noise = predicted[k] - signal[k]
                model[k] = np.tensordot(fit_levels(parts[:, k], noise, data[k]), parts[:, k], axes=1) + noise
        halved = replace(posterior, observed=replace(e, counts=counts))
        z.append(_sum_in_bands(halved.whitened(model, model[None], data)[1], posterior.n_classes, posterior)[0])
    return np.asarray((z[0] - z[1]) / np.sqrt(2.0) / _scatter_between_segments(posterior, prediction))


def residual_bands(posterior: Posterior, fitted: MapEstimate) -> tuple[Misfit, Bands]:
    """Compute the misfit in bands, in standard deviations, and the middles of the bands, Hz.

    The diagonal is too much (positive) or too little power in the whitened channels; below the diagonal is the real and above it
    the imaginary part of their coherence.  Beside a measured ground the unit is their scatter between segments.
    """
    z, hz = _sum_in_bands(fitted.residual, posterior.n_classes, posterior)
    return z / _scatter_between_segments(posterior, posterior.predict(fitted.x, fitted.effects)), hz


def _sum_in_bands(residual: Annotated[Array, "rows"], n_classes: int, posterior: Posterior) -> tuple[Misfit, Bands]:
    """Sum the rows of a whitened residual in bands; results as of `residual_bands`."""
    c = posterior.observed.spectra.shape[-1]
    bins = posterior.observed.band.n_bins
    rows = residual.reshape(n_classes, bins, c * c)
    per = _bins_per_band(posterior.observed.band)
    n = bins // per
    z = rows[:, : n * per].reshape(n_classes, n, per, c * c).sum(axis=(0, 2)) / np.sqrt(n_classes * per)
    matrix = unpacked(z.T)
    return np.tril(matrix.real) - np.triu(matrix.imag), posterior.observed.band.hz[: n * per].reshape(n, per).mean(
        axis=1
    )


def _bins_per_band(band: Band) -> int:
    return max(1, round(_TEST_BAND_HZ / band.bin_hz))


def _deviations(posterior: Posterior, fitted: MapEstimate) -> tuple[Misfit, Misfit, Bands]:
    """Compute `residual_bands` in units of the random error of the comparison, `drift_bands`, and the bands' middles.

    A simulation has as much random error as the recording.
    """
    z, hz = residual_bands(posterior, fitted)
    return z if posterior.offset is None else z / np.sqrt(2.0), drift_bands(posterior, fitted), hz


def _scatter_between_segments(posterior: Posterior, prediction: Prediction) -> Array:
    """Compute by how much the misfit scatters more between segments than that of a stationary process, in every band.

    The model's error about the response to an earthquake is not stationary: a few strong segments cause most of it, so a band has
    fewer independent pieces of information than segments (overdispersion; P. McCullagh, J. A. Nelder, Generalized Linear Models
    (1989), section 4.5).  Return ratios of standard deviations, at least 1; a single 1 without measured ground.
    """
    if prediction.left is None:
        return np.ones(1)
    e, x, own = posterior.observed, prediction.left, []
    for k, members in enumerate(e.members):
        of_class = replace(posterior, observed=replace(e, counts=e.counts[k : k + 1]))
        model = prediction.spectra[k : k + 1]
        for segment in x[members]:
            products = (segment[:, :, None] * segment[:, None, :].conj())[None]
            rows = of_class.whitened(model, model[None][:0], products)[1]
            own.append(_sum_in_bands(rows, 1, posterior)[0] / np.sqrt(e.counts[k]))
    return np.asarray(np.maximum(np.std(own, axis=0, ddof=1) * np.sqrt(1.0 + 2.0 * overlap_correlation()), 1.0))


def find_lack_of_fit(posterior: Posterior, fitted: MapEstimate, settings: DiagnosisSettings) -> tuple[LackOfFit, ...]:
    """List the bands in which the model is wrong, worst first."""
    z, drift, hz = _deviations(posterior, fitted)
    late = _list_deviations(drift, hz, posterior, settings, changes=True)
    return tuple(sorted(_list_deviations(z, hz, posterior, settings) + late, key=lambda m: -m.size))


def wrong_bins(
    posterior: Posterior, fitted: MapEstimate, settings: DiagnosisSettings
) -> Annotated[NDArray[np.bool_], "bins"]:
    """Select the frequency bins that lie in bands where the model is wrong."""
    z, drift, _ = _deviations(posterior, fitted)
    wrong = (np.maximum(np.abs(z), np.abs(drift)) > settings.misfit).any(axis=(1, 2))
    bins = np.repeat(wrong, _bins_per_band(posterior.observed.band))
    return np.pad(bins, (0, posterior.observed.band.n_bins - bins.size))


def lack_of_fit_cost(posterior: Posterior, misfit: Sequence[LackOfFit]) -> float:
    """Compute what the lack of fit costs in log likelihood, nats.

    The cost of a small deviation is half its square.  Of a large one, as of power that is many times the model's, the likelihood
    counts the first power only.
    """
    many = np.sqrt(posterior.observed.pieces(_bins_per_band(posterior.observed.band)))
    return float(sum(0.5 * m.size**2 / (1.0 + m.size / many) for m in misfit))


def estimate_model_discrepancy(
    posterior: Posterior, fitted: MapEstimate, settings: DiagnosisSettings
) -> ModelDiscrepancy | None:
    """Estimate the lack of fit to healthy data that remains with all known effects; None where the model explains the data."""
    e = posterior.observed
    z, drifts, hz = _deviations(posterior, fitted)
    late = np.abs(drifts).max(axis=(1, 2), initial=0.0)
    size = np.maximum(np.abs(z).max(axis=(1, 2), initial=0.0), late)
    if size.max(initial=0.0) <= settings.misfit:
        return None
    per, bins = _bins_per_band(posterior.observed.band), max(1, round(_CORRECTION_BAND_HZ / e.band.bin_hz))
    n = hz.size * per // bins
    prediction = posterior.predict(fitted.x, fitted.effects)
    inverse = np.linalg.inv(np.linalg.cholesky(prediction.spectra))
    whitened = np.tensordot(
        e.counts / e.counts.sum(), inverse @ prediction.data @ inverse.conj().swapaxes(-1, -2), axes=1
    )
    mean = whitened[: n * bins].reshape(n, bins, *whitened.shape[1:]).mean(axis=1)
    band = np.arange(n) * bins // per
    doubtful = size[band] > _LENIENT_SHARE * settings.misfit
    own = np.broadcast_to(_scatter_between_segments(posterior, prediction), z.shape)
    # Of the healthy recording's error and of the next one's.
    dispersion = 2.0 * np.einsum("baa->b", own**2)[band] / z.shape[1] - 1.0
    doubtful |= dispersion > 1.0
    drift = np.where(late > settings.misfit, late, 0.0)[band] ** 2
    ratios, vectors = np.linalg.eigh(mean)
    bounded = np.clip(ratios, 1.0 / _MAX_CORRECTION, _MAX_CORRECTION)
    relative = (vectors * (bounded - 1.0)[:, None, :]) @ vectors.conj().swapaxes(-1, -2)
    uncertainty = (_DAILY_SHARE * np.abs(bounded - 1.0) + np.abs(ratios - bounded)).max(axis=1)
    return ModelDiscrepancy(
        hz=e.band.hz[: n * bins].reshape(n, bins).mean(axis=1),
        relative=relative * doubtful[:, None, None],
        variance=((dispersion + drift) / e.pieces(bins) + uncertainty**2) * doubtful,
    )


def unexplained_share(
    posterior: Posterior,
    at: MapEstimate,
    null_fit: MapEstimate,
    misfit: Sequence[LackOfFit],
    left_over: Sequence[LackOfFit],
) -> float:
    """Compute the share of the lack of fit without causes (`misfit`) that remains with the causes of a fit (`left_over`).

    Without measured ground motion the squared deviations are compared.  With it the deviations themselves are compared, all in
    units of the final model's error: the error that the model without causes was fitted with hides most of its lack of fit.
    """
    if not plan_of(posterior).knows_input:
        return sum(m.size**2 for m in left_over) / max(sum(m.size**2 for m in misfit), 1.0)
    prediction, null_prediction = posterior.predict(at.x, at.effects), posterior.predict(null_fit.x, null_fit.effects)
    residual = posterior.whitened(prediction.spectra, prediction.spectra[None][:0], null_prediction.data)[1]
    z = _sum_in_bands(residual, posterior.n_classes, posterior)[0]
    wrong = float(np.abs(z / _scatter_between_segments(posterior, prediction)).sum())
    return sum(m.size for m in left_over) / max(wrong, 1.0)


def find_changed_effects(
    posterior: Posterior, fitted: MapEstimate, settings: DiagnosisSettings
) -> tuple[LackOfFit, ...]:
    """List the persistent effects whose size differs from calibration.

    A fit's nuisances include these sizes, so such a change would leave no lack of fit.  Of a mode that the model lacks the
    frequency and the damping are compared: its shape and its coupling follow the direction of the forces.
    """
    known, out = posterior.prior, []
    change = known.persistent_parts(np.abs(fitted.x[posterior.layout.structure] - known.mean))
    for effect, far, std in zip(known.effects(fitted.x), change, known.standing_std, strict=True):
        deviations = (far / std)[: len(type(effect).parameters)]
        if deviations.max(initial=0.0) > settings.misfit:
            now = ", ".join(f"{name} {value:.4g}" for name, value in effect.values().items())
            where = f"{effect.name.replace('_', ' ')} of {effect.location}"
            out.append(
                LackOfFit(where, float(deviations.max()), f"what stood at calibration is of another size now: {now}")
            )
    return tuple(out)


def knows_direction(posterior: Posterior) -> bool:
    """Decide if the forces can tell another direction: calibration knew them, and found modes that the model lacks."""
    has_missing_modes = any(effect.repeatable for effect in posterior.prior.model.effects)
    return posterior.prior.ln_forces is not None and not plan_of(posterior).knows_input and has_missing_modes


def has_coupled_modes(posterior: Posterior) -> bool:
    """Decide if calibration found modes that the model lacks and that are coupled to the floors."""
    return any(effect.is_coupled(posterior.context) for effect in posterior.prior.model.effects)


def find_other_direction(posterior: Posterior, fitted: MapEstimate, settings: DiagnosisSettings) -> LackOfFit | None:
    """Find that the motion comes from another direction than at calibration, see `knows_direction`.

    Where the forces act in a direction that is not measured, the floors follow the modes that the model lacks.  The forces on
    these modes are then no longer independent of each other, as the model takes them to be, and changes of the structure may
    imitate what that does to the spectra.  Coupled modes move the floors, so that the fitted forces on the floors vanish but for
    some; the force on modes that are not coupled grows over that on the floors, on all of them alike.  Where calibration's own
    forces differ from floor to floor as much as that, as forces that stand for a shaken base do, they tell no direction, and
    another recording's need not be the same.  None where the change of the forces costs no more of their prior density, beyond
    what chance makes of it, than a cause must gain.
    """
    known, forces = posterior.prior.ln_forces, fitted.x[posterior.layout.forces]
    if known is None or not knows_direction(posterior) or _is_unlikely(known, known.size - 1, settings):
        return None
    change, growth = forces - forces.mean() - known, _growth_on_missing_modes(posterior, fitted)
    if has_coupled_modes(posterior) and _is_unlikely(change, known.size - 1, settings):
        size, weakest = float(np.sqrt(change @ change)), int(change.argmin())
        percent = 100.0 * np.exp(0.5 * change[weakest])
        factor = f"{percent:.2g} %" if percent >= 0.1 else "less than 0.1 %"
        says = f"the force on floor {weakest + 1} is {factor} of its former share"
    elif growth > 0.0 and _exceeds_chance(0.5 * (growth / FORCE_STD) ** 2, 1, settings):
        size, times = growth, np.exp(0.5 * growth)
        says = (
            f"the force on modes that the model lacks, over that on the floors, is {times:.2g} times its former value"
        )
    else:
        return None
    return _hiding_structure(
        "direction of the forces",
        size / FORCE_STD,
        f"the forces are shared out otherwise than at calibration ({says}): either they come from another direction, or what the "
        "model lacks has changed",
    )


def _hiding_structure(where: str, size: float, says: str) -> LackOfFit:
    """State a lack of fit whose cause is known, and beside which nothing can be said of the structure."""
    says += ": nothing can be said of the structure"
    return LackOfFit(where, size, says, is_explained=True, hides_structure=True)


def _growth_on_missing_modes(posterior: Posterior, fitted: MapEstimate) -> float:
    """Compute how the forces on modes that are not coupled have grown since calibration, over those on the floors.

    The change of the logarithm of their density, the mean of the modes; 0 where there are none.
    """
    known, context = posterior.prior, posterior.context
    shapes = ([m.shape for e in known.effects(x) for m in e.extra_modes(context)] for x in (known.mean, fitted.x))
    then, now = (np.array([np.linalg.norm(shape) for shape in own]) for own in shapes)
    tiny = np.finfo(float).tiny
    return 2.0 * float(np.log(np.maximum(now, tiny) / np.maximum(then, tiny)).mean()) if then.size else 0.0


def _is_unlikely(ln_change: Array, n_free: int, settings: DiagnosisSettings) -> bool:
    """Decide if a change of the logarithms of forces costs more of their prior density than chance and a cause's margin."""
    return _exceeds_chance(0.5 * float(ln_change @ ln_change) / FORCE_STD**2, n_free, settings)


def _exceeds_chance(cost: float, n_free: int, settings: DiagnosisSettings) -> bool:
    """Decide if what `n_free` independent deviations cost of their prior density, nats, exceeds chance and a cause's margin."""
    return cost > settings.margin + 0.5 * n_free  # by chance each costs half a nat in the mean


def find_other_structure(posterior: Posterior, fitted: MapEstimate, settings: DiagnosisSettings) -> LackOfFit | None:
    """Find that a fit from the structure file alone has led to another structure than that of the file.

    Where the motion is not that of the model, as under forces that act across the measured direction, stiffnesses and masses
    follow it.  None where the distance from the file costs no more prior density, beyond what chance makes of it, than a cause
    must gain; with a baseline; and where an input was measured, whose response separates stiffnesses from all else.
    """
    if posterior.prior.is_baseline or plan_of(posterior).knows_input:
        return None
    layout, known = posterior.layout, posterior.prior
    these = np.r_[layout.stiffness, layout.masses]
    away = fitted.x[these] - known.mean[these]
    cost = 0.5 * float(away @ known.precision[np.ix_(these, these)] @ away)
    if not _exceeds_chance(cost, these.size, settings):
        return None
    stiffness = away[: layout.stiffness.stop - layout.stiffness.start]
    farthest = int(np.abs(stiffness).argmax())
    return _hiding_structure(
        "structure of the file",
        float(np.sqrt(2.0 * cost)),
        f"no structure near that of the file explains the recording (fitted, story {farthest + 1} has "
        f"{100.0 * np.exp(stiffness[farthest]):.2g} % of the file's stiffness)",
    )


def _list_deviations(
    z: Misfit, hz: Bands, posterior: Posterior, settings: DiagnosisSettings, *, changes: bool = False
) -> tuple[LackOfFit, ...]:
    """Describe every entry of `z` that exceeds the threshold; `changes` as in `LackOfFit`."""
    when = ", more so late in the recording than early" if changes else ""
    names = posterior.context.channels
    out = []
    for band, i, j in np.argwhere(np.abs(z) > settings.misfit):
        size = float(z[band, i, j])
        where = f"f = {hz[band] - 0.5:.1f}-{hz[band] + 0.5:.1f} Hz, "
        if i == j:
            says = f"{'more' if size > 0 else 'less'} power than the model has, given the channels before it"
            where += f"channel {names[i]}"
        else:
            phase, part = ("in phase", "real") if i > j else ("out of phase", "imaginary")
            says = f"they move together {phase} otherwise than in the model ({part} part of the coherence)"
            where += f"channels {names[i]} and {names[j]}"
        out.append(LackOfFit(where, abs(size), says + when, changes))
    return tuple(out)
