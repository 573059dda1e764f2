"""Learns the healthy baseline from the windows of healthy recordings."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, BadInputError, ModalEstimate
from monitor.damage.baseline import Baseline, ModalBaseline
from monitor.damage.covariate_law import CovariateLaw
from monitor.damage.covariates import TEMPERATURE, Change, CovariateSettings, learn_law
from monitor.damage.origin import Origin
from monitor.damage.presence import Presence
from monitor.damage.record_scatter import RecordScatter, learn_scatter
from monitor.damage.spectrum import HealthySpectrum
from monitor.damage.updating import (
    MODES_ALONE,
    Observation,
    Update,
    UpdatingSettings,
    counterparts,
    observe,
    predict,
    update,
)
from monitor.model import InstrumentedModel, inverse


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class HealthyData:
    """Windows of healthy recordings, from which a baseline is learned."""

    windows: Sequence[ModalEstimate]
    """Modes of each window.  Windows may overlap: the covariance of their mean counts shared data once."""
    rms_m_s2: Annotated[Array, "windows"]
    """Response level of each window, mean over channels."""
    recordings: tuple[dict[str, str], ...] = ()
    """Name and sha256 of every recording."""
    span_ns: tuple[int, int] = (0, 0)
    """UTC of the first sample and of the end."""
    covariates: Sequence[Mapping[str, Array]] = ()
    """Lagged values of each covariate that is known in each window; empty where nothing is to be learned from them."""
    units: Mapping[str, str] = field(default_factory=dict)
    """Unit of each covariate, by its name."""
    t_ns: Sequence[int] = ()
    """End of each window, UTC.  Without them it is not learned what stories do together; of modes alone it never is."""
    records: Sequence[int] = ()
    """Number of the record, a stretch without gaps, of each window."""
    window_s: float = 0.0
    presence: Presence | None = None
    """How often windows, also those that lack a mode, showed each; of modes alone."""
    spectrum: HealthySpectrum | None = None
    """The shape of the spectra of the same windows."""
    motion: Sequence[Annotated[Array, "c c"]] = ()
    """Covariance of the accelerations of windows (`WindowResult.motion`), (m/s^2)^2."""

    @property
    def span_s(self) -> float:
        """Length of the data, s."""
        return (self.span_ns[1] - self.span_ns[0]) * 1e-9


def learn_baseline(
    instrumented: InstrumentedModel,
    healthy: HealthyData,
    *,
    updating: UpdatingSettings,
    compensation: CovariateSettings,
    drift_weights: Annotated[Array, "c c"] | None = None,
) -> tuple[Baseline, Update]:
    """Learn the baseline from the windows of healthy recordings, and return it with the updating to their mean.

    Parameters
    ----------
    drift_weights : ndarray
        How the covariate `LEVEL` was measured.

    Raises
    ------
    BadInputError
        If there is no window, or the model cannot be updated to their mean.
    """
    if not healthy.windows:
        raise BadInputError("no healthy window could be identified: nothing to learn a baseline from")
    mean = mean_observation(healthy.windows, updating)
    fit, covariance = _fit(instrumented, mean, updating), mean.deviations.T @ mean.deviations
    baseline = Baseline(
        **_known(mean, covariance, healthy, np.mean([m.frequencies_hz for m in healthy.windows], axis=0)),
        **_fitted(instrumented, mean, fit, covariance),
        log=mean.log,
        channels=instrumented.channels,
        floors=instrumented.floors,
        drift_weights=drift_weights,
    )
    if not healthy.units or not healthy.covariates:
        return baseline, fit
    seen = replace(mean, model_mode=baseline.model_mode)
    change = update(
        baseline.model,
        instrumented.sensor_matrix,
        baseline.target(seen),
        updating,
        prior_std=instrumented.stiffness_prior_std,
    )
    gain = change.gain / change.parameters[:, None]

    def of(o: Observation) -> tuple[Array, Array]:
        """Estimate a window's stiffness change from the baseline, as `damage_index.step` would, with its deviations.

        To first order; the step is that of the logarithm, for no stiffness is lost by more than all of it.
        """
        return np.expm1(gain @ (o.z - mean.z)), o.deviations @ gain.T

    stories = _Kind(_changes(healthy, mean, updating, of, healthy.t_ns), compensation, alike=True)
    # How windows of one record differ is learned with what the stories do together.
    scatter = _record_scatter(healthy, [stories]) if len(set(healthy.records)) > 1 else None
    return replace(
        baseline,
        reference_temperature_degc=_mean_temperature(healthy.covariates),
        law=stories.law(healthy),
        scatter=scatter,
    ), fit


def rebase_baseline(
    baseline: Baseline, instrumented: InstrumentedModel, updating: UpdatingSettings
) -> tuple[Baseline, Update]:
    """Update a changed drawing of the same structure to the baseline's healthy modes.

    The modes are kept, and so is the dependence on covariates: a relative change that all stories have alike is the same in
    every drawing.  `Baseline.reference`, which was fitted to spectra with the old drawing, is left out.  The changed drawing
    must have as many masses, stiffnesses and sensors as the old one.

    Raises
    ------
    BadInputError
        If the drawing cannot be updated to the healthy modes.
    """
    healthy = Observation(
        z=baseline.z,
        weight=inverse(baseline.z_covariance),
        deviations=np.zeros((1, baseline.z.size)),
        model_mode=baseline.model_mode,
        gauges=baseline.gauges,
        log=baseline.log,
    )
    fit = _fit(instrumented, healthy, updating)
    fitted = _fitted(instrumented, healthy, fit, baseline.z_covariance)
    return replace(baseline, **fitted, reference=None, doubts=()), fit


def _fit(instrumented: InstrumentedModel, healthy: Observation, updating: UpdatingSettings) -> Update:
    """Update the drawing's stiffnesses and masses to the healthy modes; BadInputError if that is not possible."""
    fit = update(
        instrumented.model,
        instrumented.sensor_matrix,
        healthy,
        updating.model_copy(update={"penalty": "initial"}),
        prior_std=instrumented.prior_std,
        with_masses=True,
    )
    if fit.iterations == 0:
        raise BadInputError(
            "the structure file's model cannot be updated to the healthy modes: one of its modes stands still where the "
            "healthy one moves most; check floors and directions of the channels"
        )
    return fit


def _fitted(instrumented: InstrumentedModel, healthy: Observation, fit: Update, z_covariance: Array) -> dict[str, Any]:
    """Return the fields of `Baseline` that depend on the drawing."""
    sensors = instrumented.sensor_matrix
    healthy = replace(healthy, model_mode=counterparts(fit.model.modes(), sensors, healthy))
    predicted, _ = predict(fit.model, sensors, healthy, with_masses=False)
    gain = fit.gain / fit.parameters[:, None]
    return {
        "model": fit.model,
        "converged": bool(fit.converged),
        "covariance": gain @ z_covariance @ gain.T,
        "misfit": healthy.z - predicted,
        "model_mode": healthy.model_mode,
        "origin": Origin.of(instrumented),
    }


def learn_modal_baseline(
    channels: tuple[str, ...],
    origin: Origin,
    healthy: HealthyData,
    *,
    compensation: CovariateSettings,
) -> ModalBaseline:
    """Learn the healthy modes from the windows of healthy recordings, as `learn_baseline`.

    All windows have the same modes and all channels.
    """
    assert healthy.presence is not None
    mean = mean_observation(healthy.windows, MODES_ALONE)
    m, c = len(mean.model_mode), len(channels)

    def changes(columns: slice) -> list[Change]:
        """Return the windows' changes of some of the data: `learn_law` takes relative ones, of which it uses the logarithms."""
        return _changes(
            healthy, mean, MODES_ALONE, lambda o: (np.expm1(o.z[columns] - mean.z[columns]), o.deviations[:, columns])
        )

    kinds = [_Kind(changes(slice(0, m)), compensation, alike=True)]
    kinds += [_Kind(changes(slice(m, None)), _of_shapes(compensation), alike=False)] if c > 1 else []
    first = _record_scatter(healthy, kinds)
    # The laws are as sure as windows really scatter, whatever they state.
    real = np.split(np.sqrt(first.total / np.maximum(first.stated, np.finfo(float).tiny)), [m])
    kinds = [kind.scaled(by) for kind, by in zip(kinds, real, strict=False)]
    scatter = _record_scatter(healthy, kinds, first.stated)
    covariance = scatter.of_mean(mean.deviations.T @ mean.deviations)
    law, shape_law = (*(kind.law(healthy) for kind in kinds), None)[:2]
    return ModalBaseline(
        **_known(mean, covariance, healthy, np.exp(0.5 * mean.z[:m]) / (2.0 * np.pi)),
        channels=channels,
        origin=origin,
        reference_temperature_degc=_mean_temperature(healthy.covariates),
        scatter=scatter,
        presence=healthy.presence,
        spectrum=healthy.spectrum,
        law=law,
        shape_law=shape_law,
    )


@dataclass(frozen=True, eq=False, slots=True)
class _Kind:
    """Quantities that follow the covariates by one law: their changes in the healthy windows, and the law's prior."""

    changes: Sequence[Change]
    settings: CovariateSettings
    alike: bool

    def scaled(self, by: Annotated[Array, "n"]) -> _Kind:
        """Return the changes with other standard deviations."""
        return replace(self, changes=[replace(one, deviations=one.deviations * by) for one in self.changes])

    def law(self, healthy: HealthyData, rows: Iterable[int] | None = None) -> CovariateLaw | None:
        """Learn the dependence on the covariates from all windows, or from some."""
        changes = self.changes if rows is None else [self.changes[k] for k in rows]
        return learn_law(changes, healthy.span_s, healthy.units, self.settings, alike=self.alike)


def _record_scatter(healthy: HealthyData, kinds: Sequence[_Kind], stated: Array | None = None) -> RecordScatter:
    """Learn how windows of other records scatter about what the rest and the laws of the covariates predict.

    The windows state the variance `stated`, by default that of their changes.
    """
    every = list(zip(*(kind.changes for kind in kinds), strict=True))  # of each window, its changes of each kind
    values = np.array([np.concatenate([np.log1p(one.relative) for one in window]) for window in every])
    if stated is None:
        stated = np.mean([np.concatenate([(one.deviations**2).sum(axis=0) for one in w]) for w in every], axis=0)
    n = stated.size
    ends = np.cumsum([0, *(kind.changes[0].relative.size for kind in kinds)])
    columns = [slice(int(a), int(b)) for a, b in pairwise(ends)]

    def predict(rest: NDArray[np.intp], left: NDArray[np.intp]) -> tuple[Array, Array]:
        """Predict what is left out from the rest, with the variance that the covariates' laws state."""
        expected, variance = np.tile(values[rest].mean(axis=0), (left.size, 1)), np.zeros((left.size, n))
        for kind, at in zip(kinds, columns, strict=True):
            law = kind.law(healthy, rest.tolist())
            if law is None:
                continue
            for row, k in enumerate(left.tolist()):
                effect = law.expected(healthy.covariates[k])
                expected[row, at] += np.log1p(effect.relative)
                variance[row, at] = effect.covariance.diagonal()
        return expected, variance

    return learn_scatter(values, stated, healthy.t_ns, healthy.records, round(healthy.window_s * 1e9), columns, predict)


def _known(mean: Observation, z_covariance: Array, healthy: HealthyData, frequencies_hz: Array) -> dict[str, Any]:
    """Return the fields of a baseline that the windows alone decide."""
    std = np.sqrt(np.diag(z_covariance)[: frequencies_hz.size])  # of the (logarithms of the) eigenvalues
    scale = frequencies_hz * std / 2.0 if mean.log else std / (8.0 * np.pi**2 * frequencies_hz)
    return {
        "z": mean.z,
        "z_covariance": z_covariance,
        "gauges": mean.gauges,
        "frequencies_hz": frequencies_hz,
        "frequencies_std_hz": scale,
        "damping_ratio": np.mean([m.damping_ratio for m in healthy.windows], axis=0),
        "windows": len(healthy.windows),
        "level_range_m_s2": (float(healthy.rms_m_s2.min()), float(healthy.rms_m_s2.max())),
        "recordings": healthy.recordings,
        "span_ns": healthy.span_ns,
        "motion": np.mean(healthy.motion, axis=0) if len(healthy.motion) else None,
    }


def _mean_temperature(covariates: Sequence[Mapping[str, Array]]) -> float | None:
    """Average the temperature over the windows that know it."""
    degc = [float(under[TEMPERATURE][0]) for under in covariates if TEMPERATURE in under]
    return float(np.mean(degc)) if degc else None


def _changes(
    healthy: HealthyData,
    mean: Observation,
    updating: UpdatingSettings,
    of: Callable[[Observation], tuple[Array, Array]],
    t_ns: Sequence[int] = (),
) -> list[Change]:
    """Collect each window's change from the baseline, and its deviations, which `of` makes of its observation."""
    changes = []
    ends_ns = t_ns or [0] * len(healthy.windows)
    for modes, under, end_ns in zip(healthy.windows, healthy.covariates, ends_ns, strict=True):
        o = observe(modes, updating, mean.gauges if updating.use_shapes else None)
        places = tuple((modes.refined, modes.first + b) for b in range(len(o.deviations)))
        changes.append(Change(*of(o), places, under, end_ns))
    return changes


def _of_shapes(settings: CovariateSettings) -> CovariateSettings:
    """Return how far shapes may follow covariates: as the stiffnesses change unevenly, for what all do alike moves no shape."""
    names = ("level_per_doubling", "temperature_per_k", "frost_per_k", "other")
    return settings.model_copy(update={name: settings.unevenness * getattr(settings, name) for name in names})


def mean_observation(windows: Sequence[ModalEstimate], settings: UpdatingSettings) -> Observation:
    """Average the observations of several windows, all with the same modes of the model in the same order.

    Windows that overlap share data.  Their influences are added before squaring, so that the covariance of the mean counts
    shared data once.  The gauges are those of the first window.
    """
    gauges = observe(windows[0], settings).gauges
    observations = [observe(m, settings, gauges if settings.use_shapes else None) for m in windows]
    influence: dict[tuple[bool, int], Array] = {}
    for m, o in zip(windows, observations, strict=True):
        for b, row in enumerate(o.deviations):
            place = (m.refined, m.first + b)
            influence[place] = influence.get(place, 0.0) + row / len(windows)
    deviations = np.array(list(influence.values()))
    last = observations[-1]
    # The weights between components are those of a window; their common scale follows from the scatter of the data.
    shape_of_weight = np.mean([o.weight for o in observations], axis=0)
    shrink = np.mean((deviations**2).sum(axis=0) * np.diag(shape_of_weight)) if len(windows) > 1 else 1.0
    return Observation(
        z=np.mean([o.z for o in observations], axis=0),
        weight=shape_of_weight / shrink,
        deviations=deviations,
        model_mode=last.model_mode,
        gauges=gauges,
        log=last.log,
    )
