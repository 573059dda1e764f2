"""The healthy baseline, the reference state with which later windows are compared: of a structure with a model, or of modes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from monitor.core import Array
from monitor.damage.covariate_law import CovariateLaw
from monitor.damage.origin import Origin
from monitor.damage.presence import Presence
from monitor.damage.record_scatter import RecordScatter
from monitor.damage.spectrum import HealthySpectrum
from monitor.damage.updating import Observation, gauge_masks
from monitor.identification import KnownModes
from monitor.model import Model, Modes, StructuralPrior


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class HealthyModes:
    """Modes of the healthy structure, and the windows that they were learned from."""

    z: Annotated[Array, "d"]
    """Measured vector of the healthy state (see `updating.Observation`)."""
    z_covariance: Annotated[Array, "d d"]
    gauges: tuple[int, ...]
    """Channel by which each shape is normalized; empty where shapes are not used."""
    frequencies_hz: Annotated[Array, "m", 0.0]
    frequencies_std_hz: Annotated[Array, "m"]
    damping_ratio: Annotated[Array, "m"]
    """Shown, not judged."""
    channels: tuple[str, ...]
    windows: int
    level_range_m_s2: tuple[float, float]
    """Smallest and largest response level of the windows: RMS, mean over channels."""
    origin: Origin
    """Whose the baseline is."""
    reference_temperature_degc: float | None = None
    """Mean temperature over the windows; None without a temperature channel."""
    law: CovariateLaw | None = None
    """Dependence of the healthy stiffness, of the stories or of the modes, on temperature, level and other covariates; None where
    none was learned."""
    motion: Annotated[Array, "c c"] | None = None
    """Mean covariance of the accelerations over the windows, (m/s^2)^2, by which fewer channels measure the same
    level; None without accelerations."""
    recordings: tuple[dict[str, str], ...] = ()
    """Name and sha256 of every recording used."""
    span_ns: tuple[int, int] = (0, 0)
    """UTC of the first sample of the healthy data and of their end, ns."""
    clock_ratio: Annotated[float, 0.0] = 1.0
    """Rate of the healthy data by their timestamps over the stated one."""
    doubts: tuple[str, ...] = ()
    """Why it may not be this structure's, or why changes against it are not to be trusted; not in the file."""

    @property
    def free(self) -> Annotated[NDArray[np.bool_], "m c"]:
        """Mask of the components of the shapes that can change, all but the gauges'."""
        return gauge_masks(len(self.channels), self.gauges)[0]

    def shapes_in(self, z: Array) -> Annotated[Array, "m c"]:
        """Return the shapes that a measured vector holds, 1 at their gauges."""
        free = self.free
        shapes = np.ones(free.shape)
        shapes[free] = z[len(free) :]
        return shapes


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class ModalBaseline(HealthyModes):
    """Modes of a healthy structure without a model; `z` is of logarithms of eigenvalues, then of shapes."""

    scatter: RecordScatter
    """How `z` of windows of other records scatters."""
    presence: Presence
    """How often windows lacked a mode or showed others."""
    spectrum: HealthySpectrum | None = None
    """The shape of windows' spectra; None where too few are known."""
    shape_law: CovariateLaw | None = None
    """Dependence of the shapes' components but the gauges', mode by mode."""

    @property
    def shapes(self) -> Annotated[Array, "m c"]:
        """Real parts, 1 at the gauge."""
        return self.shapes_in(self.z)

    @property
    def known(self) -> KnownModes:
        """The modes as the channels show them, and how healthy windows showed them."""
        shapes, variance = self.shapes, self.scatter.total
        of_shapes = np.zeros(shapes.shape)
        of_shapes[self.free] = variance[len(shapes) :]
        return KnownModes(
            Modes((2.0 * np.pi * self.frequencies_hz) ** 2, shapes.T),
            0.5 * np.sqrt(variance[: len(shapes)]),
            of_shapes.sum(axis=1) / (shapes**2).sum(axis=1),
            self.presence.absent,
            self.presence.clutter,
            0.5 / (self.presence.windows + 1.0),
        )


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Baseline(HealthyModes):
    """Modes, updated model and systematic misfit of the healthy structure."""

    scatter: RecordScatter | None = None
    """How the stories' stiffness scatters between records; None where it was learned from one."""

    model: Model
    """Model updated to the healthy modes."""
    covariance: Annotated[Array, "theta theta"]
    """Covariance of stiffnesses, then masses, relative to their values."""
    misfit: Annotated[Array, "d"]
    """z minus the updated model's: the systematic model error, which cancels from every change."""
    model_mode: tuple[int, ...]
    """Numbers of the healthy modes in `model` (0 = lowest), in the order of `z`."""
    log: bool
    floors: tuple[int | str, ...]
    """Floor of each channel."""
    drift_weights: Annotated[Array, "c c"] | None = None
    """How the level that the law was learned at was measured (`level.drift_weights`), s^4."""
    reference: StructuralPrior | None = None
    """Prior of a diagnosis; None where the healthy data were too short for one, or the drawing was changed since."""
    converged: bool = True
    """Whether the updating to the healthy modes converged."""

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
        shapes, predicted = self.shapes_in(self.z), self.shapes_in(self.z - self.misfit)
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


AnyBaseline = Baseline | ModalBaseline
"""Healthy state of a structure with a model, or of modes alone."""
