"""The healthy baseline, the reference state with which later windows are compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import numpy as np

from monitor.core import Array, BadInputError, ModalEstimate
from monitor.damage.covariate_law import CovariateLaw
from monitor.damage.covariates import TEMPERATURE, Change, CovariateSettings, learn_law
from monitor.damage.observations import mean_observation
from monitor.damage.origin import Origin
from monitor.damage.updating import Observation, Update, UpdatingSettings, counterparts, observe, predict, update
from monitor.model import InstrumentedModel, Model, StructuralPrior, inverse


@dataclass(frozen=True, eq=False, slots=True)
class Baseline:
    """Modes, updated model and systematic misfit of the healthy structure."""

    model: Model
    """Model updated to the healthy modes."""
    covariance: Annotated[Array, "q q"]
    """Covariance of stiffnesses, then masses, relative to their values."""
    z: Annotated[Array, "d"]
    """Measured vector of the healthy state (see `updating.Observation`)."""
    z_covariance: Annotated[Array, "d d"]
    misfit: Annotated[Array, "d"]
    """z minus the updated model's: the systematic model error, which cancels from every change."""
    model_mode: tuple[int, ...]
    """Numbers of the healthy modes in `model` (0 = lowest), in the order of `z`."""
    gauges: tuple[int, ...]
    log: bool
    frequencies_hz: Annotated[Array, "m"]
    frequencies_std_hz: Annotated[Array, "m"]
    damping_ratio: Annotated[Array, "m"]
    channels: tuple[str, ...]
    floors: tuple[int, ...]
    """Floor of each channel."""
    windows: int
    level_range_m_s2: tuple[float, float]
    """Smallest and largest response level of the windows: RMS, mean over channels."""
    origin: Origin
    """Whose the baseline is."""
    reference_temperature_degc: float | None = None
    """Mean temperature over the windows; None without a temperature channel."""
    law: CovariateLaw | None = None
    """Dependence of the healthy stiffness on temperature, level and other covariates; None where none was learned."""
    drift_weights: Annotated[Array, "c c"] | None = None
    """How the level that the law was learned at was measured (`level.drift_weights`), s^4."""
    motion: Annotated[Array, "c c"] | None = None
    """Mean covariance of the accelerations over the windows, (m/s^2)^2, by which fewer channels measure the same
    level; None without accelerations."""
    recordings: tuple[dict[str, str], ...] = field(default=())
    """Name and sha256 of every recording used."""
    span_ns: tuple[int, int] = (0, 0)
    """UTC of the first sample of the healthy data and of their end, ns."""
    clock_ratio: Annotated[float, 0.0] = 1.0
    """Rate of the healthy data by their timestamps over the stated one."""
    reference: StructuralPrior | None = None
    """Prior of a diagnosis; None where the healthy data were too short for one, or the drawing was changed since."""
    converged: bool = True
    """Whether the updating to the healthy modes converged."""
    doubts: tuple[str, ...] = ()
    """Why it may not be this structure's, or why losses against it are not to be trusted; not in the file."""

    def only(self, model_modes: tuple[int, ...]) -> Baseline:
        """Select some modes of the model (0 = lowest), for a window in which not all of the baseline's were identified."""
        keep = [i for i, mode in enumerate(self.model_mode) if mode in model_modes]
        m, others = len(self.model_mode), len(self.channels) - 1
        if len(keep) == m:
            return self
        rows = keep + [m + i * others + s for i in keep for s in range(others) if self.gauges]
        return replace(
            self,
            z=self.z[rows],
            z_covariance=self.z_covariance[np.ix_(rows, rows)],
            misfit=self.misfit[rows],
            model_mode=tuple(self.model_mode[i] for i in keep),
            gauges=tuple(self.gauges[i] for i in keep if self.gauges),
            frequencies_hz=self.frequencies_hz[keep],
            frequencies_std_hz=self.frequencies_std_hz[keep],
            damping_ratio=self.damping_ratio[keep],
        )

    def seen_by(self, channels: tuple[int, ...]) -> Baseline:
        """Reduce the healthy state to what some of the channels (0 = first) see of it.

        A shape whose gauge is not among them is normalized by the one of them where it is largest, and so is the model's: the
        misfit that remains is that of the same quantities.
        """
        m, c = len(self.model_mode), len(self.channels)
        rows = list(channels)
        kept = replace(self, channels=tuple(self.channels[k] for k in rows), floors=tuple(self.floors[k] for k in rows))
        if channels == tuple(range(c)) or not self.gauges:
            return kept
        shapes, predicted = self._shapes(self.z), self._shapes(self.z - self.misfit)
        gauges = tuple(
            rows.index(gauge) if gauge in rows else int(np.abs(shape[rows]).argmax())
            for gauge, shape in zip(self.gauges, shapes, strict=True)
        )
        z, slope = np.concatenate([self.z[:m], np.zeros(m * (len(rows) - 1))]), np.zeros((m * len(rows), self.z.size))
        slope[:m, :m] = np.eye(m)
        model_z = np.concatenate([(self.z - self.misfit)[:m], z[m:]])
        for i, gauge in enumerate(gauges):
            # Rows of d(all components) / d(components but the old gauge's), then of d(ratios to the new gauge).
            free = np.eye(c)[:, [k for k in range(c) if k != self.gauges[i]]]
            others = [k for k in rows if k != rows[gauge]]
            ratio = shapes[i, others] / shapes[i, rows[gauge]]
            at = slice(m + i * len(others), m + (i + 1) * len(others))
            z[at], model_z[at] = ratio, predicted[i, others] / predicted[i, rows[gauge]]
            change = (free[others] - ratio[:, None] * free[rows[gauge]]) / shapes[i, rows[gauge]]
            slope[at, m + i * (c - 1) : m + (i + 1) * (c - 1)] = change
        return replace(kept, z=z, z_covariance=slope @ self.z_covariance @ slope.T, misfit=z - model_z, gauges=gauges)

    def _shapes(self, z: Array) -> Array:
        """Return the shapes that a measured vector holds, shape (m, c), 1 at their gauges."""
        m, c = len(self.model_mode), len(self.channels)
        shapes = np.ones((m, c))
        shapes[np.arange(c) != np.array(self.gauges)[:, None]] = z[m:]
        return shapes

    @property
    def model_form(self) -> float:
        """Relative error of a loss from the model's form, one standard deviation.

        It is twice the systematic misfit of ln eigenvalues and shapes, with the noise's part removed.  For example, joints
        of ratio 10 leave a misfit of 2.6 % and an error of 4 to 8 % of a loss.
        """
        excess = float((self.misfit**2).mean() - np.diag(self.z_covariance).mean())
        return 2.0 * float(np.sqrt(max(excess, 0.0)))

    def target(self, observation: Observation) -> Observation:
        """Subtract the systematic misfit from an observation: the target that the baseline's model is updated to."""
        return replace(observation, z=observation.z - self.misfit)


def learn_baseline(
    instrumented: InstrumentedModel,
    windows: list[ModalEstimate],
    rms: Array,
    recordings: tuple[dict[str, str], ...],
    span_ns: tuple[int, int] = (0, 0),
    covariates: Sequence[Mapping[str, Array]] = (),
    units: Mapping[str, str] | None = None,
    drift_weights: Array | None = None,
    *,
    updating: UpdatingSettings,
    compensation: CovariateSettings,
    t_ns: Sequence[int] = (),
    motion: Sequence[Array] = (),
) -> tuple[Baseline, Update]:
    """Learn the baseline from the windows of healthy recordings.

    Parameters
    ----------
    windows : list of ModalEstimate
        Windows may overlap: the covariance of their mean counts shared data once.
    rms : ndarray, shape (n_windows,)
        Response level of each window, m/s^2.
    covariates : sequence of mapping
        Lagged values of each covariate that is known in each window; empty where nothing is to be learned from them.
    units : mapping, optional
        Unit of each covariate, by its name.
    drift_weights : ndarray, shape (c, c), optional
        How the covariate `LEVEL` was measured.
    t_ns : sequence of int
        End of each window, UTC.  Without them it is not learned what the stories do together.
    motion : sequence of ndarray, shape (c, c), (m/s^2)^2
        Covariance of the accelerations of windows (`WindowResult.motion`).

    Returns
    -------
    Baseline
    Update
        Outcome of the updating to the mean of the windows.

    Raises
    ------
    BadInputError
        If there is no window, or the model cannot be updated to their mean.
    """
    if not windows:
        raise BadInputError("no healthy window could be identified: nothing to learn a baseline from")
    mean = mean_observation(windows, updating)
    fit = _fit(instrumented, mean, updating)
    f = np.mean([m.frequencies_hz for m in windows], axis=0)
    z_covariance = mean.deviations.T @ mean.deviations
    baseline = Baseline(
        **_fitted(instrumented, mean, fit, z_covariance),
        z=mean.z,
        z_covariance=z_covariance,
        gauges=mean.gauges,
        log=mean.log,
        frequencies_hz=f,
        frequencies_std_hz=_frequency_std(f, z_covariance, mean.log),
        damping_ratio=np.mean([m.damping_ratio for m in windows], axis=0),
        channels=instrumented.channels,
        floors=instrumented.floors,
        windows=len(windows),
        level_range_m_s2=(float(rms.min()), float(rms.max())),
        recordings=recordings,
        span_ns=span_ns,
        drift_weights=drift_weights,
        motion=np.mean(motion, axis=0) if len(motion) else None,
    )
    if not units or not covariates:
        return baseline, fit
    mean = replace(mean, model_mode=baseline.model_mode)
    changes = _changes(
        baseline, mean, windows, covariates, t_ns or [0] * len(windows), instrumented.sensor_matrix, updating
    )
    degc = [float(c[TEMPERATURE][0]) for c in covariates if TEMPERATURE in c]
    law = learn_law(changes, (span_ns[1] - span_ns[0]) * 1e-9, units, compensation)
    return replace(baseline, reference_temperature_degc=float(np.mean(degc)) if degc else None, law=law), fit


def rebase_baseline(
    baseline: Baseline, instrumented: InstrumentedModel, updating: UpdatingSettings
) -> tuple[Baseline, Update]:
    """Update a changed drawing of the same structure to the baseline's healthy modes.

    The modes are kept, and so is the dependence on covariates: a relative change that all stories have alike is the same in every
    drawing.  `Baseline.reference`, which was fitted to spectra with the old drawing, is left out.

    Parameters
    ----------
    instrumented : InstrumentedModel
        The changed drawing, with as many masses, stiffnesses and sensors as the old one.

    Returns
    -------
    Baseline
    Update
        Outcome of the updating to the healthy modes.

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
    """Update the drawing's stiffnesses and masses to the healthy modes.

    Raises
    ------
    BadInputError
        If that is not possible.
    """
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


def _changes(
    baseline: Baseline,
    mean: Observation,
    windows: list[ModalEstimate],
    covariates: Sequence[Mapping[str, Array]],
    t_ns: Sequence[int],
    sensors: Array,
    updating: UpdatingSettings,
) -> list[Change]:
    """Estimate each window's stiffness change from the baseline, as `damage_index.step` would."""
    fit = update(baseline.model, sensors, baseline.target(mean), updating)
    gain = fit.gain / fit.parameters[:, None]
    changes = []
    for modes, under, end_ns in zip(windows, covariates, t_ns, strict=True):
        o = observe(modes, updating, mean.gauges if updating.use_shapes else None)
        places = tuple((modes.refined, modes.first + b) for b in range(len(o.deviations)))
        changes.append(Change(gain @ (o.z - mean.z), o.deviations @ gain.T, places, under, end_ns))
    return changes


def _frequency_std(f: Array, z_covariance: Array, log: bool) -> Array:
    """Convert the standard deviations of (log) eigenvalues to those of the frequencies, shape (m,), Hz."""
    std = np.sqrt(np.diag(z_covariance)[: f.size])
    return np.asarray(f * std / 2.0 if log else std / (8.0 * np.pi**2 * f))
