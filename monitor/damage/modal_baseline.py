"""The healthy modes of a structure without a model, with which the modes of later windows are compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array, ModalEstimate
from monitor.damage.covariate_law import CovariateLaw
from monitor.damage.covariates import TEMPERATURE, Change, CovariateSettings, learn_law
from monitor.damage.observations import mean_observation
from monitor.damage.updating import UpdatingSettings, observe
from monitor.model import Modes

_DATA = UpdatingSettings()
"""What is measured of the modes: logarithms of eigenvalues, and shapes."""


@dataclass(frozen=True, slots=True)
class ModalOrigin:
    """Structure and samples from which the modes were learned."""

    name: str
    unit: str
    """Of the samples."""
    rate_hz: Annotated[float, 0.0]
    """Sample rate after resampling."""
    cutoff_hz: Annotated[float, 0.0]


@dataclass(frozen=True, eq=False, slots=True)
class ModalBaseline:
    """Modes of the healthy structure."""

    frequencies_hz: Annotated[Array, "m", 0.0]
    frequencies_std_hz: Annotated[Array, "m"]
    damping_ratio: Annotated[Array, "m"]
    """Shown, not judged."""
    shapes: Annotated[Array, "m c"]
    """Real parts, 1 at the gauge."""
    gauges: tuple[int, ...]
    """Channel of the largest component of each shape."""
    covariance: Annotated[Array, "m m"]
    """Of the logarithms of the frequencies."""
    shape_variance: Annotated[Array, "m c"]
    """Of the shapes' components."""
    channels: tuple[str, ...]
    windows: int
    level_range_m_s2: tuple[float, float]
    """Smallest and largest response level of the windows: RMS, mean over channels."""
    origin: ModalOrigin
    reference_temperature_degc: float | None = None
    """Mean temperature over the windows; None without a temperature channel."""
    law: CovariateLaw | None = None
    """Dependence of the modal stiffnesses, the squares of the frequencies, on the covariates; None where none was learned."""
    shape_law: CovariateLaw | None = None
    """Dependence of the shapes' components but the gauges', mode by mode."""
    motion: Annotated[Array, "c c"] | None = None
    """Covariance of the windows' accelerations, (m/s^2)^2, by which fewer channels measure the same level."""
    recordings: tuple[dict[str, str], ...] = field(default=())
    """Name and sha256 of every recording used."""
    span_ns: tuple[int, int] = (0, 0)
    """UTC of the first sample of the healthy data and of their end, ns."""
    clock_ratio: Annotated[float, 0.0] = 1.0
    """Rate of the healthy data by their timestamps over the stated one."""
    doubts: tuple[str, ...] = ()
    """Why it may not be this structure's; not in the file."""

    @property
    def modes(self) -> Modes:
        """The modes as the channels show them."""
        return Modes((2.0 * np.pi * self.frequencies_hz) ** 2, self.shapes.T)

    @property
    def free(self) -> NDArray[np.bool_]:
        """Mask of the components that can change, all but the gauges', shape (m, c)."""
        return np.asarray(np.arange(len(self.channels)) != np.array(self.gauges)[:, None])


def learn_modal_baseline(
    channels: tuple[str, ...],
    origin: ModalOrigin,
    windows: list[ModalEstimate],
    rms: Array,
    recordings: tuple[dict[str, str], ...],
    span_ns: tuple[int, int],
    covariates: Sequence[Mapping[str, Array]],
    units: Mapping[str, str],
    compensation: CovariateSettings,
    *,
    motion: Sequence[Array] = (),
) -> ModalBaseline:
    """Learn the healthy modes from the windows of healthy recordings.

    Parameters
    ----------
    windows : list of ModalEstimate
        All with the same modes and all channels.  They may overlap: the covariance of their mean counts shared data once.
    rms : ndarray, shape (n_windows,)
        Response level of each window, m/s^2.
    covariates : sequence of mapping
        Lagged values of each covariate that is known in each window.
    units : mapping
        Unit of each covariate, by its name.
    motion : sequence of ndarray, shape (c, c), (m/s^2)^2
        Covariance of the accelerations of windows (`WindowResult.motion`).
    """
    mean = mean_observation(windows, _DATA)
    m, c = len(mean.model_mode), len(channels)
    covariance = mean.deviations.T @ mean.deviations
    frequencies_hz = np.exp(0.5 * mean.z[:m]) / (2.0 * np.pi)
    free = np.arange(c) != np.array(mean.gauges)[:, None]
    shapes, shape_variance = np.ones((m, c)), np.zeros((m, c))
    shapes[free], shape_variance[free] = mean.z[m:], covariance.diagonal()[m:]
    seen = [(observe(w, _DATA, mean.gauges), w) for w in windows]

    def law(columns: slice, settings: CovariateSettings, *, alike: bool) -> CovariateLaw | None:
        """Learn the dependence of some of the data on the covariates."""
        changes = [
            # `learn_law` takes relative changes, of which it uses the logarithms.
            Change(
                np.expm1(o.z[columns] - mean.z[columns]),
                o.deviations[:, columns],
                tuple((w.refined, w.first + b) for b in range(len(o.deviations))),
                under,
            )
            for (o, w), under in zip(seen, covariates, strict=True)
        ]
        return learn_law(changes, (span_ns[1] - span_ns[0]) * 1e-9, units, settings, alike=alike)

    degc = [float(under[TEMPERATURE][0]) for under in covariates if TEMPERATURE in under]
    return ModalBaseline(
        frequencies_hz=frequencies_hz,
        frequencies_std_hz=0.5 * frequencies_hz * np.sqrt(covariance.diagonal()[:m]),
        damping_ratio=np.mean([w.damping_ratio for w in windows], axis=0),
        shapes=shapes,
        gauges=mean.gauges,
        covariance=0.25 * covariance[:m, :m],
        shape_variance=shape_variance,
        channels=channels,
        windows=len(windows),
        level_range_m_s2=(float(rms.min()), float(rms.max())),
        origin=origin,
        reference_temperature_degc=float(np.mean(degc)) if degc else None,
        law=law(slice(0, m), compensation, alike=True),
        shape_law=law(slice(m, None), _of_shapes(compensation), alike=False) if c > 1 else None,
        motion=np.mean(motion, axis=0) if len(motion) else None,
        recordings=recordings,
        span_ns=span_ns,
    )


def _of_shapes(settings: CovariateSettings) -> CovariateSettings:
    """Return how far shapes may follow covariates: as the stiffnesses change unevenly, for what all do alike moves no shape."""
    names = ("level_per_doubling", "temperature_per_k", "frost_per_k", "other")
    return settings.model_copy(update={name: settings.unevenness * getattr(settings, name) for name in names})
